"""Perturbations of a query: placement, illumination, occlusion and background; drawn benches for them.

Every perturbation has three strengths. The second one can also occur when a technician works carefully.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from hbr.core.arrays import ImageArray
from hbr.drawing.bench import FOOT_PX, HEIGHT, SIDE_PX, WIDTH, Picture, draw_highlights, missing_light
from hbr.evaluation.photographs import without_specks

#: Half axes of the platter in pixels, and the grain of the surfaces.
_PLATTER_PX: Final = (105, 27)
_GRAINS: Final = (3, 6, 12, 24, 48)  # cells of noise across the surface; the coarser ones are stronger
#: Magnitudes at the strengths 1, 2 and 3.
STRENGTHS: Final[Mapping[str, tuple[float, float, float]]] = {
    "shift": (0.03, 0.06, 0.09),  # largest shift, relative to the photograph's side
    "scale": (0.05, 0.10, 0.15),  # largest relative change of the size
    "elevation": (3.0, 6.0, 10.0),  # largest change of the camera's elevation, degrees
    "occlusion": (0.05, 0.09, 0.15),  # width of a bar in front, relative to the photograph's side
    "shadow": (0.3, 0.5, 0.7),  # share of the light that is missing in a cast shadow
    "specular": (80.0, 140.0, 200.0),  # grey levels of highlights
    "gain": (0.125, 0.25, 0.5),  # largest relative change of the brightness
    "white-balance": (0.035, 0.07, 0.25),  # largest relative change of each channel
    "gradient": (0.1, 0.2, 0.4),  # relative change of the light across the frame
    "gamma": (0.1, 0.2, 0.3),  # largest logarithm of the exponent
    "defocus": (1.0, 1.5, 2.0),  # standard deviation of the blur, pixels
}


@dataclass(frozen=True)
class Perturbations:
    """Perturbations and their strengths.

    Attributes
    ----------
    strengths : tuple of (str, int)
        Names in `STRENGTHS`, each at most once, with a strength of 1, 2 or 3.
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

    def photograph(
        self, image_bgr: ImageArray, mask: NDArray[np.bool_], rng: np.random.Generator, bench: Picture | None = None
    ) -> tuple[ImageArray, ImageArray | None]:
        """Return the photograph of an object with these perturbations.

        Parameters
        ----------
        image_bgr : uint8 array (H, W, 3)
            The photograph without perturbations.
        mask : bool array (H, W)
            The pixels of the object.
        rng : numpy Generator
            Equal states give equal pictures.
        bench : float32 array (240, 320, 3), optional
            The new background; default: that of the photograph.

        Returns
        -------
        picture : uint8 array
            The size is that of the bench, or of the photograph.
        empty : uint8 array or None
            The bench without the object in the same illumination; None without a bench.
        """
        seen, cover = self._placed(image_bgr, mask, rng, on_bench=bench is not None)
        ground = seen if bench is None else bench.copy()
        if bench is not None:
            ground *= (1 - self._shade(cover, rng))[:, :, None]
        picture = ground * (1 - cover[:, :, None]) + seen * cover[:, :, None]
        draw_highlights(picture, cover, self.of("specular"), rng)
        pictures = [picture] if bench is None else [picture, bench.copy()]
        self._bar(pictures, cover, rng)
        images = self._illuminated(pictures, rng)
        return images[0], images[1] if bench is not None else None

    def _placed(
        self, image: ImageArray, mask: NDArray[np.bool_], rng: np.random.Generator, *, on_bench: bool
    ) -> tuple[Picture, Picture]:
        """Return the photograph at its new place, and the share of the object in each pixel."""
        height, width = image.shape[:2]
        scale = 1 + rng.uniform(-1, 1) * self.of("scale")
        tilt_deg = rng.uniform(-1, 1) * self.of("elevation")
        # from a higher camera, upright objects look shorter
        upright = scale * np.cos(np.radians(15 + tilt_deg)) / np.cos(np.radians(15))
        shift = rng.uniform(-1, 1, 2) * self.of("shift")
        if on_bench:
            mask = without_specks(mask)
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
        if on_bench:  # half of a pixel at the edge is dark surroundings
            inner = cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(np.float32)
            edge = np.minimum(cv2.GaussianBlur(edge, (0, 0), 0.7), 0.5 * (inner + edge)).astype(np.float32)
        seen = cv2.warpAffine(image, move, size, borderMode=cv2.BORDER_REPLICATE)
        return seen.astype(np.float32), np.asarray(cv2.warpAffine(edge, move, size), np.float32)

    def _shade(self, cover: Picture, rng: np.random.Generator) -> Picture:
        lean, length = rng.uniform(-0.8, 0.8), rng.uniform(0.25, 0.5)
        strength = rng.uniform(0.5, 1) * self.of("shadow")
        return missing_light(cover, strength, lean, length, rng.uniform(2, 5) if strength else 0.0)

    def _bar(self, pictures: list[Picture], cover: Picture, rng: np.random.Generator) -> None:
        """Draw a bar in front of the object, from below; half of the bars are on the empty-table image, too."""
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

    def _illuminated(self, pictures: list[Picture], rng: np.random.Generator) -> list[ImageArray]:
        """Return the pictures after the same change of illumination, lens and sensor."""
        height, width = pictures[0].shape[:2]
        gain = 1 + rng.uniform(-1, 1) * self.of("gain")
        channels = gain * (1 + rng.uniform(-1, 1, 3) * self.of("white-balance"))
        direction, slope = rng.uniform(0, 2 * np.pi), rng.uniform(0, 1) * self.of("gradient")
        x, y = np.arange(width) / width - 0.5, np.arange(height)[:, None] / height - 0.5
        light = (1 + slope * (x * np.cos(direction) + y * np.sin(direction)))[:, :, None] * channels
        exponent = np.exp(rng.uniform(-1, 1) * self.of("gamma"))
        blur = rng.uniform(0.5, 1) * self.of("defocus")
        images = []
        for picture in pictures:
            image = np.clip(picture * light, 0, 255)
            if exponent != 1:
                image = 255 * (image / 255) ** exponent
            if blur:
                image = np.asarray(cv2.GaussianBlur(image, (0, 0), blur))
            images.append(np.rint(image).astype(np.uint8))
        return images


def plain_bench(rng: np.random.Generator) -> Picture:
    """Return a wall and a table of similar greys, and a dark platter."""
    wall = rng.uniform(90, 170)
    picture = np.full((HEIGHT, WIDTH, 3), wall, np.float32) + rng.normal(0, 6, 3).astype(np.float32)
    picture *= np.linspace(1.04, 0.94, HEIGHT, dtype=np.float32)[:, None, None]
    horizon = int(rng.integers(150, 175))
    picture[horizon:] = wall * rng.uniform(0.7, 0.95) + rng.normal(0, 8, 3)
    picture = np.asarray(cv2.GaussianBlur(picture, (0, 0), 2.5), np.float32)
    _platter(picture, np.full(3, rng.uniform(60, 110)))
    return picture


def other_bench(rng: np.random.Generator) -> Picture:
    """Return another wall and table, with a pattern and clutter, and a platter of any brightness."""
    horizon = int(rng.integers(120, 170))
    picture = _pattern(rng, rng.uniform(50, 200) + rng.normal(0, 25, 3))
    if rng.random() < 0.5:  # tiles
        step, relief = int(rng.integers(18, 40)), rng.uniform(-30, 30)
        picture[::step] += relief
        picture[:, ::step] += relief
    table = _pattern(rng, rng.uniform(50, 190) + rng.normal(0, 30, 3))
    if rng.random() < 0.7:  # wood
        grain = np.repeat(rng.normal(0, 18, (1, WIDTH // 3)).astype(np.float32), WIDTH, axis=0)
        along = cv2.resize(grain, (WIDTH, WIDTH))
        table += (along if rng.random() < 0.5 else along.T)[:HEIGHT, :, None]
    picture[horizon:] = table[horizon:]
    picture = np.asarray(cv2.GaussianBlur(picture, (0, 0), rng.uniform(0.5, 1.2)), np.float32)
    for _ in range(int(rng.integers(3, 7))):
        _clutter(picture, rng)
    _platter(picture, rng.uniform(40, 190) + rng.normal(0, 8, 3))
    return picture


def _pattern(rng: np.random.Generator, colour: NDArray[np.float64]) -> Picture:
    """Return mostly grey noise around a colour, with several grain sizes; the coarse ones are the strongest."""
    picture = np.broadcast_to(colour, (HEIGHT, WIDTH, 3)).astype(np.float32)
    for cells in _GRAINS:
        strength = 26 / np.sqrt(cells / _GRAINS[0])
        shape = max(2, cells * HEIGHT // WIDTH), cells
        grain = rng.normal(0, strength, (*shape, 1)) + rng.normal(0, 0.35 * strength, (*shape, 3))
        picture += cv2.resize(grain.astype(np.float32), (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
    return picture


def _clutter(picture: Picture, rng: np.random.Generator) -> None:
    """Draw a thing next to or behind the platter."""
    colour = rng.uniform(20, 235, 3).tolist()
    half = int(rng.integers(10, 38)), int(rng.integers(10, 45))
    if rng.random() < 0.75:
        x, y = int(rng.choice([rng.integers(0, 90), rng.integers(230, WIDTH)])), int(rng.integers(60, 220))
    else:
        x, y = int(rng.integers(90, 230)), int(rng.integers(30, 110))
    if rng.random() < 0.5:
        cv2.rectangle(picture, (x - half[0], y - half[1]), (x + half[0], y + half[1]), colour, -1)
    else:
        cv2.ellipse(picture, (x, y), half, float(rng.uniform(0, 180)), 0, 360, colour, -1)
    if rng.random() < 0.5:
        stripe = rng.uniform(0, 255, 3).tolist()
        cv2.line(picture, (x - half[0], y), (x + half[0], y + half[1] // 2), stripe, 3)


def _platter(picture: Picture, colour: NDArray[np.float64]) -> None:
    x, y = FOOT_PX
    for down, share in ((6, 0.8), (10, 1.0)):
        cv2.ellipse(picture, (x, y - down), _PLATTER_PX, 0, 0, 360, (share * colour).tolist(), -1)
