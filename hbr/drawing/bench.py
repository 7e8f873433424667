"""Drawn benches after a change of table, wall, light, lens, placement and holder, all at once.

A `DrawnBench` is a wall, a table, a platter and clutter. A `Visit` is one search on it: light, camera and placement are
drawn once and hold for all its views. The table rotates between the views: the object and the platter's pattern rotate
with it, everything else stands still. Pictures are 320 x 240.
"""

from dataclasses import dataclass
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from hbr.core.arrays import ImageArray

Picture = NDArray[np.float32]
"""BGR, not clipped, so that the illumination can be changed later."""

# a quarter of a camera's pixels: an experiment draws thousands of frames, and no descriptor sees finer detail
WIDTH: Final = 320
HEIGHT: Final = 240
#: Position of the middle of an object's foot, and side of an object's photograph, in pixels.
FOOT_PX: Final = (160, 196)
SIDE_PX: Final = 150
#: Half axes of the platter in pixels.
_PLATTER_PX: Final = (96.0, 27.0)
# cells of noise across the surface, from large stains to fine grain; the coarser ones are stronger
_GRAINS: Final = (3, 6, 12, 24, 48, 96)
#: Elevation of the camera at the enrollment.
_ELEVATION_DEG: Final = 15.0


class DrawnFrame(NamedTuple):
    """A frame with the object's visible pixels, bool (240, 320)."""

    image: ImageArray
    mask: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class VisitChange:
    """Largest changes of a visit."""

    gain: float = 0.0
    colour: float = 0.0
    gradient: float = 0.0
    """Relative brightness, relative brightness of each channel, and change of the light across the frame."""
    gamma: float = 0.0
    """Logarithm of the sensor's exponent."""
    placement: float = 0.0
    """Distance of the object from the axis, relative to the side of its photograph."""
    scale: float = 0.0
    """Relative change of the size."""
    elevation_deg: float = 0.0
    """Change of the camera's elevation."""
    shadow: float = 0.3
    """Share of the light that is missing in the cast shadow."""
    specular: float = 0.0
    """Grey levels of highlights on the object."""
    defocus_px: float = 0.0
    """Standard deviation of the blur."""
    holder: float = 0.0
    """Probability of a holder in front of the object."""
    noise: float = 1.5
    """Standard deviation of the sensor's noise, in grey levels."""


ENROLLMENT: Final = VisitChange()
# the same bench after some time: the same camera and place, slightly other light
MILD: Final = VisitChange(
    gain=0.1, colour=0.04, gradient=0.1, placement=0.03, scale=0.03, shadow=0.4, specular=30, noise=2
)
# another bench: another camera and lamp, and another hand that places the object
HARD: Final = VisitChange(
    gain=0.3, colour=0.2, gradient=0.3, gamma=0.2, placement=0.08, scale=0.15, elevation_deg=6.0, shadow=0.6,
    specular=140.0, defocus_px=1.6, holder=0.6, noise=3.0,
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class DrawnBench:
    """A bench without an object."""

    still: Picture
    """float32 array (240, 320, 3): everything that stands still, with the platter's rim."""
    top: Picture
    """float32 array (192, 192, 3): the platter from above."""

    @classmethod
    def drawn(
        cls, rng: np.random.Generator, *, textured: float = 1.0, clutter: int = 6, plain: bool = False
    ) -> "DrawnBench":
        """Draw a bench; ``textured`` is the contrast of its patterns, ``clutter`` the largest number of objects.

        With ``plain`` wall and table are one plain backdrop, before which the platter is visible.
        """
        horizon = int(rng.integers(110, 175))
        textured = 0.0 if plain else textured
        still = _surface(rng, textured)
        if not plain:
            still[horizon:] = _surface(rng, textured)[horizon:]
            if rng.random() < 0.5:  # a low camera sees the table's pattern compressed
                still[horizon:] = cv2.resize(_surface(rng, textured), (WIDTH, 2 * (HEIGHT - horizon)))[::2]
        still = np.asarray(cv2.GaussianBlur(still, (0, 0), rng.uniform(0.5, 1.0)), np.float32)
        if textured:
            for _ in range(int(rng.integers(clutter // 2, clutter + 1))):
                _thing(still, rng)
        colour = rng.uniform(30, 200) + rng.normal(0, 12, 3)
        for down, share in ((7, 0.6), (5, 0.8)):
            _ellipse(still, down, share * colour)
        top = np.full((192, 192, 3), colour, np.float32)
        kind = rng.random()
        if textured and kind < 0.35:  # rings
            for radius in range(12, 96, int(rng.integers(8, 30))):
                cv2.circle(top, (96, 96), radius, (colour * rng.uniform(0.7, 1.3)).tolist(), 2)
        elif textured and kind < 0.6:  # marks that rotate
            for _ in range(int(rng.integers(2, 9))):
                ends = (96 + 96 * rng.uniform(-1, 1, 4)).astype(int).tolist()
                cv2.line(
                    top, tuple(ends[:2]), tuple(ends[2:]), rng.uniform(20, 230, 3).tolist(), int(rng.integers(1, 5))
                )
        top += cv2.resize(rng.normal(0, 5 * textured, (48, 48, 1)).astype(np.float32), (192, 192))[:, :, None]
        return cls(still, top)

    def seen(self, table_deg: float) -> Picture:
        """Return the bench with the platter at this angle."""
        angle = np.radians(-table_deg)
        across, down = _PLATTER_PX
        # from the platter seen from above to the picture: rotate, compress, move
        matrix = np.array([[across / 96, 0, 0], [0, down / 96, 0]]) @ np.array(
            [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
        )
        matrix[:, 2] = np.array([FOOT_PX[0], FOOT_PX[1] - 6]) - matrix[:, :2] @ np.array([95.5, 95.5])
        disc = np.zeros((192, 192), np.float32)
        cv2.circle(disc, (96, 96), 95, 1.0, -1)
        share = cv2.warpAffine(disc, matrix, (WIDTH, HEIGHT))[:, :, None]
        shown: Picture = self.still * (1 - share) + cv2.warpAffine(self.top, matrix, (WIDTH, HEIGHT)) * share
        return shown


class Visit:
    """One search or enrollment on a bench.

    Parameters
    ----------
    bench : Bench
    change : Change
        What differs from the enrollment.
    rng : numpy Generator
        Equal states give equal visits.
    """

    def __init__(self, bench: DrawnBench, change: VisitChange, rng: np.random.Generator) -> None:
        self._bench, self._change, self._rng = bench, change, rng
        self._scale = 1 + rng.uniform(-1, 1) * change.scale
        tilt_deg = _ELEVATION_DEG + rng.uniform(-1, 1) * change.elevation_deg
        self._upright = self._scale * np.cos(np.radians(tilt_deg)) / np.cos(np.radians(_ELEVATION_DEG))
        self._away = rng.uniform(0, 1) * change.placement * SIDE_PX, rng.uniform(0, 360)
        self._flat = np.sin(np.radians(tilt_deg))
        gain = 1 + rng.uniform(-1, 1) * change.gain
        self._channels = gain * (1 + rng.uniform(-1, 1, 3) * change.colour)
        direction, slope = rng.uniform(0, 2 * np.pi), rng.uniform(0, 1) * change.gradient
        x, y = np.arange(WIDTH) / WIDTH - 0.5, np.arange(HEIGHT)[:, None] / HEIGHT - 0.5
        self._light = 1 + slope * (x * np.cos(direction) + y * np.sin(direction))
        self._exponent = float(np.exp(rng.uniform(-1, 1) * change.gamma))
        self._blur_px = rng.uniform(0.4, 1) * change.defocus_px
        self._lean, self._length = rng.uniform(-0.8, 0.8), rng.uniform(0.25, 0.5)
        self._shade = rng.uniform(0.5, 1) * change.shadow
        self._soft_px = rng.uniform(2, 5)
        self._holder = _holder(rng) if rng.random() < change.holder else None
        self._later = rng.random() < 0.5

    def empty(self, table_deg: float = 0.0) -> ImageArray:
        """Return the picture of the empty table in this light, with the holder in half of the visits."""
        return self._photographed(self._bench.seen(table_deg), self._later)[0]

    def photograph(
        self,
        image_bgr: ImageArray,
        mask: NDArray[np.bool_],
        table_deg: float,
        *,
        foot_px: tuple[float, float] | None = None,
        px_per_px: float | None = None,
    ) -> DrawnFrame:
        """Return the frame of an object at a table angle.

        Parameters
        ----------
        image_bgr : uint8 array (H, W, 3)
            A photograph of the object from this side.
        mask : bool array (H, W)
            Its pixels.
        foot_px : (float, float), optional
            Pixel of the photograph on the table's axis; by default the middle of the object's lower edge.
        px_per_px : float, optional
            Pixels of the frame per pixel of the photograph; by default the photograph's side becomes `SIDE_PX`.
        """
        side = SIDE_PX / max(image_bgr.shape[:2]) if px_per_px is None else px_per_px
        seen, cover = self._placed(image_bgr, mask, table_deg, side, foot_px)
        shade = missing_light(cover, self._shade, self._lean, self._length, self._soft_px)
        ground = self._bench.seen(table_deg) * (1 - shade)[:, :, None]
        picture = ground * (1 - cover[:, :, None]) + seen * cover[:, :, None]
        draw_highlights(picture, cover, self._change.specular, self._rng)
        image, hidden = self._photographed(picture, False)
        return DrawnFrame(image, (cover > 0.5) & ~hidden)

    def _placed(
        self,
        image: ImageArray,
        mask: NDArray[np.bool_],
        table_deg: float,
        side: float,
        foot_px: tuple[float, float] | None,
    ) -> tuple[Picture, Picture]:
        scale, upright = self._scale * side, self._upright * side
        if foot_px is None:
            rows, columns = np.nonzero(mask)
            foot_px = (columns.min() + columns.max()) / 2, float(rows.max())
        x, y = foot_px
        away_px, from_deg = self._away
        around = np.radians(from_deg - table_deg)
        to_x = FOOT_PX[0] + away_px * np.cos(around)
        to_y = FOOT_PX[1] + away_px * self._flat * np.sin(around)
        move = np.array([[scale, 0, to_x - scale * x], [0, upright, to_y - upright * y]])
        inner = cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(np.float32)
        edge = np.minimum(cv2.GaussianBlur(mask.astype(np.float32), (0, 0), 0.7), 0.5 * (inner + mask))
        seen = cv2.warpAffine(image, move, (WIDTH, HEIGHT), borderMode=cv2.BORDER_REPLICATE).astype(np.float32)
        return seen, np.asarray(cv2.warpAffine(edge.astype(np.float32), move, (WIDTH, HEIGHT)), np.float32)

    def _photographed(self, picture: Picture, without_holder: bool) -> tuple[ImageArray, NDArray[np.bool_]]:
        """Return the picture as the camera sees it, and the pixels of the holder."""
        hidden = np.zeros((HEIGHT, WIDTH), np.float32)
        if self._holder is not None and not without_holder:
            foot, tip, thick, colour = self._holder
            cv2.line(hidden, foot, tip, 1.0, thick, cv2.LINE_AA)
            picture = picture * (1 - hidden[:, :, None]) + hidden[:, :, None] * colour
        picture = np.clip(picture * self._light[:, :, None] * self._channels, 0, 255).astype(np.float32)
        if self._exponent != 1:
            picture = np.asarray(255 * (picture / 255) ** self._exponent, np.float32)
        if self._blur_px:
            picture = np.asarray(cv2.GaussianBlur(picture, (0, 0), self._blur_px), np.float32)
        noisy = picture + self._rng.normal(0, 1, picture.shape).astype(np.float32) * self._change.noise
        return np.clip(np.rint(noisy), 0, 255).astype(np.uint8), hidden > 0.5


def missing_light(cover: Picture, strength: float, lean: float, length: float, soft_px: float) -> Picture:
    """Return the share of the light that is missing on the ground, (H, W): at the object's foot, and in its shadow.

    ``cover`` (H, W) is the share of the object in each pixel; the shadow falls ``lean`` to the side per ``length``.
    """
    left, top, width, height = cv2.boundingRect((cover > 0.5).astype(np.uint8))
    foot = np.zeros_like(cover)
    cv2.ellipse(foot, (left + width // 2, top + height - 3), (int(0.55 * width) + 3, 8), 0, 0, 360, 1, -1)
    shade = 0.35 * cv2.GaussianBlur(foot, (0, 0), 3)
    if strength:
        bottom = top + height
        fallen = np.array([[1, lean, -lean * bottom], [0, length, bottom * (1 - length)]])
        cast = cv2.GaussianBlur(cv2.warpAffine(cover, fallen, (cover.shape[1], cover.shape[0])), (0, 0), soft_px)
        shade = 1 - (1 - shade) * (1 - strength * cast)
    return np.asarray(shade, np.float32)


def draw_highlights(picture: Picture, cover: Picture, strength: float, rng: np.random.Generator) -> None:
    """Draw one to three highlights of this many grey levels on the object."""
    rows, columns = np.nonzero(cover > 0.5)
    if not strength or not len(rows):
        return
    for _ in range(int(rng.integers(1, 4))):
        i = int(rng.integers(len(rows)))
        axes = int(rng.integers(2, 9)), int(rng.integers(2, 9))
        spot = np.zeros_like(cover)
        cv2.ellipse(spot, (int(columns[i]), int(rows[i])), axes, float(rng.uniform(0, 180)), 0, 360, 1, -1)
        spot = np.asarray(cv2.GaussianBlur(spot, (0, 0), 2), np.float32) * cover
        picture += spot[:, :, None] * np.float32(rng.uniform(0.4, 1) * strength)


def _holder(rng: np.random.Generator) -> tuple[tuple[int, int], tuple[int, int], int, NDArray[np.float32]]:
    """Draw a bar in front of the object, from the lower border."""
    x = int(FOOT_PX[0] + rng.uniform(-45, 45))
    tip = x + int(rng.integers(-25, 26)), int(rng.uniform(120, 190))
    return (x, HEIGHT), tip, int(rng.integers(5, 12)), rng.uniform(20, 220, 3).astype(np.float32)


def _surface(rng: np.random.Generator, textured: float) -> Picture:
    """Return a pattern: grain of several sizes, and often tiles, stripes or wood."""
    colour = rng.uniform(50, 200) + rng.normal(0, 25, 3) * textured
    picture = np.full((HEIGHT, WIDTH, 3), colour, np.float32)
    for cells in _GRAINS:
        strength = textured * rng.uniform(10, 30) / np.sqrt(cells / _GRAINS[0])
        shape = max(2, cells * HEIGHT // WIDTH), cells
        grain = rng.normal(0, strength, (*shape, 1)) + rng.normal(0, 0.4 * strength, (*shape, 3))
        picture += cv2.resize(grain.astype(np.float32), (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
    kind = rng.random()
    relief = textured * rng.uniform(-40, 40)
    if kind < 0.25:  # tiles
        step = int(rng.integers(14, 44))
        picture[::step] += relief
        picture[:, ::step] += relief
    elif kind < 0.5:  # stripes
        x, y = np.arange(WIDTH), np.arange(HEIGHT)[:, None]
        angle = rng.uniform(0, np.pi)
        wave = np.sin((x * np.cos(angle) + y * np.sin(angle)) * rng.uniform(0.15, 0.8))
        picture += (relief * np.sign(wave))[:, :, None].astype(np.float32)
    elif kind < 0.75:  # wood
        grain = np.repeat(rng.normal(0, 20 * textured, (1, WIDTH // 3)).astype(np.float32), WIDTH, axis=0)
        along = cv2.resize(grain, (WIDTH, WIDTH))
        picture += (along if rng.random() < 0.5 else along.T)[:HEIGHT, :, None]
    return picture


def _thing(picture: Picture, rng: np.random.Generator) -> None:
    """Draw a thing beside or behind the platter."""
    colour = rng.uniform(15, 240, 3)
    half = int(rng.integers(8, 36)), int(rng.integers(8, 50))
    x = int(rng.choice([rng.integers(0, 95), rng.integers(225, WIDTH), rng.integers(95, 225)], p=[0.35, 0.35, 0.3]))
    y = int(rng.integers(50, 220)) if not 95 <= x < 225 else int(rng.integers(20, 120))
    before = picture.copy()
    if rng.random() < 0.5:
        cv2.rectangle(picture, (x - half[0], y - half[1]), (x + half[0], y + half[1]), colour.tolist(), -1)
    else:
        cv2.ellipse(picture, (x, y), half, float(rng.uniform(0, 180)), 0, 360, colour.tolist(), -1)
    drawn = np.any(picture != before, axis=2)
    if rng.random() < 0.6:  # print on it
        step = int(rng.integers(4, 16))
        band = (np.arange(HEIGHT)[:, None] // step + (np.arange(WIDTH) // step if rng.random() < 0.4 else 0)) % 2 == 0
        picture[drawn & band] = rng.uniform(15, 240, 3)


def _ellipse(picture: Picture, down: int, colour: NDArray[np.float64]) -> None:
    axes = int(_PLATTER_PX[0]), int(_PLATTER_PX[1])
    cv2.ellipse(picture, (FOOT_PX[0], FOOT_PX[1] - 6 + down), axes, 0, 0, 360, colour.tolist(), -1)
