"""The result of a calibration: values with uncertainties, its limits, its date and its device."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from importlib.metadata import version
from math import floor, hypot, log10
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import (
    AwareDatetime,
    ConfigDict,
    Field,
    FiniteFloat,
    PositiveFloat,
    TypeAdapter,
    ValidationError,
)

from rig.calibrations.rejection import CalibrationRejection
from rig.core.errors import ConfigError, UsageError, os_errors_as
from rig.core.files import read, write
from rig.core.phrases import filled, in_unit, number

# far above a result with all its evidence; a larger file is another one, and is not read into memory
MAX_FILE_BYTES = 10_000_000
COVERAGE_FACTOR = 2
"""k of an expanded uncertainty: about 95 % of a normal distribution (JCGM 100:2008, 6.2)."""


@dataclass(frozen=True, slots=True)
class Contribution:
    """One source in the uncertainty budget of a quantity (JCGM 100:2008, 5.1)."""

    source: str
    """The source in words."""
    kind: Literal["A", "B"]
    """A: evaluated from the scatter of the measurements; B: from other knowledge, such as a data sheet."""
    uncertainty: Annotated[FiniteFloat, Field(ge=0)]
    unit: str
    """The source's standard uncertainty."""
    sensitivity: FiniteFloat = 1.0
    """Change of the quantity for a change of the source by 1."""

    @property
    def part(self) -> float:
        """The contribution to the standard uncertainty of the quantity, in its unit."""
        return abs(self.sensitivity) * self.uncertainty


@dataclass(frozen=True, slots=True)
class Estimate:
    """A quantity and its uncertainty budget; ``unit`` is that of the value. The contributions are independent."""

    value: FiniteFloat
    budget: tuple[Contribution, ...]
    unit: str

    @property
    def uncertainty(self) -> float:
        """The standard uncertainty: the root of the sum of the squared contributions."""
        return hypot(*(one.part for one in self.budget))

    def share(self, one: Contribution) -> float:
        """Return the share of a contribution in the variance."""
        return (one.part / self.uncertainty) ** 2 if one.part else 0.0

    @property
    def expanded(self) -> str:
        """The expanded uncertainty U = k·u in words; empty if the uncertainty is 0."""
        return in_unit(f"{COVERAGE_FACTOR * self.uncertainty:.2g}", self.unit) if self.uncertainty > 0 else ""

    def __str__(self) -> str:
        """Return value and uncertainty to two digits of the uncertainty."""
        if not self.uncertainty > 0:
            return in_unit(filled("{:.6g} ± {:g}", self.value, self.uncertainty), self.unit)
        decimals = max(1 - floor(log10(self.uncertainty)), 0)
        value, uncertainty = (number(one, f".{decimals}f") for one in (self.value, self.uncertainty))
        return in_unit(f"{value} ± {uncertainty}", self.unit)


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationResult:
    """The result of one calibration.

    Raises `ValueError`: a result without rejections has no estimate, one with rejections has settings, or ``when_utc``
    has no time zone.
    """

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(extra="forbid")

    name: str
    """Name of the calibration: ``imu.scale``, ``camera.intrinsics``."""
    estimates: Mapping[str, Estimate]
    """The quantities by name; empty if nothing could be estimated."""
    residual: FiniteFloat | None
    limit: FiniteFloat | None
    """The worst residual of the fit and its limit, in ``residual_unit``."""
    residual_unit: str
    rejections: tuple[CalibrationRejection, ...]
    """Reasons why the estimates must not be used; empty if the calibration passed."""
    when_utc: AwareDatetime
    """Time of the calibration, by the bench's clock."""
    reference: str
    """What the quantities were compared with, in words."""
    operator: str
    """Who calibrated: the account, or the person at a page of a server."""
    device: Mapping[str, Any]
    """The calibrated devices and their bench (`rig.calibrations.apparatus`). The result is valid only for them."""
    evidence: Mapping[str, Any]
    """The measurements, enough to fit them again."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """The settings that the result applies, by key of the configuration."""
    valid_days: PositiveFloat | None = None
    """Days for which the result is valid; None: until the device changes."""
    software: str = field(default_factory=lambda: f"hbr-rig {version('hbr-rig')}")

    def __post_init__(self) -> None:
        if self.passed and not self.estimates:
            raise ValueError(f"{self.name}: a result that passed needs an estimate")
        if self.settings and not self.passed:
            raise ValueError(f"{self.name}: a result that did not pass applies no settings")
        if self.when_utc.tzinfo is None:
            raise ValueError(f"{self.name}: when_utc needs a time zone")
        object.__setattr__(self, "when_utc", self.when_utc.astimezone(UTC))

    @property
    def passed(self) -> bool:
        return not self.rejections

    @property
    def id(self) -> str:
        """The name by which a stored view refers to the result."""
        return f"{self.name}@{self.when_utc:%Y%m%dT%H%M%S.%fZ}"

    @property
    def valid_until(self) -> datetime | None:
        """The time from which the result has expired; None if it never does."""
        return None if self.valid_days is None else self.when_utc + timedelta(days=self.valid_days)

    def expired(self, now_utc: datetime) -> bool:
        return self.valid_until is not None and now_utc > self.valid_until

    def to_file(self, path: Path) -> None:
        """Write the result as JSON, completely or not at all.

        Raises `UsageError`: the file cannot be written.
        """
        step = "Give a file in an existing folder that you may write to."
        with os_errors_as(UsageError, f"Cannot write the calibration {path}.", next_step=step):
            write(path, _JSON.dump_json(self, indent=2) + b"\n")

    @classmethod
    def from_file(cls, path: Path) -> Self:
        """Read a result that `to_file` wrote.

        Raises `ConfigError`: the file cannot be read, or is not a calibration result; the error lists all mistakes.
        """
        try:
            result = _JSON.validate_json(read(path, max_bytes=MAX_FILE_BYTES))
        except OSError as error:
            mistakes = [error.strerror or str(error)]
        except ValidationError as error:
            mistakes = [": ".join([*map(str, e["loc"]), e["msg"]]) for e in error.errors(include_url=False)]
        else:
            assert isinstance(result, cls)
            return result
        raise ConfigError(
            f"Cannot read the calibration {path}.",
            next_step="Give a file that a calibration wrote, or remove it and calibrate again.",
            evidence={"mistakes": mistakes},
        )


_JSON: TypeAdapter[CalibrationResult] = TypeAdapter(CalibrationResult)
