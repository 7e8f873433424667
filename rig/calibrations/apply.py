"""Facts in force: what they set in the configuration, unless a person set it."""

from collections.abc import Iterable
from typing import Any

from pydantic import BaseModel

from rig.calibrations.result import CalibrationResult
from rig.config import RigConfig
from rig.config.values import validate


def put_in_force(config: RigConfig, facts: Iterable[CalibrationResult]) -> tuple[RigConfig, tuple[str, ...]]:
    """Return the configuration with the settings of ``facts``, and what a person should know about it.

    A value that the configuration gives itself wins over a fact, and is told where it differs.

    Raises
    ------
    ConfigError
        A fact sets what the configuration does not take.
    """
    values = config.model_dump(exclude_unset=True)
    findings = []
    for fact in facts:
        for key, value in fact.settings.items():
            path = key.split(".")
            written = _written(config, path)
            if written is None:
                here = values
                for part in path[:-1]:
                    here = here.setdefault(part, {})
                here[path[-1]] = value
            elif _plain(written) != _plain(value):
                findings.append(f"{key} = {written} of the configuration wins over {value}, calibrated as {fact.id}")
    return validate(RigConfig, values, where="the calibrations in force"), tuple(findings)


def _written(config: RigConfig, path: list[str]) -> Any:
    """Return what the configuration itself says for a key, None where it is silent."""
    here: Any = config
    for part in path:
        if not isinstance(here, BaseModel) or part not in here.model_fields_set:
            return None
        here = getattr(here, part)
    return here


def _plain(value: Any) -> Any:
    """Return a value as a file has it, where there are no tuples."""
    return list(value) if isinstance(value, tuple) else value
