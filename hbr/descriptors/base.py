"""The interface of descriptors, the code that they share, and changes of a description by a change of the bench.

A `Shift` tests a catalog against such a change without images. A box that is a little wrong moves and scales the grid
of cells, a holder hides some of them, another light changes the colours, and highlights, shadows and defocus change the
strength of edges.
"""

from abc import abstractmethod
from dataclasses import dataclass
from typing import Final, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from hbr.core.arrays import FloatArray, ImageArray, IndexArray, LevelArray
from hbr.kernels import library
from hbr.kernels.calls import Measure, PackedRows, Segments
from hbr.segmentation import Segmentation

#: At strength 1, a hard change of the bench: standard deviations of the box's scale and shift (shares of its side), of
#: the exponent of edges, of the share of false edges, of the light's colour and of the contrast in logarithms, and of
#: other changes of colours.
_SCALE: Final = 0.07
_MOVE: Final = 0.045
_EXPONENT: Final = 0.15
_FALSE: Final = 0.5
_LIGHT: Final = 0.14
_CONTRAST: Final = 0.12
_STAIN: Final = 0.05
#: Length of the change of a learned description, which is whitened, relative to its own, and the share of it that all
#: views of a search have in common: measured on objects 1-50 of COIL-100 (`hbr.descriptors.network`).
_LEARNED: Final = 1.3
_IN_COMMON: Final = 0.8
#: Probability of a holder, and its width in cells.
_HOLDER: Final = 0.5
_HOLDER_CELLS: Final = 0.8  # a rod or a clip, a tenth of the box's width


@dataclass(frozen=True, eq=False)
class Shift:
    """A change of the bench, as one view shows it.

    Attributes
    ----------
    move : float64 array (2, 3)
        Affine map from places in the changed grid, from -0.5 to 0.5, to the unchanged one.
    visible : float32 array (8, 8)
        Share of each cell that the holder leaves visible.
    exponent, false, light, contrast, stain
        Exponent of the edges' strength; share of false edges; change of the two opponent colours, (2,); factor of the
        contrast; other changes of the colours.
    seed : int
        Seed of the random values of the cells.
    learned : float
        Length of the change of a learned description, relative to its own.
    bench : int
        Seed of the part of it that all views of a search have in common.
    """

    move: NDArray[np.float64]
    visible: NDArray[np.float32]
    exponent: float
    false: float
    light: NDArray[np.float64]
    contrast: float
    stain: float
    seed: int
    learned: float
    bench: int

    @classmethod
    def drawn(cls, rng: np.random.Generator, strength: float, bench: int = 0) -> "Shift":
        """Draw a shift; at strength 0 nothing changes, and 1 is a hard change of the bench with this number."""
        scale = np.exp(rng.normal(0, _SCALE * strength, 2))
        move = np.column_stack([np.diag(scale), rng.normal(0, _MOVE * strength, 2)])
        visible = np.ones((8, 8), np.float32)
        if rng.random() < _HOLDER * min(1.0, strength):
            column, lean, top = rng.uniform(1, 6), rng.uniform(-1.5, 1.5), int(rng.integers(2, 7))
            for row in range(top, 8):
                away = np.abs(np.arange(8) - column - lean * (row - 4) / 8)
                visible[row] = np.clip(away - _HOLDER_CELLS / 2 + 0.5, 0, 1)
        return cls(
            move,
            visible,
            float(np.exp(rng.normal(0, _EXPONENT * strength))),
            _FALSE * strength * float(rng.uniform(0, 1)),
            rng.normal(0, _LIGHT * strength, 2),
            float(np.exp(rng.normal(0, _CONTRAST * strength))),
            _STAIN * strength,
            int(rng.integers(2**31)),
            _LEARNED * strength,
            bench,
        )

    def of_learned(self, length: int) -> FloatArray:
        """Return the change of a learned description of unit length, (length,)."""
        common, own = (np.random.default_rng(seed).normal(0, length**-0.5, length) for seed in (self.bench, self.seed))
        change: FloatArray = self.learned * (_IN_COMMON**0.5 * common + (1 - _IN_COMMON) ** 0.5 * own)
        return change

    def moved(self, planes: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return planes of 8 x 8 cells, (n, 8, 8), after the change of the box."""
        matrix = self.move.copy()
        middle = np.full(2, 3.5)
        matrix[:, 2] = middle + 8 * matrix[:, 2] - matrix[:, :2] @ middle
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        stacked = np.ascontiguousarray(planes.transpose(1, 2, 0))
        parts = [
            cv2.warpAffine(stacked[:, :, n : n + 4], matrix, (8, 8), flags=flags).reshape(8, 8, -1)
            for n in range(0, stacked.shape[2], 4)
        ]
        return np.concatenate(parts, axis=2).transpose(2, 0, 1).astype(np.float32)


class Comparison(Protocol):
    """Rows of levels, prepared for many comparisons."""

    def similarity(self, queries: LevelArray, /) -> FloatArray:
        """Return the similarity of every query, uint8 (n, length), to every row, float64 (n, m)."""

    def only(self, rows: IndexArray, /) -> "Comparison":
        """Return the comparison with some of the rows, in this order."""

    def among(self, rows: IndexArray, /) -> FloatArray:
        """Return the similarity of rows to each other within groups, indices (g, k), as float64 (g, k, k)."""


class Descriptor(Protocol):
    """Describes views by a few bytes, and compares such descriptions.

    A class that inherits from this one implements `describe` and `prepared` and sets the attributes; the other methods
    are correct for a descriptor that stores each level in one byte.

    Attributes
    ----------
    name : str
        Name by which the descriptor is chosen, stored with every view.
    version : int
        Increases when the same image gives other levels. Levels of different versions must not be compared.
    size_bytes : int
        Size of a packed view.
    length : int
        Number of levels of a view.
    max_level : int
        Largest level.
    whole_image : bool
        Whether the whole image is described, as the paper does, and not only the object.
    is_plain_cedd : bool
        Whether views are compared by the Tanimoto coefficient of CEDD's levels, for which the paper's index is faster.
    can_describe : bool
        Whether everything is installed that describing a view needs; comparing needs nothing.
    """

    @property
    def name(self) -> str: ...
    @property
    def version(self) -> int: ...
    @property
    def size_bytes(self) -> int: ...
    @property
    def length(self) -> int: ...
    @property
    def max_level(self) -> int:
        return 255

    @property
    def whole_image(self) -> bool:
        return False

    @property
    def is_plain_cedd(self) -> bool:
        return False

    @property
    def can_describe(self) -> bool:
        return True

    def describe(self, view: ImageArray | Segmentation, /) -> LevelArray:
        """Return the levels of a view, uint8 (length,).

        Parameters
        ----------
        view : uint8 array (H, W, 3), or Segmentation
            An image in BGR, or the result of `hbr.segment`, which can be shared by several descriptors. Descriptors of
            the object segment an image themselves.

        Raises
        ------
        TypeError, ValueError
            The array is no such image.
        """

    def entries(self, rows: LevelArray) -> FloatArray:
        """Return the numbers that levels, uint8 (n, length), stand for: differences count alike, float64 (n, d)."""
        return rows.astype(np.float64)

    def shifted(self, levels: LevelArray, shift: Shift) -> LevelArray:  # noqa: ARG002
        """Return the levels of a view, uint8 (length,), after a change of the bench; unchanged if that is not known."""
        return levels

    def prepared(self, rows: LevelArray, /) -> Comparison:
        """Prepare rows, uint8 (m, length), for comparison with many queries.

        Raises `TypeError`, `ValueError`: the rows are no levels of this descriptor.
        """

    def opened(self, packed: LevelArray, /) -> Comparison:
        """Prepare packed rows, uint8 (m, size_bytes), for comparison with many queries.

        Raises `ValueError`: the rows have another size.
        """
        return self.prepared(self.unpack_rows(packed.tobytes()))

    def similarity(self, a: LevelArray, b: LevelArray) -> FloatArray:
        """Return the similarity of every row of `a`, (n, length), to every row of `b`, (m, length).

        Returns
        -------
        float64 array (n, m)
            0..1; 1 for equal rows that are not empty, to 1e-6.

        Raises `ValueError`: the rows are not of this descriptor's length.
        """
        self.check_rows(a)
        return self.prepared(b).similarity(a)

    def similarity_of_means(self, means: FloatArray) -> FloatArray:
        """Return the similarity of average views, (n, length), to each other, as float64 (n, n); they are rounded."""
        levels = np.rint(means).astype(np.uint8)
        return self.similarity(levels, levels)

    def pack(self, levels: LevelArray) -> bytes:
        """Pack the levels of one view, (length,), into `size_bytes` bytes.

        Raises
        ------
        TypeError, ValueError
            They are no levels of this descriptor.
        """
        self.check_rows(levels)
        return self.pack_rows(levels[None]).tobytes()

    def pack_rows(self, rows: LevelArray) -> LevelArray:
        """Return the packed levels of many views, (n, length), as rows of bytes, uint8 (n, size_bytes).

        Raises `ValueError`: a level is too large.
        """
        self.check_levels(rows)
        return rows

    def unpack(self, packed: bytes) -> LevelArray:
        """Return the levels of one packed view, uint8 (length,); the inverse of `pack`.

        Raises
        ------
        ValueError
            There are not exactly `size_bytes` bytes.
        """
        if len(packed) != self.size_bytes:
            raise ValueError(f"{len(packed)} bytes; {self.name} has {self.size_bytes}, check how it was stored")
        levels: LevelArray = self.unpack_rows(packed)[0]
        return levels

    def unpack_rows(self, packed: bytes) -> LevelArray:
        """Return the levels of many packed views, joined: uint8 (n, length).

        Raises
        ------
        ValueError
            The number of bytes is not a multiple of `size_bytes`.
        """
        return self.packed_rows(packed)

    def packed_rows(self, packed: bytes) -> LevelArray:
        """Return packed views as rows of bytes, uint8 (n, size_bytes).

        Raises `ValueError`: the number of bytes is not a multiple of `size_bytes`.
        """
        if len(packed) % self.size_bytes:
            raise ValueError(f"{len(packed)} bytes are no multiple of {self.size_bytes}, check how they were stored")
        return np.frombuffer(packed, np.uint8).reshape(-1, self.size_bytes)

    def check_rows(self, *rows: LevelArray) -> None:
        """Check the type and the length of arrays (..., length) of levels.

        Raises `TypeError`, `ValueError`: an array is not of uint8, or its last axis has another length.
        """
        for levels in rows:
            if levels.dtype != np.uint8:
                raise TypeError(f"the levels are of {levels.dtype}; pass the uint8 levels that describe returns")
            if levels.shape[-1:] != (self.length,):
                raise ValueError(
                    f"levels of shape {levels.shape}; {self.name} has {self.length}, compare one descriptor only"
                )

    def check_levels(self, rows: LevelArray) -> None:
        """Check that no level is above `max_level`.

        Raises `ValueError`: a level is above it, often because the descriptors are still packed.
        """
        if rows.size and rows.max() > self.max_level:
            raise ValueError(
                f"a level of {rows.max()}; {self.name} has levels 0..{self.max_level}, unpack packed descriptors first"
            )


class CompiledDescriptor(Descriptor):
    """A descriptor whose packed rows the compiled kernels compare where they lie, without a copy.

    A class that inherits from this one implements `compared` and `measure` instead of `prepared`.
    """

    @abstractmethod
    def compared(self, rows: LevelArray, /) -> Comparison:
        """Prepare rows, uint8 (m, length), for comparison in NumPy; the result takes several times their memory."""

    @abstractmethod
    def measure(self) -> Measure | None:
        """Return the settings with which the kernels compare packed rows, with the same result; None if they cannot."""

    def prepared(self, rows: LevelArray, /) -> Comparison:
        self.check_rows(rows)
        measure = None if library() is None else self.measure()
        return self.compared(rows) if measure is None else Packed(self, PackedRows(measure, self.pack_rows(rows)))

    def opened(self, packed: LevelArray, /) -> Comparison:
        measure = None if library() is None else self.measure()
        if measure is None or packed.shape[1:] != (self.size_bytes,):
            return super().opened(packed)
        return Packed(self, PackedRows(measure, packed))


class Packed:
    """Packed rows, compared by the compiled kernels."""

    def __init__(self, kind: Descriptor, rows: PackedRows) -> None:
        self._kind, self._rows = kind, rows

    def similarity(self, queries: LevelArray, /) -> FloatArray:
        return self._rows.similarity(self._kind.pack_rows(queries))

    def bounds(self, query: LevelArray, segments: Segments) -> FloatArray:
        """Return an upper bound of the similarity of each object's views to a query, (k,)."""
        return self._rows.bounds(self._kind.pack_rows(query[None])[0], segments)

    def nearest(self, query: LevelArray, segments: Segments, kept: int) -> IndexArray:
        """Return the objects with the most similar views, ascending (kept,); of equal ones, the first."""
        return self._rows.nearest(self._kind.pack_rows(query[None])[0], segments, kept)

    def only(self, rows: IndexArray, /) -> "Packed":
        return Packed(self._kind, self._rows.only(rows))

    def among(self, rows: IndexArray, /) -> FloatArray:
        return self._rows.among(rows)

    def pairs(self, rows: IndexArray, first: IndexArray, second: IndexArray) -> FloatArray:
        """Return the similarity of two rows of each group, (g, p): see `PackedRows.pairs`."""
        return self._rows.pairs(rows, first, second)
