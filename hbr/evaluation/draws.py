"""Random numbers that depend on what they are for, and not on what else is drawn or in which order."""

import zlib
from typing import Final, Literal

import numpy as np

_PURPOSES: Final = {"trial": 0, "photograph": 1, "bootstrap": 2, "enrolled": 3}


def generator(
    seed: int, name: str, purpose: Literal["trial", "photograph", "bootstrap", "enrolled"], number: int
) -> np.random.Generator:
    """Return the generator of, say, the third trial of an object: the same whichever other objects are evaluated."""
    key = (_PURPOSES[purpose], number)
    return np.random.default_rng(np.random.SeedSequence([seed, zlib.crc32(name.encode())], spawn_key=key))
