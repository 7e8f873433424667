"""Values in JSON, which has only finite numbers: any other number is null there."""

from dataclasses import fields, is_dataclass
from enum import Enum
from math import isfinite, nan
from typing import Annotated, Any

from pydantic import ValidatorFunctionWrapHandler, WithJsonSchema, WrapValidator


def _read(value: Any, read: ValidatorFunctionWrapHandler) -> Any:
    return nan if value is None else read(value)


NumberOrNull = Annotated[float, WrapValidator(_read), WithJsonSchema({"anyOf": [{"type": "number"}, {"type": "null"}]})]
"""A number that may be infinite or nan: it is null in JSON, and null is read as nan."""


def plain(value: Any) -> Any:
    """Return ``value`` as JSON values: dataclasses as dicts, tuples as lists, numbers that are not finite as None."""
    if is_dataclass(value) and not isinstance(value, type):
        return {f.name: plain(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, tuple | list):
        return [plain(v) for v in value]
    if isinstance(value, dict):
        return {k: plain(v) for k, v in value.items()}
    if isinstance(value, float) and not isfinite(value):
        return None
    return value
