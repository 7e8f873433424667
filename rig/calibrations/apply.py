"""Apply the settings of calibration results to the configuration.

Decision: docs/decisions/0022.
"""

from collections.abc import Iterable
from typing import Any, Final

from pydantic import BaseModel

from rig.calibrations.result import CalibrationResult
from rig.config import RigConfig
from rig.config.values import validate

_NOTHING: Final = object()
"""Stands for a missing value, because None is a value."""


def apply_results(config: RigConfig, results: Iterable[CalibrationResult]) -> tuple[RigConfig, tuple[str, ...]]:
    """Return the configuration with the settings of ``results``, and notes about settings that were not applied.

    A value in the configuration itself takes precedence over a result; a note reports each difference.

    Raises `ConfigError`: a result sets a value that the configuration does not allow.
    """
    values = config.model_dump(exclude_unset=True)
    notes = []
    for result in results:
        for key, value in result.settings.items():
            path = key.split(".")
            written = _written(config, path)
            if written is _NOTHING:
                here = values
                for part in path[:-1]:
                    here = here.setdefault(part, {})
                here[path[-1]] = value
            elif _plain(written) != _plain(value):
                notes.append(f"{key} = {written} of the configuration takes precedence over {value} of {result.id}")
    return validate(RigConfig, values, where="the calibrations in force"), tuple(notes)


def _written(config: RigConfig, path: list[str]) -> Any:
    """Return the value that the configuration itself gives a key, `_NOTHING` if it gives none."""
    here: Any = config
    for part in path:
        if not isinstance(here, BaseModel) or part not in here.model_fields_set:
            return _NOTHING
        here = getattr(here, part)
    return here


def _plain(value: Any) -> Any:
    """Return a value as in JSON: lists instead of tuples."""
    return list(value) if isinstance(value, tuple) else value
