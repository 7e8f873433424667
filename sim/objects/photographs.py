"""Photographs of real objects, which fill the frame of the simulated camera; it sees the one nearest to its azimuth."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Self

import numpy as np

from rig.core.errors import UsageError
from rig.views.image_files import BadImage, decode, read_file
from sim.objects.projection import Floats, Image

_KEPT = 16  # decoded photographs: a move goes from one to the next, and large ones take 30 MB each


@dataclass(frozen=True)
class PhotographsOnTable:
    """An object.

    ``azimuth_deg``, float64 (n,), are the azimuths of the camera in its photographs, ascending, in [0, 360), and
    ``files`` the photographs in that order.
    """

    name: str
    azimuth_deg: Floats = field(repr=False)
    files: tuple[Path, ...] = field(repr=False)
    symmetry_deg: float = 360.0

    @classmethod
    def of(cls, name: str, views: Sequence[tuple[float, Path]]) -> Self:
        """Return the object with these photographs: azimuth and file, by ascending azimuth."""
        return cls(name, np.array([azimuth_deg for azimuth_deg, _ in views]), tuple(path for _, path in views))

    def draw(self, image: Image, azimuth_deg: float, offset_mm: tuple[float, float]) -> None:
        """Fill ``image`` with the nearest photograph; ``offset_mm`` cannot move an object in a photograph.

        The object's counter-clockwise rotation ``azimuth_deg`` moves the camera clockwise around it.
        """
        del offset_mm
        image[:] = photograph(self.files[self.nearest(-azimuth_deg)])

    def nearest(self, azimuth_deg: float) -> int:
        """Return the index of the photograph nearest to an azimuth around the circle; of two, the first."""
        apart = np.abs((self.azimuth_deg - azimuth_deg + 180) % 360 - 180)
        return int(apart.argmin())


@lru_cache(maxsize=_KEPT)
def photograph(path: Path) -> Image:
    """Return a photograph, uint8 (height, width, 3), BGR.

    Raises `UsageError`: the file cannot be read, or is no image.
    """
    try:
        image = decode(read_file(path))
    except (OSError, BadImage) as error:
        raise UsageError(
            f"The photograph {path} cannot be used: {error}.", next_step="Replace or remove the file."
        ) from error
    image.flags.writeable = False
    return image
