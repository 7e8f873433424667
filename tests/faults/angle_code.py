"""An object whose images contain the angle at which they are taken: evidence that a stored view has the right azimuth.

The code is 20 bits, one above the other at the left edge of the frame, outside the region that is described: 16 bits
for the angle in hundredths of a degree, and a checksum of 4 bits. Each bit is a bright and a dark half, so exposure,
flicker and blur do not change it, and an average of two angles cannot be read.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim.objects.solid import Solid

BITS = 20
ROWS = 24
HALF = 36
CONTRAST = 12
"""Grey levels between the halves below which a bit is not legible."""


@dataclass(frozen=True)
class Coded:
    """``solid`` with the code of its angle."""

    solid: Solid

    @property
    def name(self) -> str:
        return self.solid.name

    def draw(self, image: NDArray[np.uint8], azimuth_deg: float, offset_mm: tuple[float, float]) -> None:
        self.solid.draw(image, azimuth_deg, offset_mm)
        code = round(azimuth_deg * 100) % 36000
        code |= checksum(code) << 16
        for bit in range(BITS):
            rows = slice(bit * ROWS, (bit + 1) * ROWS)
            levels = (200, 40) if code >> bit & 1 else (40, 200)
            image[rows, :HALF], image[rows, HALF : 2 * HALF] = levels


def checksum(code: int) -> int:
    return (code ^ code >> 4 ^ code >> 8 ^ code >> 12) & 0xF


def coded_deg(image: NDArray[np.uint8]) -> float | None:
    """Return the angle in a frame, or None where it shows none."""
    if image.shape not in ((480, 640, 3), (240, 320, 3)):
        return None
    scale = image.shape[0] / 480
    rows, half = round(ROWS * scale), round(HALF * scale)
    code = 0
    for bit in range(BITS):
        middle = image[bit * rows + rows // 3 : (bit + 1) * rows - rows // 3]
        left, right = middle[:, half // 3 : 2 * half // 3], middle[:, half + half // 3 : half + 2 * half // 3]
        difference = float(left.mean()) - float(right.mean())
        if abs(difference) < CONTRAST:
            return None
        code |= (difference > 0) << bit
    if checksum(code & 0xFFFF) != code >> 16 or code & 0xFFFF >= 36000:
        return None
    return (code & 0xFFFF) / 100
