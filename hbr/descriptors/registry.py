"""The known descriptors by their names, several descriptors as one, and the description of an image by any of them."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np

from hbr.core.arrays import FloatArray, ImageArray, IndexArray, LevelArray
from hbr.descriptors.base import Comparison, Descriptor
from hbr.descriptors.cedd import Cedd, RotatedCedd
from hbr.descriptors.edges_and_colours import Colours, Edges
from hbr.descriptors.network import Network
from hbr.segmentation import Background, Segmentation, segment


@dataclass(frozen=True)
class Joined(Descriptor):
    """Descriptors side by side. The similarity is the mean of theirs, with weights that add up to 1."""

    name: str = ""
    version: int = 1
    parts: tuple[Descriptor, ...] = ()
    weights: tuple[float, ...] = ()

    @property
    def size_bytes(self) -> int:
        return sum(part.size_bytes for part in self.parts)

    @property
    def length(self) -> int:
        return sum(part.length for part in self.parts)

    @property
    def can_describe(self) -> bool:
        return all(part.can_describe for part in self.parts)

    def describe(self, view: ImageArray | Segmentation, /) -> LevelArray:
        found = view if isinstance(view, Segmentation) else segment(view)
        return np.concatenate([part.describe(found) for part in self.parts])

    def prepared(self, rows: LevelArray, /) -> "_Average":
        self.check_rows(rows)
        columns = self.columns()
        parts = [part.prepared(rows[:, own]) for part, own in zip(self.parts, columns, strict=True)]
        return _Average(parts, self.weights, columns)

    def opened(self, packed: LevelArray, /) -> "_Average":
        self.check_packed(packed)
        columns = zip(self.parts, self._packed_columns(), strict=True)
        return _Average([part.opened(packed[:, own]) for part, own in columns], self.weights, self.columns())

    def entries(self, rows: LevelArray) -> FloatArray:
        return np.concatenate(
            [part.entries(rows[:, own]) for part, own in zip(self.parts, self.columns(), strict=True)], axis=1
        )

    def similarity_of_means(self, means: FloatArray) -> FloatArray:
        similar = [
            part.similarity_of_means(means[:, own]) for part, own in zip(self.parts, self.columns(), strict=True)
        ]
        return _weighted(self.weights, similar)

    def pack_rows(self, rows: LevelArray) -> LevelArray:
        columns = zip(self.parts, self.columns(), strict=True)
        return np.concatenate([part.pack_rows(rows[:, own]) for part, own in columns], axis=1)

    def unpack_rows(self, packed: bytes) -> LevelArray:
        rows = self.packed_rows(packed)
        columns = zip(self.parts, self._packed_columns(), strict=True)
        return np.concatenate([part.unpack_rows(rows[:, own].tobytes()) for part, own in columns], axis=1)

    def check_levels(self, rows: LevelArray) -> None:
        for part, columns in zip(self.parts, self.columns(), strict=True):
            part.check_levels(rows[:, columns])

    def columns(self) -> list[slice]:
        """Return the columns of each part in the levels."""
        return _slices([part.length for part in self.parts])

    def _packed_columns(self) -> list[slice]:
        return _slices([part.size_bytes for part in self.parts])


@dataclass(frozen=True)
class Weighted(Joined):
    """Descriptors with weights, for Eq. 4 with several descriptors: each describes a view as it does alone."""

    @property
    def whole_image(self) -> bool:
        return any(part.whole_image for part in self.parts)

    def describe(self, view: ImageArray | Segmentation, /) -> LevelArray:
        return np.concatenate([part.describe(view) for part in self.parts])


class _Average:
    def __init__(self, parts: Sequence[Comparison], weights: Sequence[float], columns: Sequence[slice]) -> None:
        self._parts, self._weights, self._columns = parts, weights, columns

    def similarity(self, queries: LevelArray, /) -> FloatArray:
        similar = [p.similarity(queries[:, own]) for p, own in zip(self._parts, self._columns, strict=True)]
        return _weighted(self._weights, similar)

    def among(self, rows: IndexArray, /) -> FloatArray:
        return _weighted(self._weights, [part.among(rows) for part in self._parts])


def _weighted(weights: Sequence[float], similar: Sequence[FloatArray]) -> FloatArray:
    total = weights[0] * similar[0]
    for weight, part in zip(weights[1:], similar[1:], strict=True):
        total += weight * part
    return total


def _slices(lengths: list[int]) -> list[slice]:
    ends = np.cumsum(lengths).tolist()
    return [slice(end - length, end) for end, length in zip(ends, lengths, strict=True)]


#: Names of the rig's own descriptors of the object: without the network, and with it.
LIGHT: Final = "edges+colours+cedd"
FULL: Final = "edges+colours+cedd+network"

_CEDD: Final = Cedd()
_EDGES: Final = Edges()
_COLOURS: Final = Colours()
_NETWORK: Final = Network()
_KNOWN: Final[dict[str, Descriptor]] = {
    known.name: known
    for known in (
        _CEDD,
        Cedd(name="cedd-blurred", blur=0.9),
        RotatedCedd(),
        _COLOURS,
        _EDGES,
        _NETWORK,
        Joined("cedd+colours", 1, (_CEDD, _COLOURS), (0.5, 0.5)),
        Joined(LIGHT, 1, (_EDGES, _COLOURS, _CEDD), (0.36, 0.36, 0.28)),
        Joined(FULL, 1, (_EDGES, _COLOURS, _CEDD, _NETWORK), (0.09, 0.09, 0.07, 0.75)),
    )
}

#: Weights such as 0.1 do not add up to exactly 1.
_ROUNDING: Final = 1e-9


def descriptor(name: str) -> Descriptor:
    """Return the descriptor of this name. Opens no file: names come from saved runs and from other users' catalogs.

    ``edges=0.5,network=0.5`` is several descriptors with weights. The similarity is the sum of theirs.

    Raises
    ------
    ValueError
        The name is unknown (the message lists the known ones), or the weights do not add up to 1.
    """
    if "=" in name:
        return _with_weights(name)
    known = _KNOWN.get(name)
    if known is None:
        raise ValueError(f"descriptor {name!r} is unknown; use one of {', '.join(names())}")
    return known


@lru_cache(maxsize=16)
def _with_weights(name: str) -> Descriptor:
    parts = [part.strip().rpartition("=") for part in name.split(",")]
    try:
        weights = tuple(float(weight) for _, _, weight in parts)
    except ValueError:
        weights = ()
    # weights that add up to 1 keep the meaning of ω
    if not weights or min(weights) <= 0 or abs(sum(weights) - 1) > _ROUNDING:
        raise ValueError(
            f"descriptors {name!r}: give each a weight above 0, and all together 1, e.g. edges=0.5,network=0.5"
        )
    kinds = tuple(descriptor(kind) for kind, _, _ in parts)
    version = int("".join(str(kind.version) for kind in kinds))
    return kinds[0] if len(kinds) == 1 else Weighted(name, version, kinds, weights)


def register(added: Descriptor) -> None:
    """Make a descriptor known by its name in this process.

    Raises `ValueError`: the name belongs to another descriptor.
    """
    if _KNOWN.setdefault(added.name, added) != added:
        raise ValueError(f"the name {added.name!r} is taken; choose another one")


def names() -> tuple[str, ...]:
    """Return the names of all descriptors, the paper's first."""
    return tuple(_KNOWN)


def best() -> str:
    """Return the name of the best descriptor that can describe views here: `FULL` if the network is installed."""
    return FULL if _KNOWN[FULL].can_describe else LIGHT


_named = descriptor  # `describe` has a parameter of this name


def describe(
    image_bgr: ImageArray,
    *,
    descriptor: str | Descriptor = "cedd",
    empty_table: Background | ImageArray | None = None,
) -> LevelArray:
    """Return the levels of an image by the paper's CEDD, or by another descriptor.

    ``describe(image)`` is the paper's descriptor of the whole image, scaled to a size that CEDD's grid covers.
    ``describe(image, descriptor="edges+colours+cedd", empty_table=empty)`` is the rig's own: the object is cut out and
    scaled, and its illumination corrected to that of the empty-table image (`hbr.segment`), if that is reliable. Enroll
    and search by the same descriptor, and compare by its ``similarity``::

        table = hbr.Background(cv2.imread("empty.png"))
        levels = hbr.describe(frame, descriptor="edges+colours+cedd", empty_table=table)
        hbr.descriptor("edges+colours+cedd").similarity(levels[None], enrolled)

    Parameters
    ----------
    image_bgr : uint8 array (H, W, 3)
        The image, in OpenCV's channel order. No side may be 0.
    descriptor : str or Descriptor
        One of `hbr.descriptors.names`.
    empty_table : Background, or uint8 array (H, W, 3), optional
        The empty-table image, from the same camera position: of today, or of the day of the enrollment. Pass a
        `Background` for many frames. An image that does not fit the frame is not used.

    Returns
    -------
    uint8 array (length,)
        The descriptor's levels; 144 for CEDD.

    Raises
    ------
    TypeError, ValueError
        The array is no such image, or the descriptor is unknown.
    """
    chosen = _named(descriptor) if isinstance(descriptor, str) else descriptor
    return chosen.describe(image_bgr if empty_table is None else segment(image_bgr, empty_table=empty_table))
