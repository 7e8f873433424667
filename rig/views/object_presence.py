"""Sees by the camera when the next object stands on the table: for benches where nobody presses a key."""

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from rig.bench import Bench
from rig.config import ViewConfig
from rig.core.clock import seconds_between
from rig.views.description import within

GRID: Final = 48
"""Cells along each side of the picture that is compared."""
STEP_LEVELS: Final = 8.0
"""A cell has changed when its level did by more than this, beyond what the whole picture did (a cloud, a lamp)."""
CELLS: Final = 6
"""So many changed cells, of `GRID`², are something: an object of 2 cm on a picture of 40 cm."""

Picture = NDArray[np.float32]


class TableWatcher:
    """An operator who waits until somebody has put the next object on the table and taken the hands away.

    The first time it is asked the table must be empty: that is what an empty table looks like. From then on an object
    is a new one when the picture is at rest, is not that of the empty table, and is another one than when the waiting
    began or the table was empty meanwhile. The table must stand at the same angle each time.

    Parameters
    ----------
    bench
        An open one.
    still_s
        How long the picture must be at rest.
    poll_s
        Time between two looks.
    """

    def __init__(self, bench: Bench, *, still_s: float = 1.5, poll_s: float = 0.25) -> None:
        self._bench = bench
        self._still_s = still_s
        self._poll_s = poll_s
        self._empty: Picture | None = None

    def place(self, name: str | None) -> None:
        """Return when the next object stands there; one that is to be enrolled (``name``) stands there already.

        Raises
        ------
        DeviceSilent
            The camera gives no frame.
        """
        if name is not None:
            return
        clock = self._bench.clock
        before = self._look()
        old: Picture | None = None
        if self._empty is None:
            self._empty = before
        else:
            old = before
        rest_ns = clock.now_ns()
        while True:
            clock.sleep(self._poll_s)
            now = self._look()
            if changed(before, now):
                rest_ns = clock.now_ns()
            elif seconds_between(rest_ns, clock.now_ns()) >= self._still_s:
                if not changed(self._empty, now):
                    self._empty, old = now, None  # follows the light of the day
                elif old is None or changed(old, now):
                    return
            before = now

    def clear(self) -> bool:
        """Whether nothing stands on the table: so it does by agreement, until the first object was waited for."""
        return self._empty is None

    def _look(self) -> Picture:
        frame = self._bench.camera.capture(self._bench.clock.now_ns())
        return picture(frame.image_bgr, self._bench.config.view)


def picture(image_bgr: NDArray[np.uint8], config: ViewConfig) -> Picture:
    """Return the region of a frame as it is compared, float32 (`GRID`, `GRID`, 3)."""
    return cv2.resize(within(image_bgr, config.roi), (GRID, GRID), interpolation=cv2.INTER_AREA).astype(np.float32)


def changed_cells(a: Picture, b: Picture) -> int:
    """Return how many of the cells of two pictures are another, beyond other light."""
    difference = b - a
    difference -= np.median(difference, axis=(0, 1))
    return int(np.count_nonzero(np.abs(difference).max(axis=2) > STEP_LEVELS))


def changed(a: Picture, b: Picture) -> bool:
    """Return whether something in the picture, float32 (`GRID`, `GRID`, 3), is another; other light alone is not."""
    return changed_cells(a, b) >= CELLS
