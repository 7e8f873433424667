"""The calibration results of a bench on disk: a folder with one file for each calibration. Files are only added.

Their settings are applied to the configuration.

Decision: docs/decisions/0022.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum
from glob import escape
from pathlib import Path
from typing import Any

from rig.calibrations.result import CalibrationResult
from rig.config import RigConfig
from rig.config.values import validate
from rig.core.errors import ConfigError, UsageError, os_errors_as
from rig.core.next_steps import Do, NextStep
from rig.core.phrases import counted

CALIBRATIONS = "calibrations"
"""The key in a bench's conditions that names the results in force."""


_COMMANDS = {"camera.time": "camera-time", "table.ringing": "shaper", "table.mark": "mark"}
"""Commands that are not named after the first part of their results."""


class CalibrationStatus(StrEnum):
    """Whether a bench can use one kind of calibration."""

    IN_FORCE = "in force"
    EXPIRED = "expired"
    OTHER_DEVICE = "other device"
    FAILED = "failed"
    """No attempt passed."""


@dataclass(frozen=True, slots=True)
class BenchCalibration:
    """The decisive result of one kind of calibration, and its status on the bench.

    ``age_days`` is the result's age; ``changes`` are the differences between the calibrated devices and the bench's.
    """

    result: CalibrationResult
    status: CalibrationStatus
    age_days: float = 0.0
    changes: tuple[str, ...] = ()

    def __str__(self) -> str:
        """Return the status in words."""
        name, days = self.result.name, round(self.age_days)
        age = f"{name} was calibrated " + (f"{counted(days, 'day')} ago" if days else "today")
        match self.status:
            case CalibrationStatus.FAILED:
                return f"{name} never passed: {self.result.rejections[0]}"
            case CalibrationStatus.OTHER_DEVICE:
                return f"{name} was calibrated on another device: {'; '.join(self.changes)}"
            case CalibrationStatus.EXPIRED:
                return f"{age}; it is valid for {counted(round(self.result.valid_days or 0), 'day')}"
            case _:
                return age

    @property
    def repetition(self) -> NextStep:
        """The step that calibrates again."""
        return Do.CALIBRATE(name=_COMMANDS.get(self.result.name, self.result.name.partition(".")[0]))


class CalibrationStore:
    """The folder of a bench's calibration results; the first `add` creates it.

    ``unreadable`` are the errors of the files that the last `history` left out.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.unreadable: list[ConfigError] = []

    def add(self, result: CalibrationResult) -> Path:
        """Store a result, passed or not, and return its file.

        Raises `UsageError`: the folder cannot be created or written to.
        """
        step = "Set calibration_dir to a folder that you may write to."
        with os_errors_as(UsageError, f"Cannot store calibrations in {self.folder}.", next_step=step):
            self.folder.mkdir(parents=True, exist_ok=True)
        # Numbered in the order of storing: a clock may be set back, and a simulated clock runs ahead.
        number = 1 + max((int(path.name.partition("-")[0]) for path in self._files()), default=0)
        path = self.folder / f"{number:05d}-{result.name}-{result.when_utc:%Y%m%dT%H%M%SZ}.json"
        result.to_file(path)
        return path

    def history(self, name: str | None = None) -> list[CalibrationResult]:
        """Return all results, of all kinds or of one, in the order of storing."""
        self.unreadable = []
        results = []
        for path in self._files(name or ""):
            try:
                results.append(CalibrationResult.from_file(path))
            except ConfigError as error:
                self.unreadable.append(error)
        return [result for result in results if name in (None, result.name)]

    def _files(self, name: str = "") -> list[Path]:
        return sorted(self.folder.glob(f"[0-9]*-{escape(name)}*.json"))

    def on_bench(self, device: Mapping[str, Any], now_utc: datetime) -> list[BenchCalibration]:
        """Return the calibrations of the bench with these devices, one of each kind, sorted by name.

        The newest result that passed on these devices decides; if there is none, the newest that passed at all.
        """
        kinds: dict[str, list[CalibrationResult]] = {}
        for result in self.history():
            kinds.setdefault(result.name, []).append(result)
        return [_bench_calibration(kinds[name], device, now_utc) for name in sorted(kinds)]


def apparatus(
    name: str, devices: Mapping[str, Any], config: RigConfig, conditions: Mapping[str, Any]
) -> dict[str, Any]:
    """Return everything that a result is valid for: bench, devices, their mounting, exposure, and conditions.

    The settings that a calibration itself applies are not part of it.
    """
    mounting = {
        "servo": config.table.model_dump(include={"direction"}),
        "imu": config.imu.model_dump(include={"axis", "sign", "range_dps"}),
    }
    return {
        "bench": name,
        **{part: {**identity, **mounting.get(part, {})} for part, identity in devices.items()},
        "exposure": config.camera.model_dump(include={"exposure_us"}),
        "conditions": {key: value for key, value in conditions.items() if key != CALIBRATIONS},
    }


def differences(result: CalibrationResult, device: Mapping[str, Any]) -> list[str]:
    """Return the known differences between the calibrated devices and ``device``."""
    return list(_differences("", result.device, device))


def _differences(path: str, then: Any, now: Any) -> Iterable[str]:
    if isinstance(then, Mapping) and isinstance(now, Mapping):
        known = then.keys() & now.keys()
        if "device" in known and None not in (then["device"], now["device"]):
            known -= {"name"}  # the configured source, which can mean another camera later
        elif "name" in known:
            known -= {"device"}
        for key in known:
            yield from _differences(f"{path}.{key}" if path else str(key), then[key], now[key])
    elif then != now:
        yield f"{path} was {then}, is {now}"


def _bench_calibration(
    results: list[CalibrationResult], device: Mapping[str, Any], now_utc: datetime
) -> BenchCalibration:
    passed = [result for result in results if result.passed]
    if not passed:
        return BenchCalibration(results[-1], CalibrationStatus.FAILED)
    here = [result for result in passed if not differences(result, device)]
    if not here:
        changes = tuple(sorted(differences(passed[-1], device)))
        return BenchCalibration(passed[-1], CalibrationStatus.OTHER_DEVICE, changes=changes)
    age_days = max((now_utc - here[-1].when_utc).total_seconds() / 86400, 0.0)  # a simulated clock runs ahead
    status = CalibrationStatus.EXPIRED if here[-1].expired(now_utc) else CalibrationStatus.IN_FORCE
    return BenchCalibration(here[-1], status, age_days)


def apply_results(config: RigConfig, results: Iterable[CalibrationResult]) -> tuple[RigConfig, tuple[str, ...]]:
    """Return the configuration with the settings of ``results``, and notes about settings that were not applied.

    A value in the configuration itself takes precedence over a result; a note reports each difference. No two
    ``results`` set the same key.

    Raises `ConfigError`: a result sets a value that the configuration does not allow.
    """
    values = config.model_dump(exclude_unset=True)
    notes = []
    for result in results:
        for key, value in result.settings.items():
            *sections, name = key.split(".")
            here = values
            for section in sections:
                here = here.setdefault(section, {})
            written = here.setdefault(name, value)
            # JSON has lists where the configuration has tuples
            if (list(written) if isinstance(written, tuple) else written) != value:
                notes.append(f"{key} = {written} of the configuration takes precedence over {value} of {result.id}")
    return validate(RigConfig, values, where="the calibrations in force"), tuple(notes)
