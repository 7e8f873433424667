"""The facts of a bench on disk: a folder of files, one a calibration, to which is only ever added."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum
from glob import escape
from pathlib import Path
from typing import Any

from rig.calibrations.result import CalibrationResult
from rig.config import RigConfig
from rig.core.errors import ConfigError, UsageError

CALIBRATIONS = "calibrations"
"""Where a bench's conditions name the facts in force."""


class State(StrEnum):
    """How a bench stands with one kind of calibration."""

    IN_FORCE = "in force"
    EXPIRED = "expired"
    OTHER_DEVICE = "other device"
    FAILED = "failed"
    """It was tried, and never passed."""


@dataclass(frozen=True, slots=True)
class Standing:
    """The newest fact of a kind that counts, and how the bench stands with it, in words."""

    fact: CalibrationResult
    state: State
    words: str

    @property
    def command(self) -> str:
        """Return the command that mends what is not in force."""
        return f"rig calibrate {self.fact.name.partition('.')[0]}"


class CalibrationStore:
    """The folder of a bench's facts; it need not exist until the first one is kept.

    Attributes
    ----------
    unreadable
        Why files of the folder were left out at the last look.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.unreadable: list[ConfigError] = []

    def keep(self, fact: CalibrationResult) -> Path:
        """Add a fact, passed or not, and return its file.

        Raises
        ------
        UsageError
            The folder cannot be made or written to.
        """
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UsageError(
                f"Cannot keep calibrations in {self.folder}.",
                next_step="Set calibration_dir to a folder that you may write to.",
                evidence={"reason": error.strerror or str(error)},
            ) from error
        # Numbered in the order in which they were kept: a clock may be set back, and a simulated one runs ahead.
        number = 1 + max((int(path.name.partition("-")[0]) for path in self._files()), default=0)
        path = self.folder / f"{number:05d}-{fact.name}-{fact.when_utc:%Y%m%dT%H%M%SZ}.json"
        fact.to_file(path)
        return path

    def history(self, name: str | None = None) -> list[CalibrationResult]:
        """Return all facts, of all kinds or one, in the order in which they were kept."""
        self.unreadable = []
        facts = []
        for path in self._files(name or ""):
            try:
                facts.append(CalibrationResult.from_file(path))
            except ConfigError as error:
                self.unreadable.append(error)
        return [fact for fact in facts if name in (None, fact.name)]

    def _files(self, name: str = "") -> list[Path]:
        return sorted(self.folder.glob(f"[0-9]*-{escape(name)}*.json"))

    def standings(self, device: Mapping[str, Any], now_utc: datetime) -> list[Standing]:
        """Return how the bench with these devices stands with each kind of calibration, by name.

        The newest fact that passed on these very devices counts; where none did, the newest that passed at all.
        """
        kinds: dict[str, list[CalibrationResult]] = {}
        for fact in self.history():
            kinds.setdefault(fact.name, []).append(fact)
        return [_standing(kinds[name], device, now_utc) for name in sorted(kinds)]


def apparatus(
    name: str, devices: Mapping[str, Any], config: RigConfig, conditions: Mapping[str, Any]
) -> dict[str, Any]:
    """Return what a fact is bound to: the bench, its devices' identities, how they are mounted, and a simulated world.

    What a calibration itself puts in force is no part of it.
    """
    mounting = {
        "servo": config.table.model_dump(include={"direction"}),
        "imu": config.imu.model_dump(include={"axis", "sign", "range_dps"}),
    }
    return {
        "bench": name,
        **{part: {**identity, **mounting.get(part, {})} for part, identity in devices.items()},
        "conditions": {key: value for key, value in conditions.items() if key != CALIBRATIONS},
    }


def differences(fact: CalibrationResult, device: Mapping[str, Any]) -> list[str]:
    """Return in words how the calibrated devices differ from ``device``, as far as both are known."""
    return list(_differences("", fact.device, device))


def _differences(path: str, then: Any, now: Any) -> Iterable[str]:
    if isinstance(then, Mapping) and isinstance(now, Mapping):
        for key in then.keys() & now.keys():
            yield from _differences(f"{path}.{key}" if path else str(key), then[key], now[key])
    elif then != now:
        yield f"{path} was {then}, is {now}"


def _standing(facts: list[CalibrationResult], device: Mapping[str, Any], now_utc: datetime) -> Standing:
    passed = [fact for fact in facts if fact.passed]
    if not passed:
        return Standing(facts[-1], State.FAILED, f"{facts[-1].name} never passed: {facts[-1].refusals[0]}")
    here = [fact for fact in passed if not differences(fact, device)]
    if not here:
        changed = "; ".join(sorted(differences(passed[-1], device)))
        return Standing(
            passed[-1], State.OTHER_DEVICE, f"{passed[-1].name} was calibrated on another device: {changed}"
        )
    fact = here[-1]
    days = max((now_utc - fact.when_utc).total_seconds() / 86400, 0.0)  # a simulated clock runs ahead
    age = f"{fact.name} was calibrated {days:.0f} days ago"
    if fact.expired(now_utc):
        return Standing(fact, State.EXPIRED, f"{age}; it holds for {fact.valid_days:.0f}")
    return Standing(fact, State.IN_FORCE, age)
