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


def damaged(what: str, found: object) -> CatalogDamaged:
    """Return the error for a value that this program would not have stored."""
    shown = ascii(found)
    return CatalogDamaged(
        f"The catalog is damaged: {what} is {shown if len(shown) <= 80 else shown[:79] + '…'}.", next_step=FIX
    )


_IMAGE_NAME: Final = re.compile(r"[0-9a-f]{64}\.(png|jpg)")


class _Checked(TypeDecorator[Any]):
    """A column whose values are checked when they are read; NULL is left to the definition of the column.

    ``kind`` is the type of a value. Subclasses that need more than that check it in `check`, or in their conversion.
    """

    kind: type = object

    def __init_subclass__(cls) -> None:
        cls.cache_ok = True  # SQLAlchemy does not inherit it

    def check(self, value: Any) -> None:
        """Raise ValueError or TypeError for a value that this program would not have stored."""
        if not isinstance(value, self.kind):
            raise TypeError(f"a value that should be of type {self.kind.__name__}")

    def result_processor(self, dialect: Dialect, coltype: object) -> Callable[[Any], Any]:
        convert = super().result_processor(dialect, coltype)
        check = self.check

        def process(value: Any) -> Any:
            if value is None:
                return None
            try:
                found = value if convert is None else convert(value)
                check(found)
            except (ValueError, TypeError, OverflowError, RecursionError, AttributeError) as error:
                raise damaged(str(error) or "a value", value) from error
            return found

        return process


class Utc(_Checked):
    """Time with a time zone, stored as UTC. SQLite itself would drop the zone."""

    impl = DateTime

    def process_bind_param(self, value: datetime | None, dialect: Dialect) -> datetime | None:  # noqa: ARG002
        return value if value is None else value.astimezone(UTC).replace(tzinfo=None)

    def process_result_value(self, value: datetime | None, dialect: Dialect) -> datetime | None:  # noqa: ARG002
        return value if value is None else value.replace(tzinfo=UTC)


class Words(_Checked):
    """Text. Its order is that of its code points, for any language of the server."""

    impl: type[String] = Text
    kind = str

    def load_dialect_impl(self, dialect: Dialect) -> TypeEngine[Any]:
        own: Any = self.impl_instance
        stored: TypeEngine[Any] = type(own)(own.length, collation="C" if dialect.name == "postgresql" else None)
        return stored


class Name(Words):
    """Text of limited length."""

    impl = String


class StatusColumn(_Checked):
    """An `EnrollmentStatus`."""

    impl = Text

    def process_result_value(self, value: str | None, dialect: Dialect) -> EnrollmentStatus | None:  # noqa: ARG002
        return None if value is None else EnrollmentStatus(value)


class ImageName(_Checked):
    """Name of an image: the SHA-256 of its bytes, and the suffix of its format."""

    impl = String(68)
    kind = str

    def check(self, value: Any) -> None:
        super().check(value)
        if not _IMAGE_NAME.fullmatch(value):
            raise ValueError("a name that is not one of an image")


class Number(_Checked):
    """A finite number. SQLite stores −0.0 as 0.0, so every engine does: equal rows have equal digests."""

    impl = Float

    def process_bind_param(self, value: float | None, dialect: Dialect) -> float | None:  # noqa: ARG002
        return value if value is None else value + 0.0

    def check(self, value: Any) -> None:
        _check_number(value)


class Count(_Checked):
    """An integer."""

    impl = Integer
    kind = int


class Nanoseconds(Count):
    """An integer of 64 bits."""

    impl = BigInteger


class TruthColumn(_Checked):
    """True or false."""

    impl = Boolean
    kind = bool


class Bytes(_Checked):
    """Bytes."""

    impl = LargeBinary
    kind = bytes


class JsonText(_Checked):
    """JSON, stored as its text."""

    impl = JSON

    def coerce_compared_value(self, op: Any, value: Any) -> TypeEngine[Any]:
        return self.impl_instance.coerce_compared_value(op, value)


class JsonMapping(JsonText):
    """A JSON object."""

    kind = dict


class Azimuths(JsonText):
    """A tuple of azimuths as JSON."""

    def process_result_value(self, value: Any, dialect: Dialect) -> tuple[float, ...]:  # noqa: ARG002
        if not isinstance(value, list):
            raise TypeError("a value that should be of type list")
        return tuple(value)

    def check(self, value: Any) -> None:
        for azimuth_deg in value:
            _check_number(azimuth_deg)


class RegionOfImage(JsonText):
    """A `Region` as JSON."""

    def process_result_value(self, value: Any, dialect: Dialect) -> Any:  # noqa: ARG002
        return None if value is None else tuple(value)

    def check(self, value: Any) -> None:
        if value is not None and not is_region(value):
            raise ValueError("a region that is not one")


def _check_number(value: object) -> None:
    if not isinstance(value, int | float) or isinstance(value, bool) or not math.isfinite(value):
        raise ValueError("a value that should be a finite number")
