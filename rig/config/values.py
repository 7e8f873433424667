"""Reads a configuration file and the settings of the command line, and checks them; reports all mistakes with lines."""

import os
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar

import platformdirs
from pydantic import BaseModel, ValidationError

from rig.config.toml_file import MAX_DEPTH, NONE, Key, line_numbers, loads, read_text
from rig.config.wording import mistakes
from rig.core.errors import ConfigError
from rig.core.next_steps import Do

M = TypeVar("M", bound=BaseModel)

APP = "hbr-rig"  # folder of the program below the user's folders
FILE_NAME = "rig.toml"
MAX_VALUE_LENGTH = 2000  # longer than any path or list of the configuration
SHOWN = 60  # a longer value fills the terminal, and its start shows which one it is

_PATHS: tuple[Key, ...] = (("catalog", "path"), ("state_dir",), ("calibration_dir",))


def default_path() -> Path | None:
    """Return the configuration in force without `--config`: ./rig.toml, else the user's; None if neither exists."""
    return next((path for path in search_paths() if path.is_file()), None)


def search_paths() -> list[Path]:
    """Return where a configuration is searched without `--config`; the first one wins."""
    return [Path(FILE_NAME), Path(platformdirs.user_config_dir(APP)) / FILE_NAME]


@dataclass(frozen=True, slots=True)
class Values:
    """Unchecked values of a file and the command line.

    ``overridden`` are the keys that the command line gives, ``lines`` the lines of the others in the file, by name.
    """

    path: Path | None
    values: dict[str, Any]
    overridden: frozenset[Key]
    lines: dict[str, int]

    def origin(self, key: Key) -> str:
        """Return where a key's value comes from: ``rig.toml line 3``, ``--set``, or ``default``."""
        here: Any = self.values
        for part in key:
            if not isinstance(here, Mapping) or part not in here:
                return "default"
            here = here[part]
        is_overridden = any(key[:n] in self.overridden for n in range(1, len(key) + 1))
        if is_overridden or self.path is None:
            return "--set"
        line = self.lines.get(".".join(key))
        return f"{self.path.name} line {line}" if line else self.path.name


def read_values(path: Path | None = None, overrides: Iterable[str] = (), *, search: bool = True) -> Values:
    """Read a configuration file and apply ``overrides``, without checking the values.

    Without ``path`` it is the file in force, if any; with ``search`` false there is no file.

    Raises `ConfigError`: the file is missing or is not TOML, or an override is invalid.
    """
    values: dict[str, Any] = {}
    lines: dict[Key, int] = {}
    source = path or (default_path() if search else None)
    if source is not None:
        text = read_text(source)
        try:
            values, lines = loads(text), line_numbers(text)
        except ValueError as error:
            raise ConfigError(
                f"{source} is not a TOML file.",
                next_step="Fix this line.",
                evidence={"reason": str(error)},
            ) from error
        for key in _PATHS:
            _resolve(values, key, source.resolve().parent)
    overridden = frozenset([_apply(values, override) for override in overrides])
    named = {".".join(key): line for key, line in lines.items() if key not in overridden}
    return Values(source, values, overridden, named)


def validate(
    model: type[M],
    values: Mapping[str, Any],
    *,
    where: str,
    prefix: str = "",
    lines: Mapping[str, int] = MappingProxyType({}),
) -> M:
    """Return ``values`` as ``model``; raises one `ConfigError` with all mistakes.

    ``prefix`` is the model's path in the configuration, and ``lines`` are as those of `Values`.
    """
    try:
        return model.model_validate(values)
    except ValidationError as error:
        above = tuple(prefix.split(".")) if prefix else ()
        found = mistakes(model, values, error.errors(include_url=False), above)
    raise config_mistakes(found, where, lines)


def config_mistakes(found: list[str], where: str, lines: Mapping[str, int]) -> ConfigError:
    """Return the error for a configuration with mistakes, each with its line if that is known."""
    placed = {one: lines.get(one.partition(":")[0]) for one in found}
    return ConfigError(
        f"{len(found)} mistake{'s' if len(found) > 1 else ''} in {where}.",
        next_step=("Fix the listed keys.", Do.CHECK_CONFIGURATION()),
        evidence={"mistakes": [f"line {line}: {one}" if line else one for one, line in placed.items()]},
    )


def _resolve(values: dict[str, Any], key: Key, folder: Path) -> None:
    """Resolve a path in a file relative to that file, not to the current folder."""
    here: Any = values
    for part in key[:-1]:
        here = here.get(part) if isinstance(here, dict) else None
    if isinstance(here, dict) and isinstance(here.get(key[-1]), str) and here[key[-1]] != NONE:
        here[key[-1]] = os.path.normpath(folder / Path(here[key[-1]]).expanduser())


def _apply(values: dict[str, Any], override: str) -> Key:
    key, sign, text = override.partition("=")
    parts = key.strip().split(".")
    if not sign or not all(parts) or len(parts) > MAX_DEPTH:
        raise ConfigError(
            f"Cannot read the setting {override!r}.",
            next_step="Write SECTION.KEY=VALUE, for example identify.max_views=4.",
        )
    here = values
    for part in parts[:-1]:
        inner = here.setdefault(part, {})
        if not isinstance(inner, dict):
            raise ConfigError(f"{part} in {override!r} is not a section.", next_step="Write SECTION.KEY=VALUE.")
        here = inner
    here[parts[-1]] = parsed(text)
    return tuple(parts)


def parsed(text: str) -> Any:
    """Return a typed value: parsed as TOML, or else as a bare word.

    Raises `ConfigError`: the text has more than one line, or is too long, or its value is too large.
    """
    if len(text) > MAX_VALUE_LENGTH or len(text.strip().splitlines()) > 1:
        raise ConfigError(
            f"A value has more than one line, or more than {MAX_VALUE_LENGTH} characters.",
            next_step="Give one value on one line. Put longer ones into the configuration file.",
            evidence={"value": f"{text[:SHOWN]}…" if len(text) > SHOWN else text},
        )
    try:
        return loads(f"value = {text.strip()}")["value"]
    except tomllib.TOMLDecodeError:
        return text.strip()
    except ValueError as error:
        raise ConfigError(
            "A value is too large.", next_step="Give a value within the limits.", evidence={"reason": str(error)}
        ) from error
