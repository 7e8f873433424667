"""The model set: the views of the enrolled objects, as arrays."""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hbr.core.angles import wrap360
from hbr.core.arrays import FloatArray, IndexArray, LevelArray, ranges
from hbr.descriptors import Comparison
from hbr.descriptors import descriptor as descriptor_of

_T = TypeVar("_T", bound=np.generic)


@dataclass(frozen=True, eq=False)
class Views:
    """Descriptors of enrolled views, with the object and the azimuth of each.

    Arrays of the correct type are not copied. They are read-only through this class.

    Raises
    ------
    TypeError, ValueError
        A type or shape is wrong, a level is too large, an azimuth is not finite, an index has no name, or two names are
        equal.
    """

    descriptors: LevelArray
    """uint8 array (n, length): levels of the descriptor; for CEDD, 144 levels 0..7."""
    azimuth_deg: FloatArray
    """float64 array (n,): orientation of the camera around the object, counter-clockwise seen from above; wrapped to
    [0, 360)."""
    object_index: IndexArray
    """integer array (n,): index of each view's object in `object_names`."""
    object_names: tuple[str, ...]
    """Distinct names. An object may have no views."""
    descriptor: str = "cedd"
    """Name of the descriptor of all views."""

    def __post_init__(self) -> None:
        names = tuple(self.object_names)
        if len(set(names)) != len(names):
            repeated = next(name for name in names if names.count(name) > 1)
            raise ValueError(f"object name {repeated!r} occurs twice; give each object a different name")
        azimuth_deg = np.asarray(self.azimuth_deg, np.float64)
        _check_views(self.descriptors, azimuth_deg, np.asarray(self.object_index), len(names), self.descriptor)
        object.__setattr__(self, "descriptors", _read_only(self.descriptors))
        object.__setattr__(self, "azimuth_deg", _read_only(wrap360(azimuth_deg)))
        object.__setattr__(self, "object_index", _read_only(np.asarray(self.object_index, np.intp)))
        object.__setattr__(self, "object_names", names)

    def __len__(self) -> int:
        return len(self.azimuth_deg)

    def levels(self, rows: IndexArray) -> LevelArray:
        """Return the levels of these views, uint8 (m, length)."""
        return self.descriptors[rows]

    def packed(self) -> LevelArray:
        """Return the packed levels of all views, uint8 (n, size_bytes)."""
        return descriptor_of(self.descriptor).pack_rows(self.descriptors)

    def prepared(self) -> Comparison:
        """Prepare the views for comparison with many queries."""
        return descriptor_of(self.descriptor).prepared(self.descriptors)

    @classmethod
    def empty(cls, descriptor: str = "cedd") -> "Views":
        """Return a model set without objects and views."""
        none = np.empty((0, descriptor_of(descriptor).length), np.uint8)
        return cls(none, np.empty(0), np.empty(0, np.intp), (), descriptor)

    @classmethod
    def of_object(cls, name: str, descriptors: LevelArray, azimuth_deg: ArrayLike, descriptor: str = "cedd") -> "Views":
        """Return the views of one object."""
        azimuths = np.asarray(azimuth_deg, np.float64)
        return cls(descriptors, azimuths, np.zeros(len(descriptors), np.intp), (name,), descriptor)

    @classmethod
    def concatenate(cls, parts: Sequence["Views"]) -> "Views":
        """Return all views of the parts in their order; objects of the same name are merged.

        Raises `ValueError`: the parts have different descriptors.
        """
        kinds = dict.fromkeys(part.descriptor for part in parts) or {"cedd": None}
        if len(kinds) > 1:
            raise ValueError(f"views of {' and '.join(kinds)} cannot be compared; describe all by one descriptor")
        (kind,) = kinds
        parts = [cls.empty(kind), *parts]
        names = tuple(dict.fromkeys(name for part in parts for name in part.object_names))
        index = {name: i for i, name in enumerate(names)}
        renumbered = [
            np.array([index[name] for name in part.object_names], np.intp)[part.object_index] for part in parts
        ]
        return cls(
            np.concatenate([part.descriptors for part in parts]),
            np.concatenate([part.azimuth_deg for part in parts]),
            np.concatenate(renumbered),
            names,
            kind,
        )

    def select(self, rows: IndexArray | NDArray[np.bool_]) -> "Views":
        """Return the views of these indices, or of a mask. Every object keeps its index and name."""
        chosen = copy(self)  # without a new check: the views were checked before
        chosen.__dict__.pop("by_object", None)
        rows = np.flatnonzero(rows) if rows.dtype == np.bool_ else rows
        for name in ("descriptors", "azimuth_deg", "object_index"):
            object.__setattr__(chosen, name, _read_only(np.take(getattr(self, name), rows, axis=0)))
        return chosen

    def of(self, object_index: int) -> IndexArray:
        """Return the indices of the views of an object, ascending."""
        return self.of_each(np.array([object_index]))[0]

    def of_each(self, object_index: IndexArray) -> tuple[IndexArray, IndexArray]:
        """Return the indices of the views of these objects, one object after the other, and where each begins."""
        order, start = self.by_object
        positions, begin = ranges(start[object_index], start[object_index + 1] - start[object_index])
        return order[positions], begin

    @cached_property
    def by_object(self) -> tuple[IndexArray, IndexArray]:
        """The indices of all views, one object after the other, and where each object begins, (objects + 1,)."""
        order = np.argsort(self.object_index, kind="stable")
        start = np.searchsorted(self.object_index[order], np.arange(len(self.object_names) + 1))
        return order, start


class PackedViews(Views):
    """Views that stay packed, for example in a mapped file: levels are unpacked on request.

    Parameters
    ----------
    packed : uint8 array (n, size_bytes)
        Packed levels of the descriptor; rows may lie apart.
    azimuth_deg, object_index, object_names, descriptor
        As for `Views`; the caller has checked them.
    rows : integer array (m,), optional
        Only these rows of ``packed``; the other arrays have their length.
    """

    def __init__(
        self,
        packed: LevelArray,
        azimuth_deg: FloatArray,
        object_index: IndexArray,
        object_names: tuple[str, ...],
        descriptor: str,
        rows: IndexArray | None = None,
    ) -> None:
        self.__dict__.update(
            _packed=packed,
            _rows=rows,
            azimuth_deg=_read_only(azimuth_deg),
            object_index=_read_only(object_index),
            object_names=object_names,
            descriptor=descriptor,
        )

    @cached_property
    def descriptors(self) -> LevelArray:
        """Levels of all views; for a large catalog they take several times the memory of the packed ones."""
        return _read_only(descriptor_of(self.descriptor).unpack_rows(self.packed().tobytes()))

    def levels(self, rows: IndexArray) -> LevelArray:
        places = rows if self._rows is None else self._rows[rows]
        return descriptor_of(self.descriptor).unpack_rows(self._packed[places].tobytes())

    def packed(self) -> LevelArray:
        return self._packed if self._rows is None else self._packed[self._rows]

    def prepared(self) -> Comparison:
        return descriptor_of(self.descriptor).opened(self.packed())

    def select(self, rows: IndexArray | NDArray[np.bool_]) -> "PackedViews":
        chosen = np.flatnonzero(rows) if rows.dtype == np.bool_ else rows.astype(np.intp, copy=False)
        places = chosen if self._rows is None else self._rows[chosen]
        return PackedViews(
            self._packed,
            self.azimuth_deg[chosen],
            self.object_index[chosen],
            self.object_names,
            self.descriptor,
            places,
        )

    _packed: LevelArray
    _rows: IndexArray | None


def _check_views(
    descriptors: object, azimuth_deg: FloatArray, object_index: NDArray[np.generic], name_count: int, descriptor: str
) -> None:
    if not isinstance(descriptors, np.ndarray) or descriptors.dtype != np.uint8:
        found = getattr(descriptors, "dtype", type(descriptors).__name__)
        raise TypeError(f"descriptors are of {found}; stack the uint8 rows that cedd or describe returns")
    kind = descriptor_of(descriptor)
    if descriptors.ndim != 2 or descriptors.shape[1] != kind.length:
        raise ValueError(f"descriptors have shape {descriptors.shape}; {descriptor} needs the shape (n, {kind.length})")
    count = len(descriptors)
    for name, column in (("azimuth_deg", azimuth_deg), ("object_index", object_index)):
        if column.shape != (count,):
            raise ValueError(f"{name} has shape {column.shape}; one value for each of the {count} views is needed")
    if not np.issubdtype(object_index.dtype, np.integer) and count:
        raise TypeError(f"object_index is of {object_index.dtype}; integers are needed")
    if not count:
        return
    kind.check_levels(descriptors)
    if not np.isfinite(azimuth_deg).all():
        raise ValueError(f"azimuth of view {np.isfinite(azimuth_deg).argmin()} is not finite; leave such views out")
    if object_index.min() < 0 or object_index.max() >= name_count:
        span = f"{object_index.min()}..{object_index.max()}"
        raise ValueError(f"object_index spans {span} but there are {name_count} names; name every object")


def _read_only(array: NDArray[_T]) -> NDArray[_T]:
    view = array.view()
    view.flags.writeable = False
    return view
