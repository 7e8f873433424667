"""What retrieval asks of a descriptor."""

from typing import Protocol

from hbr.core.arrays import FloatArray, ImageArray, IndexArray, LevelArray
from hbr.segmentation import Segmentation


class Comparison(Protocol):
    """Rows of levels made ready for many comparisons."""

    def similarity(self, queries: LevelArray, /) -> FloatArray:
        """Similarity of every query, uint8 (n, length), to every row, float64 (n, m)."""
        ...

    def only(self, rows: IndexArray, /) -> "Comparison":
        """Some of the rows, in this order, as rows of their own."""
        ...

    def among(self, rows: IndexArray, /) -> FloatArray:
        """Similarity of rows to each other within groups: indices (g, k) in, float64 (g, k, k) out."""
        ...


class Descriptor(Protocol):
    """A way to put a view into a few bytes, and to compare such bytes.

    Attributes
    ----------
    name : str
        By which it is asked for, and stored with every view.
    version : int
        Rises when the same image gives other levels; levels of different versions must not be compared.
    size_bytes : int
        Of a packed view.
    length : int
        Levels of a view.
    """

    @property
    def name(self) -> str: ...
    @property
    def version(self) -> int: ...
    @property
    def size_bytes(self) -> int: ...
    @property
    def length(self) -> int: ...

    def describe(self, view: ImageArray | Segmentation, /) -> LevelArray:
        """Describe a view by levels, uint8 (length,).

        Parameters
        ----------
        view : uint8 array (H, W, 3), or Segmentation
            An image in BGR is taken as it is by the paper's descriptor, and goes through `hbr.segment` for those that
            need the object alone; a `Segmentation` has been through it, and serves several descriptors.

        Raises
        ------
        TypeError, ValueError
            It is no such image.
        """
        ...

    def prepared(self, rows: LevelArray, /) -> Comparison:
        """Make rows, uint8 (m, length), ready to be compared with many queries; takes several times their memory.

        Raises
        ------
        TypeError, ValueError
            They are no levels of this descriptor.
        """
        ...

    def similarity(self, a: LevelArray, b: LevelArray) -> FloatArray:
        """Similarity of every row of `a`, (n, length), to every row of `b`, (m, length).

        Returns
        -------
        float64 array (n, m)
            0..1; 1 for equal rows that show anything, to 1e-6.

        Raises
        ------
        ValueError
            The rows are not of this descriptor's length.
        """
        ...

    def pack(self, levels: LevelArray) -> bytes:
        """Pack the levels of one view, (length,), into `size_bytes` bytes.

        Raises
        ------
        TypeError, ValueError
            They are no levels of this descriptor.
        """
        ...

    def unpack(self, packed: bytes) -> LevelArray:
        """Restore the levels of one view, uint8 (length,), the inverse of `pack`.

        Raises
        ------
        ValueError
            There are not exactly `size_bytes` bytes.
        """
        ...
