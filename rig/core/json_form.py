"""Values in JSON, which has only finite numbers: any other number is null there."""

from math import nan
from typing import Annotated, Any

from pydantic import ValidatorFunctionWrapHandler, WithJsonSchema, WrapValidator


def _read(value: Any, read: ValidatorFunctionWrapHandler) -> Any:
    return nan if value is None else read(value)


NumberOrNull = Annotated[float, WrapValidator(_read), WithJsonSchema({"anyOf": [{"type": "number"}, {"type": "null"}]})]
"""A number that may be infinite or nan: it is null in JSON, and null is read as nan."""
