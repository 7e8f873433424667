"""What a calibration leaves behind: a dated fact with its uncertainty, how it was judged, and for which device."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from importlib.metadata import version
from math import floor, log10
from pathlib import Path
from typing import Any, ClassVar, Self

from pydantic import AwareDatetime, ConfigDict, FiniteFloat, PositiveFloat, TypeAdapter, ValidationError

from rig.core.errors import ConfigError, UsageError
from rig.core.files import write


@dataclass(frozen=True, slots=True)
class Estimate:
    """A quantity with its standard uncertainty, both in ``unit``."""

    value: FiniteFloat
    uncertainty: FiniteFloat
    unit: str

    def __str__(self) -> str:
        """Return value and uncertainty to two digits of the uncertainty."""
        if not self.uncertainty > 0:
            return f"{self.value:.6g} ± {self.uncertainty:g} {self.unit}".rstrip()
        decimals = max(1 - floor(log10(self.uncertainty)), 0)
        return f"{self.value:.{decimals}f} ± {self.uncertainty:.{decimals}f} {self.unit}".rstrip()


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationResult:
    """The result of one calibration.

    Attributes
    ----------
    name
        What was calibrated: ``imu.scale``, ``camera.intrinsics``.
    estimates
        The quantities by name; empty where nothing could be estimated.
    residual, limit
        The worst residual of the fit and what it may be, in ``residual_unit``.
    refusals
        Why the estimates must not be used, each with what to do about it; empty when the calibration passed.
    settings
        What it puts in force, by key of the configuration.
    valid_days
        How long it holds; None: until the device changes.
    when_utc
        By the bench's clock.
    device
        What was calibrated, against what, and on which bench (`rig.calibrations.apparatus`): a fact holds for no other.
    evidence
        What was measured, enough to fit it again.

    Raises
    ------
    ValueError
        When a fact without refusals has no estimate, one with refusals has settings, or ``when_utc`` no time zone.
    """

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(extra="forbid")

    name: str
    estimates: Mapping[str, Estimate]
    residual: FiniteFloat | None
    limit: FiniteFloat | None
    residual_unit: str
    refusals: tuple[str, ...]
    when_utc: AwareDatetime
    device: Mapping[str, Any]
    evidence: Mapping[str, Any]
    settings: Mapping[str, Any] = field(default_factory=dict)
    valid_days: PositiveFloat | None = None
    software: str = field(default_factory=lambda: f"hbr-rig {version('hbr-rig')}")

    def __post_init__(self) -> None:
        if self.passed and not self.estimates:
            raise ValueError(f"{self.name}: what passed has a value and an uncertainty")
        if self.settings and not self.passed:
            raise ValueError(f"{self.name}: what was refused puts nothing in force")
        if self.when_utc.tzinfo is None:
            raise ValueError(f"{self.name}: when_utc needs a time zone")
        object.__setattr__(self, "when_utc", self.when_utc.astimezone(UTC))

    @property
    def passed(self) -> bool:
        return not self.refusals

    @property
    def id(self) -> str:
        """Name by which a stored view refers to the fact."""
        return f"{self.name}@{self.when_utc:%Y%m%dT%H%M%S.%fZ}"

    def expired(self, now_utc: datetime) -> bool:
        return self.valid_days is not None and now_utc - self.when_utc > timedelta(days=self.valid_days)

    def to_file(self, path: Path) -> None:
        """Write the fact as JSON: all of it or, when that fails, nothing.

        Raises
        ------
        UsageError
            The file cannot be written.
        """
        try:
            write(path, _JSON.dump_json(self, indent=2) + b"\n")
        except OSError as error:
            raise UsageError(
                f"Cannot write the calibration {path}.",
                next_step="Give a file in an existing folder that you may write to.",
                evidence={"reason": error.strerror or str(error)},
            ) from error

    @classmethod
    def from_file(cls, path: Path) -> Self:
        """Read a fact that `to_file` wrote.

        Raises
        ------
        ConfigError
            The file cannot be read, or is no calibration: all its mistakes at once.
        """
        try:
            fact = _JSON.validate_json(path.read_bytes())
        except OSError as error:
            mistakes = [error.strerror or str(error)]
        except ValidationError as error:
            mistakes = [": ".join([*map(str, e["loc"]), e["msg"]]) for e in error.errors(include_url=False)]
        else:
            assert isinstance(fact, cls)
            return fact
        raise ConfigError(
            f"Cannot read the calibration {path}.",
            next_step="Give a file that `rig calibrate ...` wrote, or remove it and calibrate again.",
            evidence={"mistakes": mistakes},
        )


_JSON: TypeAdapter[CalibrationResult] = TypeAdapter(CalibrationResult)
