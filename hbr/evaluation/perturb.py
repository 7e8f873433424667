"""Perturbations of a query: placement, illumination and occlusion.

Every perturbation has three strengths. The second one can also occur when a technician works carefully.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from hbr.core.arrays import ImageArray
from hbr.drawing.bench import Picture, draw_highlights

#: Magnitudes at the strengths 1, 2 and 3.
STRENGTHS: Final[Mapping[str, tuple[float, float, float]]] = {
    "shift": (0.03, 0.06, 0.09),  # largest shift, relative to the photograph's side
    "scale": (0.05, 0.10, 0.15),  # largest relative change of the size
    "elevation": (3.0, 6.0, 10.0),  # largest change of the camera's elevation, degrees
    "occlusion": (0.05, 0.09, 0.15),  # width of a bar in front, relative to the photograph's side
    "specular": (80.0, 140.0, 200.0),  # grey levels of highlights
    "gain": (0.125, 0.25, 0.5),  # largest relative change of the brightness
    "white-balance": (0.035, 0.07, 0.25),  # largest relative change of each channel
    "gradient": (0.1, 0.2, 0.4),  # relative change of the light across the frame
    "gamma": (0.1, 0.2, 0.3),  # largest logarithm of the exponent
    "defocus": (1.0, 1.5, 2.0),  # standard deviation of the blur, pixels
}


@dataclass(frozen=True)
class Perturbations:
    """Perturbations and their strengths."""

    strengths: tuple[tuple[str, int], ...] = ()
    """tuple of (str, int): names in `STRENGTHS`, each at most once, with a strength of 1, 2 or 3."""

    def __post_init__(self) -> None:
        kinds = [kind for kind, _ in self.strengths]
        for kind, strength in self.strengths:
            if kind not in STRENGTHS:
                raise ValueError(f"perturbation {kind!r} is unknown; use some of {', '.join(STRENGTHS)}, or all")
            if strength not in (1, 2, 3):
                raise ValueError(f"strength {strength} of {kind}; 1, 2 or 3 is needed")
        if len(set(kinds)) != len(kinds):
            raise ValueError(f"{' and '.join(kinds)}: name each perturbation once")

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read ``none``, ``KIND:STRENGTH``, several joined by ``+``, or ``all:STRENGTH``.

        Raises
        ------
        ValueError
            The text has another form.
        """
        strengths: list[tuple[str, int]] = []
        for part in [] if text == "none" else text.split("+"):
            kind, _, number = part.partition(":")
            if number not in ("", "1", "2", "3"):
                raise ValueError(f"strength {number!r} of {kind}; 1, 2 or 3 is needed")
            strengths.extend((one, int(number or 2)) for one in (STRENGTHS if kind == "all" else (kind,)))
        return cls(tuple(strengths))

    def __str__(self) -> str:
        return "+".join(f"{kind}:{strength}" for kind, strength in self.strengths) or "none"

    def __bool__(self) -> bool:
        return bool(self.strengths)

    def of(self, kind: str) -> float:
        """Return the magnitude of a perturbation; 0 if there is none."""
        return next((STRENGTHS[kind][strength - 1] for name, strength in self.strengths if name == kind), 0.0)

    def photograph(self, image_bgr: ImageArray, mask: NDArray[np.bool_], rng: np.random.Generator) -> ImageArray:
        """Return the photograph of an object, uint8 (H, W, 3), with these perturbations.

        ``mask``, bool (H, W), are the pixels of the object. Equal states of ``rng`` give equal pictures.
        """
        picture, cover = self._placed(image_bgr, mask, rng)
        draw_highlights(picture, cover, self.of("specular"), rng)
        self._bar(picture, cover, rng)
        return self._illuminated(picture, rng)

    def _placed(self, image: ImageArray, mask: NDArray[np.bool_], rng: np.random.Generator) -> tuple[Picture, Picture]:
        """Return the photograph at its new place, and the share of the object in each pixel."""
        height, width = image.shape[:2]
        scale = 1 + rng.uniform(-1, 1) * self.of("scale")
        tilt_deg = rng.uniform(-1, 1) * self.of("elevation")
        # from a higher camera, upright objects look shorter
        upright = scale * np.cos(np.radians(15 + tilt_deg)) / np.cos(np.radians(15))
        shift = rng.uniform(-1, 1, 2) * self.of("shift")
        x, y = (width - 1) / 2, (height - 1) / 2
        to_x, to_y = x + shift[0] * width, y + shift[1] * height
        move = np.array([[scale, 0, to_x - scale * x], [0, upright, to_y - upright * y]])
        seen = cv2.warpAffine(image, move, (width, height), borderMode=cv2.BORDER_REPLICATE)
        cover = cv2.warpAffine(mask.astype(np.float32), move, (width, height))
        return seen.astype(np.float32), np.asarray(cover, np.float32)

    def _bar(self, picture: Picture, cover: Picture, rng: np.random.Generator) -> None:
        """Draw a bar in front of the object, from below."""
        size = cover.shape[1]
        thick = int(rng.uniform(0.5, 1) * self.of("occlusion") * size)
        if not thick:
            return
        left, top, width, height = cv2.boundingRect((cover > 0.5).astype(np.uint8))
        x = int(rng.uniform(left, left + width))
        tip = x + int(rng.uniform(-1, 1) * size / 6), int(top + height * rng.uniform(0.1, 0.6))
        cv2.line(picture, (x, picture.shape[0]), tip, rng.uniform(20, 220, 3).tolist(), thick)

    def _illuminated(self, picture: Picture, rng: np.random.Generator) -> ImageArray:
        """Return the picture after a change of illumination, lens and sensor."""
        height, width = picture.shape[:2]
        gain = 1 + rng.uniform(-1, 1) * self.of("gain")
        channels = gain * (1 + rng.uniform(-1, 1, 3) * self.of("white-balance"))
        direction, slope = rng.uniform(0, 2 * np.pi), rng.uniform(0, 1) * self.of("gradient")
        x, y = np.arange(width) / width - 0.5, np.arange(height)[:, None] / height - 0.5
        light = (1 + slope * (x * np.cos(direction) + y * np.sin(direction)))[:, :, None] * channels
        exponent = np.exp(rng.uniform(-1, 1) * self.of("gamma"))
        blur = rng.uniform(0.5, 1) * self.of("defocus")
        image: NDArray[np.float64] = np.clip(picture * light, 0, 255)
        if exponent != 1:
            image = 255 * (image / 255) ** exponent
        if blur:
            image = np.asarray(cv2.GaussianBlur(image, (0, 0), blur))
        return np.rint(image).astype(np.uint8)
