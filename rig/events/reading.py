"""Events from JSON: the inverse of `rig.events.events.event_dict`."""

from dataclasses import fields, is_dataclass
from enum import Enum
from math import isfinite, nan
from types import NoneType, UnionType
from typing import Any, Final, Union, get_args, get_origin, get_type_hints

from rig.events.events import Event, event_kind

_KINDS: Final[dict[str, type]] = {event_kind(kind): kind for kind in get_args(Event)}


def event_of(values: dict[str, Any], frame: Any) -> Event:
    """Return the event of JSON ``values`` from `event_dict`; ``frame`` returns the image of an accepted view.

    Numbers that were not finite become nan.

    Raises
    ------
    LookupError, TypeError, ValueError, ArithmeticError
        The values are not an event, or a field has a wrong type.
    """
    values = dict(values)
    name = values.pop("event")
    if name not in _KINDS:
        raise ValueError(f"there is no event {name!r}")
    if name == "accepted":
        values["image_bgr"] = frame(values["index"])
    event: Event = built(_KINDS[name], values)
    return event


def built(kind: Any, value: Any) -> Any:
    """Return JSON values as an object of type ``kind``; fields that a newer program added are left out."""
    origin = get_origin(kind)
    if is_dataclass(kind):
        hints = get_type_hints(kind)
        given = {f.name: built(hints[f.name], value[f.name]) for f in fields(kind) if f.name in value}
        return kind(**given)  # type: ignore[operator]
    if origin in (Union, UnionType):
        if value is None and NoneType in get_args(kind):
            return None
        return built(next(k for k in get_args(kind) if k is not NoneType), value)
    if origin is tuple:
        items = get_args(kind)
        return tuple(built(items[0] if items[-1] is Ellipsis else items[i], item) for i, item in enumerate(value))
    if isinstance(kind, type) and issubclass(kind, Enum):
        return kind(value)
    if kind is float:
        if value is None:
            return nan
        if type(value) not in (int, float) or not isfinite(value):
            raise TypeError(f"{value!r} is not a finite number")
        return float(value)
    if kind in (str, bool, int) and type(value) is not kind:
        raise TypeError(f"{value!r} is not of type {kind.__name__}")
    return value
