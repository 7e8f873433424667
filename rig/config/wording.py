"""Describes the configuration's keys in words: for mistakes, for `rig config`, and for a new file."""

import difflib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import wrap
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from rig.config.toml_file import Key, stated
from rig.core.phrases import in_unit

_UNITS = {"baud": "bit/s", "width": "px", "height": "px", "fps": "frames/s", "roi": "px"}
_UNIT_SUFFIXES = {
    "_deg": "°",
    "_dps": "°/s",
    "_dps2": "°/s²",
    "_s": "s",
    "_us": "µs",
    "_hz": "Hz",
    "_k": "K",
    "_c": "°C",
    "_v": "V",
    "_mm": "mm",
    "_percent": "%",
}
_OR_NONE = ", or none"
_KINDS: Mapping[Any, str] = {
    int: "a whole number",
    float: "a number",
    bool: "true or false",
    str: 'a text in "quotes"',
    Path: 'a path in "quotes"',
}


@dataclass(frozen=True, slots=True)
class KeyInfo:
    """A key of the configuration: its allowed values, its unit (empty if it has none), and its meaning.

    ``choices`` are all values that it can have, if these are a few; else it is empty.
    """

    key: Key
    default: Any
    allowed: str
    choices: tuple[str | int, ...]
    unit: str
    description: str

    @property
    def name(self) -> str:
        return ".".join(self.key)

    @property
    def values(self) -> str:
        """Its allowed values with their unit: ``a number from 1 to 5 s, or none``."""
        return in_unit(self.allowed.removesuffix(_OR_NONE), self.unit) + _OR_NONE * self.allowed.endswith(_OR_NONE)

    def value(self, values: Any) -> Any:
        """Return the value of the key in a model or in nested mappings; None if these do not have it."""
        for part in self.key:
            values = values.get(part) if isinstance(values, Mapping) else getattr(values, part, None)
        return values


def key_info(model: type[BaseModel], above: Key = ()) -> Iterator[KeyInfo]:
    """Yield the keys of a model and of its sections, in order."""
    for name, field in model.model_fields.items():
        kind = field.annotation
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            yield from key_info(kind, (*above, name))
        else:
            default = field.get_default(call_default_factory=True, validated_data={})
            choices = get_args(kind) if get_origin(kind) is Literal else ()
            yield KeyInfo((*above, name), default, allowed(field), choices, unit(name), field.description or "")


def blank_file(model: type[BaseModel]) -> str:
    """Return a configuration file that sets nothing: each key with its default and meaning, as a comment."""
    lines = ["# Configuration of the rig. Remove the # to set a key. `rig config check` checks the file."]
    section: Key = ()
    for info in key_info(model):
        if isinstance(info.default, dict):
            continue  # the benches' own sections
        if info.key[:-1] != section:
            section = info.key[:-1]
            lines += ["", f"[{'.'.join(section)}]"]
        meaning = f"{info.description} ({info.values})"
        lines += wrap(meaning, 100, initial_indent="# ", subsequent_indent="#   ")
        lines.append(f"#{info.key[-1]} = {stated(info.key, info.default)}")
    return "\n".join(lines) + "\n"


def setting_line(info: KeyInfo, value: Any, origin: str) -> str:
    """Return a key as a line of TOML: value, unit, origin and meaning."""
    line = f"{info.key[-1]} = {stated(info.key, value)}"
    note = "; ".join(part for part in (info.unit, origin, info.description) if part)
    return f"{line:30s} # {note}"


def unit(name: str) -> str:
    """Return the unit in a key's name."""
    return _UNITS.get(name) or next((u for suffix, u in _UNIT_SUFFIXES.items() if name.endswith(suffix)), "")


def allowed(field: FieldInfo) -> str:
    """Return the values that a field allows: ``a whole number from 9600 to 4500000``."""
    return _kind(field.annotation, field.metadata) + _OR_NONE * is_optional(field)


def is_optional(field: FieldInfo) -> bool:
    """Return whether a field can have no value."""
    return NoneType in get_args(field.annotation)


def mistakes(model: type[BaseModel], values: Mapping[str, Any], errors: Sequence[Any], above: Key) -> list[str]:
    """Return pydantic's ``errors`` as one line for each key: what it must be, and what was found.

    ``above`` is the path of ``model`` in the whole configuration.
    """
    known = {info.key: info for info in key_info(model)}
    found: dict[Key, str] = {}
    for error in errors:
        # Below a key, the path has members of a union or of a list.
        path = tuple(map(str, error["loc"]))
        key = next((path[:n] for n in range(len(path), 0, -1) if path[:n] in known), path)
        found.setdefault(key, _mistake(known, values, key, error))
    return [f"{'.'.join(above + key)}: {text}".lstrip(": ") for key, text in found.items()]


def _mistake(known: Mapping[Key, KeyInfo], values: Mapping[str, Any], key: Key, error: Any) -> str:
    if error["type"] == "extra_forbidden":
        last = len(key) - 1
        beside = dict.fromkeys(other[last] for other in known if other[:last] == key[:last])
        near = difflib.get_close_matches(key[last], beside, n=1)
        return "unknown key" + (f"; did you mean {near[0]}?" if near else "")
    found: Any = values
    for part in key:
        found = found[part] if isinstance(found, Mapping) and part in found else error["input"]
    shown = "" if isinstance(found, Mapping | BaseModel) else f" (found {found!r})"
    if error["type"] == "model_type":
        return f"must be a section with keys{shown}"
    if error["type"] == "value_error" or key not in known:
        return str(error.get("ctx", {}).get("error", error["msg"])) + shown
    return f"must be {known[key].values}{shown}"


def _kind(annotation: Any, metadata: Sequence[Any] = ()) -> str:
    members = get_args(annotation)
    if get_origin(annotation) in (Union, UnionType):
        return " or ".join(_kind(member, metadata) for member in members if member is not NoneType)
    if get_origin(annotation) is Literal:
        return f"one of {', '.join(map(repr, members))}"
    if get_origin(annotation) is tuple:
        return f"[{', '.join(_kind(member) for member in members)}]"
    if hasattr(annotation, "__metadata__"):  # Annotated
        inner = [
            m for part in annotation.__metadata__ for m in (part.metadata if isinstance(part, FieldInfo) else [part])
        ]
        return _kind(annotation.__origin__, inner)
    if get_origin(annotation) in (dict, list):
        return "a table" if get_origin(annotation) is dict else "a list"
    return _KINDS.get(annotation, "a value") + (_range(metadata) if annotation in (int, float) else "")


def _range(metadata: Sequence[Any]) -> str:
    words = {"ge": "of at least", "gt": "above", "le": "of at most", "lt": "below"}
    bounds = {name: f"{getattr(m, name):.10g}" for m in metadata for name in words if hasattr(m, name)}
    if bounds.keys() == {"ge", "le"}:
        return f" from {bounds['ge']} to {bounds['le']}"
    return " and".join(f" {words[name]} {bound}" for name, bound in bounds.items())
