"""What else may differ between an enrolled view and a query: place, light, what stands in front and behind.

Every perturbation has three strengths; the second is what a careful technician still lets happen.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from hbr.core.arrays import ImageArray
from hbr.evaluation.scenes import FOOT_PX, HEIGHT, SIDE_PX, WIDTH, Picture

#: What each strength means: 1, 2, 3.
STRENGTHS: Final[Mapping[str, tuple[float, float, float]]] = {
    "shift": (0.03, 0.06, 0.09),  # to either side, of the photograph's side
    "scale": (0.05, 0.10, 0.15),  # larger or smaller by up to so much
    "elevation": (3.0, 6.0, 10.0),  # degrees of the camera, up or down
    "occlusion": (0.05, 0.09, 0.15),  # width of a bar in front, of the photograph's side
    "shadow": (0.3, 0.5, 0.7),  # share of the light that a cast shadow takes
    "specular": (80.0, 140.0, 200.0),  # grey levels of highlights
    "gain": (0.125, 0.25, 0.5),  # brighter or darker by up to so much
    "white-balance": (0.035, 0.07, 0.25),  # each channel by up to so much
    "gradient": (0.1, 0.2, 0.4),  # of the light from one side of the frame to the other
    "gamma": (0.1, 0.2, 0.3),  # logarithm of the exponent
    "defocus": (1.0, 1.5, 2.0),  # standard deviation of the blur, pixels
}


@dataclass(frozen=True)
class Perturbations:
    """Perturbations and their strengths.

    Attributes
    ----------
    strengths : tuple of (str, int)
        Kinds of `STRENGTHS`, each once, with 1, 2 or 3.
    """

    strengths: tuple[tuple[str, int], ...] = ()

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
            It is none of these.
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
        """Return the magnitude of a kind, 0 where it is not asked for."""
        return next((STRENGTHS[kind][strength - 1] for name, strength in self.strengths if name == kind), 0.0)

    def photograph(
        self, image_bgr: ImageArray, mask: NDArray[np.bool_], rng: np.random.Generator, bench: Picture | None = None
    ) -> tuple[ImageArray, ImageArray | None]:
        """Photograph an object once more.

        Parameters
        ----------
        image_bgr : uint8 array (H, W, 3)
            The photograph.
        mask : bool array (H, W)
            Where it shows the object.
        rng : numpy Generator
            Of this photograph: the same state gives the same picture.
        bench : float32 array (240, 320, 3), optional
            What the object stands on; its own surroundings otherwise.

        Returns
        -------
        picture : uint8 array
            As large as the bench, or as the photograph.
        empty : uint8 array or None
            The bench without the object in the same light; None without a bench.
        """
        seen, cover = self._placed(image_bgr, mask, rng, on_bench=bench is not None)
        ground = seen if bench is None else bench.copy()
        if bench is not None:
            ground *= (1 - self._shadows(cover, rng))[:, :, None]
        picture = ground * (1 - cover[:, :, None]) + seen * cover[:, :, None]
        self._highlights(picture, cover, rng)
        pictures = [picture] if bench is None else [picture, bench.copy()]
        self._bar(pictures, cover, rng)
        shots = self._lit(pictures, rng)
        return shots[0], shots[1] if bench is not None else None

    def _placed(
        self, image: ImageArray, mask: NDArray[np.bool_], rng: np.random.Generator, *, on_bench: bool
    ) -> tuple[Picture, Picture]:
        """The photograph where it stands now, and how much of each pixel is object."""
        height, width = image.shape[:2]
        scale = 1 + rng.uniform(-1, 1) * self.of("scale")
        tilt_deg = rng.uniform(-1, 1) * self.of("elevation")
        # seen from higher up, what stands upright is shorter
        upright = scale * np.cos(np.radians(15 + tilt_deg)) / np.cos(np.radians(15))
        shift = rng.uniform(-1, 1, 2) * self.of("shift")
        if on_bench:
            mask = _whole(mask)
            scale, upright = scale * SIDE_PX / max(height, width), upright * SIDE_PX / max(height, width)
            rows, columns = np.nonzero(mask)
            x, y = (columns.min() + columns.max()) / 2, float(rows.max())
            to_x, to_y = FOOT_PX[0] + shift[0] * SIDE_PX, FOOT_PX[1] + 0.6 * shift[1] * SIDE_PX
            size = WIDTH, HEIGHT
        else:
            x, y = (width - 1) / 2, (height - 1) / 2
            to_x, to_y = x + shift[0] * width, y + shift[1] * height
            size = width, height
        move = np.array([[scale, 0, to_x - scale * x], [0, upright, to_y - upright * y]])
        edge = mask.astype(np.float32)
        if on_bench:  # half of a pixel at the edge shows the dark surroundings
            inner = cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(np.float32)
            edge = np.minimum(cv2.GaussianBlur(edge, (0, 0), 0.7), 0.5 * (inner + edge)).astype(np.float32)
        seen = cv2.warpAffine(image, move, size, borderMode=cv2.BORDER_REPLICATE)
        return seen.astype(np.float32), np.asarray(cv2.warpAffine(edge, move, size), np.float32)

    def _shadows(self, cover: Picture, rng: np.random.Generator) -> Picture:
        """Share of the light that is taken from the ground: at the foot always, and by a lamp from one side."""
        left, top, width, height = cv2.boundingRect((cover > 0.5).astype(np.uint8))
        foot = np.zeros_like(cover)
        cv2.ellipse(foot, (left + width // 2, top + height - 3), (int(0.55 * width) + 3, 8), 0, 0, 360, 1, -1)
        shade = 0.35 * cv2.GaussianBlur(foot, (0, 0), 3)
        lean, length = rng.uniform(-0.8, 0.8), rng.uniform(0.25, 0.5)
        strength = rng.uniform(0.5, 1) * self.of("shadow")
        if strength:
            bottom = top + height
            fallen = np.array([[1, lean, -lean * bottom], [0, length, bottom * (1 - length)]])
            cast = cv2.warpAffine(cover, fallen, (cover.shape[1], cover.shape[0]))
            shade = 1 - (1 - shade) * (1 - strength * cv2.GaussianBlur(cast, (0, 0), rng.uniform(2, 5)))
        return np.asarray(shade, np.float32)

    def _highlights(self, picture: Picture, cover: Picture, rng: np.random.Generator) -> None:
        strength = self.of("specular")
        rows, columns = np.nonzero(cover > 0.5)
        if not strength or not len(rows):
            return
        for _ in range(int(rng.integers(1, 4))):
            i = int(rng.integers(len(rows)))
            axes = int(rng.integers(2, 9)), int(rng.integers(2, 9))
            spot = np.zeros_like(cover)
            centre = int(columns[i]), int(rows[i])
            cv2.ellipse(spot, centre, axes, float(rng.uniform(0, 180)), 0, 360, 1, -1)
            spot = np.asarray(cv2.GaussianBlur(spot, (0, 0), 2), np.float32) * cover
            picture += spot[:, :, None] * np.float32(rng.uniform(0.4, 1) * strength)

    def _bar(self, pictures: list[Picture], cover: Picture, rng: np.random.Generator) -> None:
        """A holder from below in front of the object; every other one stands on the empty bench too."""
        size = SIDE_PX if len(pictures) > 1 else cover.shape[1]
        thick = int(rng.uniform(0.5, 1) * self.of("occlusion") * size)
        if not thick:
            return
        left, top, width, height = cv2.boundingRect((cover > 0.5).astype(np.uint8))
        x = int(rng.uniform(left, left + width))
        tip = x + int(rng.integers(-25, 26) * size / SIDE_PX), int(top + height * rng.uniform(0.1, 0.6))
        colour = rng.uniform(20, 220, 3).tolist()
        known = rng.random() < 0.5
        for picture in pictures[: 2 if known else 1]:
            cv2.line(picture, (x, picture.shape[0]), tip, colour, thick)

    def _lit(self, pictures: list[Picture], rng: np.random.Generator) -> list[ImageArray]:
        """The same light, lens and sensor for all."""
        height, width = pictures[0].shape[:2]
        gain = 1 + rng.uniform(-1, 1) * self.of("gain")
        channels = gain * (1 + rng.uniform(-1, 1, 3) * self.of("white-balance"))
        direction, slope = rng.uniform(0, 2 * np.pi), rng.uniform(0, 1) * self.of("gradient")
        x, y = np.arange(width) / width - 0.5, np.arange(height)[:, None] / height - 0.5
        light = (1 + slope * (x * np.cos(direction) + y * np.sin(direction)))[:, :, None] * channels
        exponent = np.exp(rng.uniform(-1, 1) * self.of("gamma"))
        blur = rng.uniform(0.5, 1) * self.of("defocus")
        shots = []
        for picture in pictures:
            shot = np.clip(picture * light, 0, 255)
            if exponent != 1:
                shot = 255 * (shot / 255) ** exponent
            if blur:
                shot = np.asarray(cv2.GaussianBlur(shot, (0, 0), blur))
            shots.append(np.rint(shot).astype(np.uint8))
        return shots


def _whole(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The mask without specks."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    area = stats[1:, cv2.CC_STAT_AREA]
    whole: NDArray[np.bool_] = np.isin(labels, 1 + np.flatnonzero(area >= 0.05 * area.max(initial=0)))
    return whole
