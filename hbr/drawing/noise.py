"""The paper's noise: motion blur and Gaussian noise of an image, by the definitions of MATLAB's functions."""

from dataclasses import dataclass
from typing import Final, Self

import cv2
import numpy as np

from hbr.core.arrays import FloatArray, ImageArray

GN_VARIANCE: Final = 0.012
"""Variance of ``gn``, as `imnoise` takes it. The paper calls 0.012 a standard deviation: that is ``gn:0.000144``."""
GN_STANDARD_DEVIATION: Final = 0.012
MB_LENGTH_PX: Final = 15.0  # the paper's motion blur: `fspecial` with len = 15 and θ = 20°
MB_ANGLE_DEG: Final = 20.0


@dataclass(frozen=True)
class Noise:
    """Motion blur of the optics, then Gaussian noise of the sensor."""

    gaussian_variance: float = 0.0
    """Variance of intensities in 0..1; 0: no noise."""
    motion_px: float = 0.0
    """Length of the motion in pixels; 0: no blur."""
    motion_deg: float = MB_ANGLE_DEG
    """Direction of the motion, counter-clockwise from the right."""

    def __post_init__(self) -> None:
        if not (np.isfinite(self.gaussian_variance) and self.gaussian_variance >= 0):
            raise ValueError(f"the variance of the Gaussian noise is {self.gaussian_variance}; at least 0 is needed")
        if not (np.isfinite(self.motion_px) and self.motion_px >= 0 and np.isfinite(self.motion_deg)):
            raise ValueError(
                f"a motion of {self.motion_px} pixels to {self.motion_deg} degrees; a length of at least 0 is needed"
            )

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read ``none``, ``gn``, ``gn:VARIANCE``, ``mb``, ``mb:PIXELS``, ``mb:PIXELS:DEGREES``, or two joined by ``+``.

        Raises
        ------
        ValueError
            The text has another form.
        """
        settings: dict[str, float] = {}
        try:
            for part in [] if text == "none" else text.split("+"):
                kind, *numbers = part.split(":")
                values = [float(number) for number in numbers]
                match kind, values:
                    case "gn", [] | [_]:
                        new = {"gaussian_variance": (values or [GN_VARIANCE])[0]}
                    case "mb", [] | [_] | [_, _]:
                        length, angle = (values + [MB_LENGTH_PX, MB_ANGLE_DEG][len(values) :])[:2]
                        new = {"motion_px": length, "motion_deg": angle}
                    case _:
                        raise ValueError(part)
                if settings.keys() & new.keys():
                    raise ValueError(part)
                settings |= new
        except ValueError:
            raise ValueError(
                f"noise {text!r} is unknown; use none, gn, gn:{GN_VARIANCE}, mb, mb:{MB_LENGTH_PX:g}:{MB_ANGLE_DEG:g}, "
                "or gn+mb"
            ) from None
        return cls(**settings)

    def __str__(self) -> str:
        parts = []
        if self.gaussian_variance:
            parts.append(f"gn:{self.gaussian_variance:g}")
        if self.motion_px:
            parts.append(f"mb:{self.motion_px:g}:{self.motion_deg:g}")
        return "+".join(parts) or "none"

    def apply(self, image_bgr: ImageArray, rng: np.random.Generator) -> ImageArray:
        """Return the image with this noise, uint8 (H, W, 3)."""
        if self.motion_px:
            kernel = motion_kernel(self.motion_px, self.motion_deg)
            image_bgr = cv2.filter2D(image_bgr, -1, kernel, borderType=cv2.BORDER_REPLICATE).astype(
                np.uint8, copy=False
            )
        if self.gaussian_variance:
            image_bgr = gaussian(image_bgr, self.gaussian_variance, rng)
        return image_bgr


def gaussian(image_bgr: ImageArray, variance: float, rng: np.random.Generator) -> ImageArray:
    """Add white Gaussian noise of this variance to intensities in 0..1, and clip (MATLAB's ``imnoise``)."""
    noise = rng.standard_normal(image_bgr.shape, np.float32)
    noise *= np.float32(255 * variance**0.5)
    noise += image_bgr
    return np.rint(np.clip(noise, 0, 255)).astype(np.uint8)


def motion_kernel(length_px: float, angle_deg: float) -> FloatArray:
    """Return the kernel of a straight motion: the weights fall linearly to 0 at one pixel from the line.

    Like MATLAB's ``fspecial('motion', length, angle)``: the distance of a pixel is that to the end of the line if its
    centre is at least half a length away from the middle, otherwise that to the line.

    Parameters
    ----------
    length_px : float
        At least 1.
    angle_deg : float
        Counter-clockwise from the right.

    Returns
    -------
    float64 array (odd, odd)
        The sum is 1. The kernel has a rotational symmetry of 180 degrees.
    """
    if not (np.isfinite(length_px) and length_px >= 1 and np.isfinite(angle_deg)):
        raise ValueError(f"a motion of {length_px} pixels to {angle_deg} degrees; at least 1 pixel is needed")
    half = (length_px - 1) / 2
    angle = np.radians(angle_deg % 180)
    cos, sin = np.cos(angle), np.sin(angle)
    # slightly less than one pixel beyond the end, so that no border of zero weight is added
    reach_x, reach_y = (int(half * abs(part) + 1 - length_px * np.finfo(float).eps) for part in (cos, sin))
    right = np.arange(-reach_x, reach_x + 1)
    up = np.arange(reach_y, -reach_y - 1, -1)[:, None]
    along, across = right * cos + up * sin, up * cos - right * sin
    beyond = np.hypot(right, up) >= half
    distance = np.where(beyond, np.hypot(across, np.abs(along) - half), np.abs(across))
    weights: FloatArray = np.maximum(0.0, 1.0 - distance)
    weights /= weights.sum()
    return weights
