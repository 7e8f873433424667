"""Edits single values of `rig.toml`; comments, order and spacing stay.

An edit replaces or inserts one line ``key = value`` below the header of its table. `tomllib` reads the result, and an
edit that changed anything else is rejected: values of several lines, inline tables and dotted keys are for people.
tomlkit is not used, because it does not put a new key below its commented default, and reports no line numbers.
"""

import difflib
import json
import re
import tomllib
from collections.abc import Mapping
from contextlib import suppress
from copy import deepcopy
from io import StringIO
from pathlib import Path
from typing import Any, Final

from rig.core.errors import ConfigError, os_errors_as
from rig.core.files import read, write
from rig.core.next_steps import Do

Key = tuple[str, ...]

MAX_FILE_BYTES: Final = 100_000  # a hundred times a real configuration: a larger file is another one, named by mistake
MAX_DEPTH: Final = 16
"""Largest depth of tables and lists in a value; the configuration itself needs 5."""
MAX_DOTS: Final = 1000
"""In a line: the time that `tomllib` takes for a dotted key grows with the square of its parts."""
MAX_INTEGER: Final = 2**63
"""TOML 1.0, Integer: 64-bit signed."""

NONE: Final = "none"
"""The text that clears an optional key; TOML has no null."""

_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")
_HEADER = re.compile(r"\s*\[([^\[\]]+)\]\s*(#.*)?")
_ASSIGNED = re.compile(r"\s*([^\s#=\[][^#=]*?)\s*=")


def loads(text: str) -> dict[str, Any]:
    """Return the values of a document.

    Raises `ValueError`: it is not TOML, has an integer of more than 64 bits, or is nested too deeply.
    `tomllib.TOMLDecodeError` is one.
    """
    if any(line.count(".") > MAX_DOTS for line in text.splitlines()):
        raise ValueError("a key has too many parts")
    try:
        values = tomllib.loads(text)
    except RecursionError as error:
        raise ValueError("tables or lists are nested too deeply") from error
    inside: list[Any] = [values]
    for _ in range(MAX_DEPTH):
        items = [item for one in inside for item in (one.values() if isinstance(one, dict) else one)]
        if any(isinstance(item, int) and not -MAX_INTEGER <= item < MAX_INTEGER for item in items):
            raise ValueError("an integer has more than 64 bits")
        inside = [item for item in items if isinstance(item, dict | list)]
    if inside:
        raise ValueError(f"tables or lists are nested more than {MAX_DEPTH} deep")
    return values


def line_numbers(text: str) -> dict[Key, int]:
    """Return the line of each key and table, for messages. A text of several lines may hold what looks like one."""
    found: dict[Key, int] = {}
    table: Key = ()
    for number, line in enumerate(StringIO(text), 1):
        if header := _HEADER.fullmatch(line.rstrip()):
            table = _parts(header[1])
            found.setdefault(table, number)
        elif assigned := _ASSIGNED.match(line):
            found.setdefault((*table, *_parts(assigned[1])), number)
    return found


def with_values(text: str, changes: Mapping[Key, Any]) -> str:
    """Return the document with some values set; values that do not change stay as they are written.

    Raises `ConfigError`: the document is not TOML, or has a key in a form that cannot be edited without changing
    something else.
    """
    try:
        before = loads(text)
    except ValueError as error:
        raise ConfigError(
            "The file is not TOML.", next_step="Fix the line in the reason.", evidence={"reason": str(error)}
        ) from error
    for key, value in changes.items():
        # What the edited text must say, and nothing else.
        expected = deepcopy(before)
        here = expected
        for part in key[:-1]:
            here = here.setdefault(part, {})
            if not isinstance(here, dict):
                raise _cannot_edit(key, value, f"{part} is a value, not a table")
        if key[-1] in here and _same(here[key[-1]], value):
            continue
        here[key[-1]] = value
        # The edit does not understand all of TOML, so its result is read again.
        try:
            edited = _edited(text, key, value)
            after = tomllib.loads(edited)
        except ValueError as error:
            raise _cannot_edit(key, value, str(error)) from error
        if not _same(after, expected):
            raise _cannot_edit(key, value, "it would change something else as well")
        text, before = edited, after
    return text


def changed_lines(old: str, new: str) -> list[str]:
    """Return the lines that differ: removed ones with ``-``, added ones with ``+``."""
    lines = difflib.ndiff(old.splitlines(), new.splitlines())
    return [line.rstrip() for line in lines if line[0] in "+-" and line[2:].strip()]


def read_text(path: Path) -> str:
    """Return a configuration file's text with its own line ends.

    Raises `ConfigError`: the file cannot be read, or is not text.
    """
    try:
        return read(path, max_bytes=MAX_FILE_BYTES).decode("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(
            f"Cannot read the configuration {path}.",
            next_step="Give an existing file, or none to use the defaults.",
            evidence={"reason": getattr(error, "strerror", None) or str(error)},
        ) from error


def save(path: Path, text: str) -> None:
    """Write a configuration file completely or not at all; a symbolic link stays a link.

    Raises `ConfigError`: the file cannot be written.
    """
    target = path.resolve()
    step = ("Give a file in a writable folder.", Do.RUN_AGAIN(config="FILE"))
    with os_errors_as(ConfigError, f"Cannot write the configuration {path}.", next_step=step):
        target.parent.mkdir(parents=True, exist_ok=True)
        write(target, text.encode("utf-8"))


def toml(value: Any) -> str:
    """Return a value in TOML on one line; values of other types become strings."""
    match value:
        case None:
            return toml(NONE)
        case bool():
            return "true" if value else "false"
        case int() | float():
            return repr(value)
        case list() | tuple():
            return f"[{', '.join(map(toml, value))}]"
        case Mapping():
            inner = ", ".join(f"{_written((str(name),))} = {toml(item)}" for name, item in value.items())
            return f"{{ {inner} }}" if inner else "{}"
        case _:
            return json.dumps(str(value), ensure_ascii=False).replace("\x7f", "\\u007f")


def stated(key: Key, value: Any) -> str:
    """Return a key's value in TOML as people write it: addresses are hexadecimal."""
    return f"{value:#04x}" if key[-1] == "address" and type(value) is int else toml(value)


def _edited(text: str, key: Key, value: Any) -> str:
    """Return the document with the line of a key replaced or inserted; the caller checks that it is right."""
    # Where the table of the key begins; a new one goes to the end of the file.
    lines, newline = StringIO(text, newline="").readlines(), "\r\n" if "\r\n" in text else "\n"
    new = f"{_written(key[-1:])} = {stated(key, value)}"
    headers = [at for at, line in enumerate(lines) if _HEADER.fullmatch(line.rstrip())]
    begin = next((at + 1 for at in headers if _table(lines[at]) == key[:-1]), 0 if len(key) == 1 else None)
    if begin is None:
        before = "".join(lines)
        gap = newline * (bool(before) + (bool(before) and not before.endswith("\n")))
        return f"{before}{gap}[{_written(key[:-1])}]{newline}{new}{newline}"
    end = next((at for at in headers if at >= begin), len(lines))
    # Replace the value, and keep its comment.
    for at in range(begin, end):
        assigned = _ASSIGNED.match(lines[at])
        if assigned and _parts(assigned[1]) == key[-1:]:
            lines[at] = f"{assigned[0]} {stated(key, value)}{_behind_value(lines[at])}"
            return "".join(lines)
    # Or insert the key below its commented default, or else below the last line of its table.
    default = re.compile(rf"\s*#\s*{re.escape(key[-1])}\s*=")
    last = [at + 1 for at in range(begin, end) if lines[at].strip() and not lines[at].lstrip().startswith("#")]
    place = next((at + 1 for at in range(begin, end) if default.match(lines[at])), max(last, default=begin))
    if place and not lines[place - 1].endswith("\n"):
        lines[place - 1] += newline
    return "".join([*lines[:place], new, newline, *lines[place:]])


def _table(line: str) -> Key:
    header = _HEADER.fullmatch(line.rstrip())
    return _parts(header[1]) if header else ()


def _parts(words: str) -> Key:
    """Return the parts of a key; one that contains a dot in quotes is not a key of the rig."""
    return tuple(part.strip().strip("\"'") for part in words.split("."))


def _behind_value(line: str) -> str:
    """Return what follows the value of a line: its comment and its end. Raises `ValueError`: it has several lines."""
    for end in (*(sign.start() for sign in re.finditer("#", line)), len(line)):
        with suppress(tomllib.TOMLDecodeError):
            tomllib.loads(line[:end])
            return line[len(line[:end].rstrip()) :]
    raise ValueError("its value has several lines")


def _written(key: Key) -> str:
    return ".".join(part if _BARE_KEY.fullmatch(part) else toml(part) for part in key)


def _same(one: Any, other: Any) -> bool:
    """Compare as TOML does: 1, 1.0 and true are different values, and not-a-number equals itself."""
    first, second = (json.dumps(value, sort_keys=True, default=repr) for value in (one, other))
    return first == second


def _cannot_edit(key: Key, value: Any, reason: str) -> ConfigError:
    return ConfigError(
        f"Cannot set {'.'.join(key)} in this file without changing something else.",
        next_step=f"Edit the file, in [{'.'.join(key[:-1])}]: {key[-1]} = {toml(value)}",
        evidence={"reason": reason},
    )
