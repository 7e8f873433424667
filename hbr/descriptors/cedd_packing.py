"""Packing of CEDD levels into 54 bytes: 144 levels of 3 bits, bin 0 first, most significant bit first."""

from typing import Final

import numpy as np

from hbr.core.arrays import LevelArray
from hbr.descriptors.cedd import BINS

BITS: Final = 3
PACKED_BYTES: Final = BINS * BITS // 8


def pack(levels: LevelArray) -> bytes:
    """Pack one descriptor into 54 bytes.

    Parameters
    ----------
    levels : integer array (144,)
        Levels 0..7.

    Returns
    -------
    bytes
        54 bytes. Several packed descriptors, joined, are a table of 54-byte rows.

    Raises
    ------
    TypeError, ValueError
        The levels are not integers, not of shape (144,), or outside 0..7.
    """
    levels = np.asarray(levels)
    if not np.issubdtype(levels.dtype, np.integer):
        raise TypeError(f"the levels are of {levels.dtype}; pass the integer levels that cedd or describe returns")
    if levels.shape != (BINS,):
        raise ValueError(f"the levels have shape {levels.shape}, not ({BINS},); pack one descriptor at a time")
    if levels.min() < 0 or levels.max() > 7:
        raise ValueError(
            f"the levels span {levels.min()}..{levels.max()}, not 0..7; pass a descriptor, not a histogram"
        )
    return pack_rows(levels.astype(np.uint8)[None]).tobytes()


def pack_rows(levels: LevelArray) -> LevelArray:
    """Return packed descriptors, uint8 (n, 54), of levels 0..7, uint8 (n, 144)."""
    bits = np.unpackbits(levels.reshape(len(levels), BINS, 1), axis=2)[:, :, -BITS:]
    return np.packbits(bits.reshape(len(levels), BITS * BINS), axis=1)


def unpack(packed: bytes) -> LevelArray:
    """Return the levels of one packed descriptor; the inverse of `pack`.

    Returns
    -------
    uint8 array (144,)
        Levels 0..7.

    Raises
    ------
    ValueError
        There are not exactly 54 bytes.
    """
    if len(packed) != PACKED_BYTES:
        raise ValueError(f"{len(packed)} bytes; a packed descriptor has {PACKED_BYTES}, check how it was stored")
    levels: LevelArray = unpack_rows(packed)[0]
    return levels


def unpack_rows(packed: bytes) -> LevelArray:
    """Return the levels of many packed descriptors, joined.

    Returns
    -------
    uint8 array (n, 144)
        Levels 0..7.

    Raises
    ------
    ValueError
        The number of bytes is not a multiple of 54.
    """
    if len(packed) % PACKED_BYTES:
        raise ValueError(f"{len(packed)} bytes are no multiple of {PACKED_BYTES}, check how they were stored")
    threes = np.frombuffer(packed, np.uint8).reshape(-1, BINS // 8, BITS).astype(np.uint32)  # 3 bytes are 8 levels
    bits = threes[..., 0] << 16 | threes[..., 1] << 8 | threes[..., 2]
    levels = np.empty((*bits.shape, 8), np.uint8)
    for place in range(8):
        levels[..., place] = bits >> (21 - BITS * place) & 7
    return levels.reshape(-1, BINS)
