"""Edits single values of `rig.toml`; comments, order and spacing stay.

`tomllib` parses; this module only finds the position of a value in the text. Each edit is parsed again and rejected if
it changed anything else. tomlkit is not used, because it drops the comments inside a value of several lines, does not
put a new key below its commented default, and reports no line numbers.
"""

import difflib
import json
import re
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from copy import deepcopy
from dataclasses import dataclass
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


@dataclass(frozen=True, slots=True)
class Statement:
    """A ``key = value`` or a ``[table]`` of a document; offsets count characters.

    ``key`` is the whole path, ``table`` the path of the table above it. ``start`` is the start of the line, ``value``
    the start of the value (None for a header), ``end`` the end of the value or header. ``comments`` are those inside a
    value of several lines.
    """

    key: Key
    table: Key
    line: int
    start: int
    value: int | None
    end: int
    comments: tuple[str, ...] = ()


def statements(text: str) -> Iterator[Statement]:
    """Yield the statements of a valid document in order, except those inside arrays of tables."""
    position, addressable = 0, True
    table: Key = ()
    while position < len(text):
        start = position
        while position < len(text) and text[position] in " \t":
            position += 1
        line = text.count("\n", 0, start) + 1
        if position < len(text) and text[position] not in "#\r\n":
            if text[position] == "[":
                double = text.startswith("[[", position)
                content = position + 1 + double
                position = _skip(text, content, "]")
                addressable = not double
                table = _parts(text[content:position])
                position += 1 + double
                if addressable:
                    yield Statement(table, table, line, start, None, position)
            else:
                begin = position
                position = _skip(text, position, "=")
                key = table + _parts(text[begin:position])
                value = position + 1
                while text[value] in " \t":
                    value += 1
                position, comments = _value_end(text, value)
                if addressable:
                    yield Statement(key, table, line, start, value, position, comments)
        position = _line_end(text, position)


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
    """Return the line of each key and table of a valid document."""
    return {statement.key: statement.line for statement in statements(text)}


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
        edited = _edited(text, key, value, before)
        try:
            after = tomllib.loads(edited)
        except tomllib.TOMLDecodeError as error:
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


def _edited(text: str, key: Key, value: Any, values: Mapping[str, Any]) -> str:
    known = list(statements(text))
    newline = "\r\n" if "\r\n" in text else "\n"
    for statement in known:
        if statement.value is not None and statement.key == key[: len(statement.key)]:
            inline = _merged(values, statement.key, key[len(statement.key) :], value)
            kept = "".join(f"{comment}{newline}" for comment in statement.comments)
            before = text[: statement.start] + kept + text[statement.start : statement.value]
            return before + stated(statement.key, inline) + text[statement.end :]
    siblings = [s for s in known if s.value is not None and s.key[:-1] == key[:-1]]
    if siblings:
        last = siblings[-1]
        indent = text[last.start : last.start + len(text[last.start :]) - len(text[last.start :].lstrip(" \t"))]
        line = f"{indent}{_written(key[len(last.table) :])} = {stated(key, value)}{newline}"
        return _inserted(text, _default_line_end(text, last, key, known) or _line_end(text, last.end), line, newline)
    line = f"{_written(key[-1:])} = {stated(key, value)}{newline}"
    headers = [s for s in known if s.value is None and s.key == key[:-1]]
    if headers:
        header = headers[-1]
        end = _default_line_end(text, header, key, known) or _line_end(text, header.end)
        return _inserted(text, end, line, newline)
    if len(key) == 1:
        first = next((s.start for s in known if s.value is None), len(text))
        return _inserted(text, _above_comments(text, first), line + newline * (first < len(text)), newline)
    return _inserted(text, len(text), f"{newline * bool(text.strip())}[{_written(key[:-1])}]{newline}{line}", newline)


def _merged(values: Mapping[str, Any], table: Key, rest: Key, value: Any) -> Any:
    """Return the inline table ``table`` with ``rest`` in it set to ``value``; ``value`` if ``rest`` is empty."""
    inline: Any = values
    for part in table:
        inline = inline[part]
    if not rest:
        return value
    inline = deepcopy(inline)
    here = inline
    for part in rest[:-1]:
        here = here.setdefault(part, {})
    here[rest[-1]] = value
    return inline


def _default_line_end(text: str, near: Statement, key: Key, known: Iterable[Statement]) -> int | None:
    """Return the end of the line with the key's commented default (``# key = default``) in the same table, if any."""
    headers = [s for s in known if s.value is None]
    begin = max((s.end for s in headers if s.start <= near.start), default=0)
    end = min((s.start for s in headers if s.start > near.start), default=len(text))
    found = re.compile(rf"^[ \t]*#[ \t]*{re.escape(key[-1])}[ \t]*=.*$", re.MULTILINE).search(text, begin, end)
    return _line_end(text, found.end()) if found else None


def _above_comments(text: str, position: int) -> int:
    """Return the start of the comment lines directly above ``position``."""
    while position and text[text.rfind("\n", 0, position - 1) + 1 : position].lstrip(" \t").startswith("#"):
        position = text.rfind("\n", 0, position - 1) + 1
    return position


def _inserted(text: str, position: int, lines: str, newline: str) -> str:
    before = text[:position]
    return before + (newline if before and not before.endswith("\n") else "") + lines + text[position:]


def _line_end(text: str, position: int) -> int:
    end = text.find("\n", position)
    return len(text) if end < 0 else end + 1


def _skip(text: str, position: int, wanted: str) -> int:
    """Return the position of ``wanted`` outside of quotes."""
    while text[position] != wanted:
        position = _string_end(text, position) if text[position] in "\"'" else position + 1
    return position


def _value_end(text: str, position: int) -> tuple[int, tuple[str, ...]]:
    """Return the end of the value that begins at ``position``, and the comments inside it."""
    depth, end = 0, position
    comments = []
    while position < len(text):
        character = text[position]
        if character == "#":
            if not depth:
                break
            line_end = _line_end(text, position)
            comments.append(text[position:line_end].rstrip())
            position = line_end
            continue
        if character in "\r\n" and not depth:
            break
        if character in "\"'":
            position = end = _string_end(text, position)
            continue
        depth += (character in "[{") - (character in "]}")
        position += 1
        if character not in " \t":
            end = position
    return end, tuple(comments)


def _string_end(text: str, position: int) -> int:
    quote = text[position]
    if text.startswith(quote * 3, position):
        quote *= 3
    end = position + len(quote)
    while not text.startswith(quote, end):
        end += 2 if text[end] == "\\" and quote[0] == '"' else 1
    end += len(quote)
    while len(quote) == 3 and text.startswith(quote[0], end):  # up to two more quotes belong to the string
        end += 1
    return end


def _parts(dotted: str) -> Key:
    """Return the parts of a dotted key, which may be quoted."""
    here: Any = tomllib.loads(f"{dotted.strip()} = 0")
    parts = []
    while isinstance(here, dict):
        ((part, here),) = here.items()
        parts.append(part)
    return tuple(parts)


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
