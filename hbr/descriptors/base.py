"""The interface of descriptors, and the code that they share."""

from typing import Protocol

import numpy as np

from hbr.core.arrays import FloatArray, ImageArray, IndexArray, LevelArray
from hbr.segmentation import Segmentation


class Comparison(Protocol):
    """Rows of levels, prepared for many comparisons."""

    def similarity(self, queries: LevelArray, /) -> FloatArray:
        """Return the similarity of every query, uint8 (n, length), to every row, float64 (n, m)."""

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

    def prepared(self, rows: LevelArray, /) -> Comparison:
        """Prepare rows, uint8 (m, length), for comparison with many queries.

        Raises `TypeError`, `ValueError`: the rows are no levels of this descriptor.
        """

    def opened(self, packed: LevelArray, /) -> Comparison:
        """Prepare packed rows, uint8 (m, size_bytes), for comparison with many queries.

        Raises `ValueError`: the rows have another size.
        """
        self.check_packed(packed)
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

    def check_packed(self, packed: LevelArray) -> None:
        """Check the size of packed rows, (m, size_bytes).

        Raises `ValueError`: it is another one.
        """
        if packed.shape[1:] != (self.size_bytes,):
            raise ValueError(f"packed rows of shape {packed.shape}; {self.name} has {self.size_bytes} bytes")

    def check_levels(self, rows: LevelArray) -> None:
        """Check that no level is above `max_level`.

        Raises `ValueError`: a level is above it, often because the descriptors are still packed.
        """
        if rows.size and rows.max() > self.max_level:
            raise ValueError(
                f"a level of {rows.max()}; {self.name} has levels 0..{self.max_level}, unpack packed descriptors first"
            )
