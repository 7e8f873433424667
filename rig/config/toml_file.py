"""Edits single values of `rig.toml`; comments, order and spacing stay.

`tomllib` parses; this module only finds the lines of a value, also by `tomllib`. Each edit is parsed again and rejected
if it changed anything else. tomlkit is not used, because it drops the comments inside a value of several lines, does
not put a new key below its commented default, and reports no line numbers.
"""

import difflib
import json
import re
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from copy import deepcopy
from dataclasses import dataclass
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

MAX_TRIES: Final = 100
"""Lines of one value at which it may end: each is tried, and a try takes as long as the value."""

NONE: Final = "none"
"""The text that clears an optional key; TOML has no null."""

_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")
_LAST_LINE = re.compile(r"""(?:[]}]|"{3}|'{3})\s*(?:#.*)?$""")
"""Matches the last line of each value of several lines, and few others."""


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
    """Return the line of each key and table of a valid document. Raises `ValueError`: see `MAX_TRIES`."""
    return {statement.key: statement.begin + 1 for statement in _statements(StringIO(text).readlines())}


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
        expected = deepcopy(before)
        here = expected
        for part in key[:-1]:
            here = here.setdefault(part, {})
            if not isinstance(here, dict):
                raise _cannot_edit(key, value, f"{part} is a value, not a table")
        if key[-1] in here and _same(here[key[-1]], value):
            continue
        here[key[-1]] = value
        try:
            edited = _edited(text, key, value, before)
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


# -- positions ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _Statement:
    """A ``key = value`` or a ``[table]`` of a document: its lines from ``begin`` to before ``end``.

    ``key`` is the whole path, ``table`` the path of the table above it.
    """

    key: Key
    table: Key
    begin: int
    end: int
    is_header: bool = False


def _statements(lines: list[str]) -> Iterator[_Statement]:
    """Yield the statements of a valid document in order, except those inside arrays of tables."""
    table: Key | None = ()
    at = 0
    while at < len(lines):
        begin, line = at, lines[at].strip()
        at += 1
        if line.startswith("[["):
            table = None
        elif line.startswith("["):
            table = _path(tomllib.loads(line))
            yield _Statement(table, table, begin, at, is_header=True)
        elif line and not line.startswith("#"):
            # The lines of a value are those that tomllib can parse.
            tries = 0
            while _parsed("".join(lines[begin:at])) is None:
                at += 1
                while not _LAST_LINE.search(lines[at - 1]):
                    at += 1
                if (tries := tries + 1) > MAX_TRIES:
                    raise ValueError(f"the value in line {begin + 1} has too many lines that end with a bracket")
            if table is not None:
                yield _Statement((*table, *_key_of(lines[begin])[0]), table, begin, at)


def _parsed(text: str) -> dict[str, Any] | None:
    """Return the values of a part of a document; None if it is not complete."""
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        return None


def _path(values: Any) -> Key:
    """Return the only path in the values of a header or a key."""
    parts = []
    while isinstance(values, dict) and values:
        ((part, values),) = values.items()
        parts.append(part)
    return tuple(parts)


def _key_of(line: str) -> tuple[Key, str]:
    """Return the path of the key of a line, and the text up to its equals sign, which is not in a quoted key."""
    for sign in re.finditer("=", line):
        if (values := _parsed(f"{line[: sign.start()]}= 0")) is not None:
            return _path(values), line[: sign.end()]
    raise AssertionError(line)  # the document is valid


def _behind_value(line: str) -> str:
    """Return what follows the value of a line: its comment and its end."""
    ends = (hash_sign.start() for hash_sign in re.finditer("#", line))
    code = next((line[:end] for end in ends if _parsed(line[:end]) is not None), line)
    return line[len(code.rstrip()) :]


def _edited(text: str, key: Key, value: Any, values: Mapping[str, Any]) -> str:
    lines, newline = StringIO(text).readlines(), "\r\n" if "\r\n" in text else "\n"
    known = list(_statements(lines))
    # Replace the value, or that of the inline table around it.
    for one in (one for one in known if not one.is_header and one.key == key[: len(one.key)]):
        _, before = _key_of(lines[one.begin])
        new = f"{before} {stated(one.key, _merged(values, one.key, key[len(one.key) :], value))}"
        if one.end - one.begin == 1:
            lines[one.begin] = new + _behind_value(lines[one.begin])
        else:  # the old lines stay as comments, because there may be comments in them
            old = [f"#{line.rstrip()}{newline}" for line in lines[one.begin : one.end]]
            lines[one.begin : one.end] = [*old, new + newline]
        return "".join(lines)
    # Or insert the key: below its commented default, below its last sibling, or below the header of its table.
    siblings = [one for one in known if not one.is_header and one.key[:-1] == key[:-1]]
    near = (siblings or [one for one in known if one.is_header and one.key == key[:-1]])[-1:]
    if near:
        first = lines[near[0].begin]
        indent = first[: len(first) - len(first.lstrip(" \t"))] if siblings else ""
        at = _default_line(lines, near[0], key, known) or near[0].end
        new = f"{indent}{_written(key[len(near[0].table) :])} = {stated(key, value)}{newline}"
        return _inserted(lines, at, newline, new)
    line = f"{_written(key[-1:])} = {stated(key, value)}{newline}"
    if len(key) > 1:
        return _inserted(
            lines, len(lines), newline, *[newline] * bool(text.strip()), f"[{_written(key[:-1])}]{newline}", line
        )
    # The first key without a table: above the first table and its comments.
    at = next((one.begin for one in known if one.is_header), len(lines))
    gap = [newline] * (at < len(lines))
    while at and lines[at - 1].lstrip(" \t").startswith("#"):
        at -= 1
    return _inserted(lines, at, newline, line, *gap)


def _merged(values: Mapping[str, Any], table: Key, rest: Key, value: Any) -> Any:
    """Return the inline table ``table`` with ``rest`` in it set to ``value``; ``value`` if ``rest`` is empty."""
    if not rest:
        return value
    inline: Any = values
    for part in table:
        inline = inline[part]
    inline = here = deepcopy(inline)
    for part in rest[:-1]:
        here = here.setdefault(part, {})
    here[rest[-1]] = value
    return inline


def _default_line(lines: list[str], near: _Statement, key: Key, known: Iterable[_Statement]) -> int | None:
    """Return the place below the key's commented default (``# key = default``) in the same table, if any."""
    headers = [one for one in known if one.is_header]
    begin = max((one.end for one in headers if one.begin <= near.begin), default=0)
    end = min((one.begin for one in headers if one.begin > near.begin), default=len(lines))
    default = re.compile(rf"[ \t]*#[ \t]*{re.escape(key[-1])}[ \t]*=")
    return next((at + 1 for at in range(begin, end) if default.match(lines[at])), None)


def _inserted(lines: list[str], at: int, newline: str, *new: str) -> str:
    before = "".join(lines[:at])
    return before + newline * (bool(before) and not before.endswith("\n")) + "".join((*new, *lines[at:]))


def _written(key: Key) -> str:
    return ".".join(part if _BARE_KEY.fullmatch(part) else toml(part) for part in key)


def _same(one: Any, other: Any) -> bool:
    """Compare as TOML does: 1, 1.0 and true are different values, and not-a-number equals itself."""
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        return one.keys() == other.keys() and all(_same(one[key], other[key]) for key in one)
    if isinstance(one, list | tuple) and isinstance(other, list | tuple):
        return len(one) == len(other) and all(map(_same, one, other))
    return type(one) is type(other) and (one == other or (one != one and other != other))


def _cannot_edit(key: Key, value: Any, reason: str) -> ConfigError:
    return ConfigError(
        f"Cannot set {'.'.join(key)} in this file without changing something else.",
        next_step=f"Edit the file, in [{'.'.join(key[:-1])}]: {key[-1]} = {toml(value)}",
        evidence={"reason": reason},
    )
