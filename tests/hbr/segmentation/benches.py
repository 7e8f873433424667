"""Pictures of a wall, a table and a platter: a plain one, and ones with a pattern and clutter."""

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from hbr.drawing.bench import FOOT_PX, HEIGHT, WIDTH, Picture

#: Half axes of the platter in pixels, and the grain of the surfaces.
_PLATTER_PX: Final = (105, 27)
_GRAINS: Final = (3, 6, 12, 24, 48)  # cells of noise across the surface; the coarser ones are stronger


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
