"""Types of the columns of a catalog. A value that this program would not have stored is damage, not data.

Every reader gets its values through these types. A damaged or hostile database ends in a `CatalogDamaged`.
"""

import math
import re
from collections.abc import Callable
from datetime import UTC, datetime
from typing import Any, Final

from sqlalchemy import (
    JSON,
    BigInteger,
    Boolean,
    ColumnElement,
    DateTime,
    Dialect,
    Float,
    Integer,
    LargeBinary,
    String,
    Text,
    TypeDecorator,
)
from sqlalchemy.types import TypeEngine

from rig.catalog.records import EnrollmentStatus, is_region
from rig.core.errors import CatalogDamaged

FIX = "Use a backup of the catalog; if you received it, ask the sender for an exported bundle instead."

_IMAGE_NAME: Final = re.compile(r"[0-9a-f]{64}\.(png|jpg)")


def damaged(what: str, found: object) -> CatalogDamaged:
    """Return the error for a value that this program would not have stored."""
    shown = ascii(found)
    return CatalogDamaged(
        f"The catalog is damaged: {what} is {shown if len(shown) <= 80 else shown[:79] + '…'}.", next_step=FIX
    )


class Column(TypeDecorator[Any]):
    """A type of SQLAlchemy whose values are checked when they are read; NULL is left to the definition of the column.

    ``accept`` returns a value as the program uses it. It raises ValueError or TypeError for one that this program would
    not have stored.
    """

    impl = Text
    cache_ok = True

    def __init__(self, stored: TypeEngine[Any], accept: Callable[[Any], Any]) -> None:
        super().__init__()
        self.impl = self.stored = stored  # type: ignore[assignment] # SQLAlchemy's own constructor does this, too
        self.accept = accept

    def load_dialect_impl(self, dialect: Dialect) -> TypeEngine[Any]:
        if not isinstance(self.stored, String):
            return self.stored
        # The order of texts is that of their code points, for any language of the server.
        return type(self.stored)(self.stored.length, collation="C" if dialect.name == "postgresql" else None)

    def coerce_compared_value(self, op: Any, value: Any) -> TypeEngine[Any]:
        return self.stored.coerce_compared_value(op, value) if isinstance(self.stored, JSON) else self

    def process_bind_param(self, value: Any, dialect: Dialect) -> Any:  # noqa: ARG002
        if isinstance(value, datetime):  # SQLite would drop the zone
            return value.astimezone(UTC).replace(tzinfo=None)
        # SQLite stores −0.0 as 0.0, so every engine does: equal rows have equal digests.
        return value + 0.0 if isinstance(value, float) else value

    def result_processor(self, dialect: Dialect, coltype: object) -> Callable[[Any], Any]:
        convert = super().result_processor(dialect, coltype)

        def process(value: Any) -> Any:
            if value is None:
                return None
            try:
                found = value if convert is None else convert(value)
                return None if found is None else self.accept(found)
            except (ValueError, TypeError, OverflowError, RecursionError, AttributeError) as error:
                raise damaged(str(error) or "a value", value) from error

        return process


def stored_type(column: ColumnElement[Any]) -> TypeEngine[Any]:
    """Return the type that the database gives a column."""
    return column.type.stored if isinstance(column.type, Column) else column.type


def _of_type(kind: type) -> Callable[[Any], Any]:
    def accept(value: Any) -> Any:
        if not isinstance(value, kind):
            raise TypeError(f"a value that should be of type {kind.__name__}")
        return value

    return accept


_text, _list = _of_type(str), _of_type(list)


def image_name(value: Any) -> str:
    """Return a name of an image: the SHA-256 of its bytes, and the suffix of its format."""
    if not _IMAGE_NAME.fullmatch(_text(value)):
        raise ValueError("a name that is not one of an image")
    return str(value)


def _number(value: Any) -> Any:
    if not isinstance(value, int | float) or isinstance(value, bool) or not math.isfinite(value):
        raise ValueError("a value that should be a finite number")
    return value


def _region(value: Any) -> tuple[int, ...]:
    if not is_region(value):
        raise ValueError("a region that is not one")
    return tuple(value)


def limited(length: int) -> Column:
    """Return the type of a text of limited length."""
    return Column(String(length), _text)


UTC_TIME: Final = Column(DateTime(), lambda value: value.replace(tzinfo=UTC))
TEXT: Final = Column(Text(), _text)
STATUS: Final = Column(Text(), EnrollmentStatus)
IMAGE_NAME: Final = Column(String(68), image_name)
NUMBER: Final = Column(Float(), _number)
COUNT: Final = Column(Integer(), _of_type(int))
NANOSECONDS: Final = Column(BigInteger(), _of_type(int))
TRUTH: Final = Column(Boolean(), _of_type(bool))
BYTES: Final = Column(LargeBinary(), _of_type(bytes))
JSON_OBJECT: Final = Column(JSON(none_as_null=True), _of_type(dict))
AZIMUTHS: Final = Column(JSON(), lambda value: tuple(map(_number, _list(value))))
REGION: Final = Column(JSON(none_as_null=True), _region)
