"""What a calibration leaves behind: a dated fact with its uncertainty, how it was judged, and for which device."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC
from importlib.metadata import version
from pathlib import Path
from typing import Any, ClassVar, Self

from pydantic import AwareDatetime, ConfigDict, FiniteFloat, TypeAdapter, ValidationError

from rig.errors import ConfigError, UsageError
from rig.files import write


@dataclass(frozen=True, slots=True, kw_only=True)
class Fact:
    """A calibrated quantity.

    Attributes
    ----------
    name
        The quantity, by its key in the configuration where it has one.
    value, uncertainty
        Best estimate and standard uncertainty, in ``unit``; None where nothing could be estimated.
    residual, limit
        The worst residual of the fit and what it may be, in ``residual_unit``.
    refusals
        Why the value must not be used, each with what to do about it; empty when the calibration passed.
    when_utc
        By the bench's clock.
    device
        What was calibrated, against what, and on which bench: a fact holds for no other.
    evidence
        What was measured, enough to fit it again.

    Raises
    ------
    ValueError
        When a fact without refusals has no value or no uncertainty, or ``when_utc`` no time zone.
    """

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(extra="forbid")

    name: str
    value: FiniteFloat | None
    unit: str
    uncertainty: FiniteFloat | None
    residual: FiniteFloat | None
    limit: FiniteFloat | None
    residual_unit: str
    refusals: tuple[str, ...]
    when_utc: AwareDatetime
    device: Mapping[str, Any]
    evidence: Mapping[str, Any]
    software: str = field(default_factory=lambda: f"hbr-rig {version('hbr-rig')}")

    def __post_init__(self) -> None:
        if self.passed and (self.value is None or self.uncertainty is None):
            raise ValueError(f"{self.name}: what passed has a value and an uncertainty")
        if self.when_utc.tzinfo is None:
            raise ValueError(f"{self.name}: when_utc needs a time zone")
        object.__setattr__(self, "when_utc", self.when_utc.astimezone(UTC))

    @property
    def passed(self) -> bool:
        return not self.refusals

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
            next_step="Give a file that `rig calibrate ... --out FILE` wrote, or calibrate again.",
            evidence={"mistakes": mistakes},
        )


_JSON: TypeAdapter[Fact] = TypeAdapter(Fact)
