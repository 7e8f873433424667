"""Random generators that depend on their purpose alone, not on other draws or their order."""

import zlib
from typing import Final, Literal

import numpy as np

_PURPOSES: Final = {"trial": 0, "photograph": 1, "bootstrap": 2, "enrolled": 3}


def generator(
    seed: int, name: str, purpose: Literal["trial", "photograph", "bootstrap", "enrolled"], number: int
) -> np.random.Generator:
    """Return the generator for one purpose and number of an object; other objects do not change it."""
    key = (_PURPOSES[purpose], number)
    return np.random.default_rng(np.random.SeedSequence([seed, zlib.crc32(name.encode())], spawn_key=key))
