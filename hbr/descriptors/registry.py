"""The known descriptors by their names, several descriptors as one, and the description of an image by any of them."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np

from hbr.core.arrays import FloatArray, ImageArray, IndexArray, LevelArray
from hbr.descriptors.base import Comparison, CompiledDescriptor, Descriptor, Shift
from hbr.descriptors.cedd import Cedd, RotatedCedd
from hbr.descriptors.edges_and_colours import Colours, Edges
from hbr.descriptors.network import Network
from hbr.kernels.calls import Measure
from hbr.segmentation import Background, Segmentation, segment


@dataclass(frozen=True)
class Joined(CompiledDescriptor):
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

    def compared(self, rows: LevelArray, /) -> "_Average":
        columns = self._columns()
        parts = [part.prepared(rows[:, own]) for part, own in zip(self.parts, columns, strict=True)]
        return _Average(parts, self.weights, columns)

    def measure(self) -> Measure | None:
        """Return how edges and colours, in this order, are compared; other pairs are left to NumPy."""
        measures = [part.measure() if isinstance(part, CompiledDescriptor) else None for part in self.parts]
        edges, colours = measures if len(measures) == 2 else (None, None)
        if edges is None or colours is None or edges.edges_at or colours.colours_at:
            return None
        edges_share, colours_share = self.weights
        return colours._replace(
            edges_at=0,
            colours_at=self.parts[0].size_bytes,
            edge_values=edges.edge_values,
            edges_share=edges_share,
            colours_share=colours_share,
        )

    def entries(self, rows: LevelArray) -> FloatArray:
        return np.concatenate(
            [part.entries(rows[:, own]) for part, own in zip(self.parts, self._columns(), strict=True)], axis=1
        )

    def shifted(self, levels: LevelArray, shift: Shift) -> LevelArray:
        parts = zip(self.parts, self._columns(), strict=True)
        return np.concatenate([part.shifted(levels[own], shift) for part, own in parts])

    def similarity_of_means(self, means: FloatArray) -> FloatArray:
        similar = [
            part.similarity_of_means(means[:, own]) for part, own in zip(self.parts, self._columns(), strict=True)
        ]
        return _weighted(self.weights, similar)

    def pack_rows(self, rows: LevelArray) -> LevelArray:
        columns = zip(self.parts, self._columns(), strict=True)
        return np.concatenate([part.pack_rows(rows[:, own]) for part, own in columns], axis=1)

    def unpack_rows(self, packed: bytes) -> LevelArray:
        rows = self.packed_rows(packed)
        columns = zip(self.parts, _slices([part.size_bytes for part in self.parts]), strict=True)
        return np.concatenate([part.unpack_rows(rows[:, own].tobytes()) for part, own in columns], axis=1)

    def check_levels(self, rows: LevelArray) -> None:
        for part, columns in zip(self.parts, self._columns(), strict=True):
            part.check_levels(rows[:, columns])

    def _columns(self) -> list[slice]:
        return _slices([part.length for part in self.parts])


@dataclass(frozen=True)
class Weighted(Joined):
    """Descriptors with weights, for Eq. 4 with several descriptors: each describes a view as it does alone."""

    @property
    def whole_image(self) -> bool:
        return any(part.whole_image for part in self.parts)

    def describe(self, view: ImageArray | Segmentation, /) -> LevelArray:
        return np.concatenate([part.describe(view) for part in self.parts])

    def measure(self) -> Measure | None:
        """Return None: the kernels know only the registered pair of edges and colours."""
        return None


class _Average:
    def __init__(self, parts: Sequence[Comparison], weights: Sequence[float], columns: Sequence[slice]) -> None:
        self._parts, self._weights, self._columns = parts, weights, columns

    def similarity(self, queries: LevelArray, /) -> FloatArray:
        similar = [p.similarity(queries[:, own]) for p, own in zip(self._parts, self._columns, strict=True)]
        return _weighted(self._weights, similar)

    def only(self, rows: IndexArray, /) -> "_Average":
        return _Average([part.only(rows) for part in self._parts], self._weights, self._columns)

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
        Joined("edges+colours", 1, (_EDGES, _COLOURS), (0.6, 0.4)),
        Joined("edges+colours+network", 1, (_EDGES, _COLOURS, _NETWORK), (0.09, 0.06, 0.85)),
    )
}

#: Weights such as 0.1 do not add up to exactly 1.
_ROUNDING: Final = 1e-9


def descriptor(name: str) -> Descriptor:
    """Return the descriptor of this name. Opens no file: names come from saved runs and from other users' catalogs.

    ``cedd=0.5,edges+colours=0.5`` is several descriptors with weights. The similarity is the sum of theirs.

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
            f"descriptors {name!r}: give each a weight above 0, and all together 1, e.g. cedd=0.5,edges+colours=0.5"
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


_named = descriptor  # `describe` has a parameter of this name


def describe(
    image_bgr: ImageArray,
    *,
    descriptor: str | Descriptor = "cedd",
    empty_table: Background | ImageArray | None = None,
) -> LevelArray:
    """Return the levels of an image by the paper's CEDD, or by another descriptor.

    ``describe(image)`` is the paper's descriptor of the whole image, scaled to a size that CEDD's grid covers.
    ``describe(image, descriptor="edges+colours", empty_table=empty)`` is the rig's own: the object is cut out and
    scaled, and its illumination corrected to that of the empty-table image (`hbr.segment`), if that is reliable. Enroll
    and search by the same descriptor, and compare by its ``similarity``::

        table = hbr.Background(cv2.imread("empty.png"))
        levels = hbr.describe(frame, descriptor="edges+colours", empty_table=table)
        hbr.descriptor("edges+colours").similarity(levels[None], enrolled)

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
