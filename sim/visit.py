"""Images of the simulated camera after a hard change of the bench: the drawn object on a bench of `rig eval`."""

from typing import Protocol

import cv2
import numpy as np

from hbr.drawing.bench import Visit
from sim.objects.projection import CENTRE_PX, HEIGHT, WIDTH, Image

_GROUNDS = (24, 232)  # dark and bright, but not clipped: a shadow still changes both
_OPAQUE = 104  # an object's pixels differ by less on the two grounds; those of its soft shadow by more


class DrawFunction(Protocol):
    """A function that draws an object into an image, uint8 (480, 640, 3)."""

    def __call__(self, image: Image, /) -> None: ...


def seen_on_visit(visit: Visit, draw: DrawFunction | None, table_deg: float) -> Image:
    """Return the camera's image under nominal light, uint8 (480, 640, 3); without an object, the empty table.

    The object is cut out by drawing it on a dark and on a bright ground. The bench is drawn at half the size.
    """
    if draw is None:
        seen = visit.empty(table_deg)
    else:
        dark, bright = (np.full((HEIGHT, WIDTH, 3), level, np.uint8) for level in _GROUNDS)
        draw(dark)
        draw(bright)
        mask = np.max(cv2.absdiff(dark, bright), axis=2) < _OPAQUE
        foot_px = float(CENTRE_PX[0]), float(CENTRE_PX[1])
        seen = visit.photograph(dark, mask, table_deg, foot_px=foot_px, px_per_px=0.5).image
    return np.asarray(cv2.resize(seen, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC), dtype=np.uint8)
