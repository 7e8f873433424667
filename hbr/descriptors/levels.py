"""What the descriptors share: checks, and levels of two bits in bytes."""

from typing import Protocol

import numpy as np

from hbr.core.arrays import LevelArray


class _Sized(Protocol):
    @property
    def name(self) -> str: ...
    @property
    def length(self) -> int: ...


def check_levels(descriptor: _Sized, *rows: LevelArray) -> None:
    """Refuse what is no array (..., length) of uint8."""
    for levels in rows:
        if levels.dtype != np.uint8:
            raise TypeError(f"the levels are of {levels.dtype}; pass the uint8 levels that describe returns")
        if levels.shape[-1:] != (descriptor.length,):
            raise ValueError(
                f"levels of shape {levels.shape}; {descriptor.name} has {descriptor.length}, compare one kind only"
            )


def pack_quarters(levels: LevelArray) -> bytes:
    """Four levels 0..3 in a byte, the first in the highest bits."""
    if levels.max(initial=0) > 3:
        raise ValueError(f"a level of {levels.max()}; levels of two bits are 0..3")
    parts = levels.reshape(-1, 4)
    return (parts[:, 0] << 6 | parts[:, 1] << 4 | parts[:, 2] << 2 | parts[:, 3]).astype(np.uint8).tobytes()


def unpack_quarters(packed: bytes) -> LevelArray:
    """The inverse of `pack_quarters`."""
    stored = np.frombuffer(packed, np.uint8)
    return np.stack([stored >> 6, stored >> 4 & 3, stored >> 2 & 3, stored & 3], axis=1).ravel()
