"""Detects by the camera whether an object is on the table, and when the next one is there.

Decision: docs/decisions/0002.
"""

from collections.abc import Iterator
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

import hbr
from hbr.segmentation.background import Background, SegmentedFrame
from hbr.segmentation.silhouette import shares
from rig.bench import Bench
from rig.config import ViewConfig
from rig.core.clock import seconds_between
from rig.views.description import within

GRID: Final = 48
"""Number of cells along each side of the images that are compared."""
STEP_LEVELS: Final = 8.0
"""A cell has changed if its level changed by more than this, after the change of the whole image is subtracted."""
CELLS: Final = 6
"""Smallest number of changed cells of `GRID`² that are an object: for example 2 cm in an image of 40 cm."""

STILL_S: Final = 1.5
"""How long the image must be still."""
POLL_S: Final = 0.25
"""Time between two frames."""

SPECK: Final = np.ones((3, 3), np.uint8)
"""Smaller groups of pixels are noise, in images of 128 pixels: an object of 3 % of the image's width is larger."""

LEAST_ROTATION_DEG: Final = 29.0  # of a step to 30°, with the error of the arrival
"""After a smaller rotation, a small object beside the axis may not look different."""
# an empty simulated table has 0.0008 or less, a photographed object 0.9 or more; less if it is under 2 cm
MOST_PROBABLE: Final = 0.002
"""No pixel of an empty table shows the object with a higher probability by the segmentation's network."""
SAME_LEVELS: Final = 4.0  # twice the noise of the cells
"""No cell changes by more than this when an empty table rotates."""

Cells = NDArray[np.float32]


class TableWatcher:
    """An operator that waits until the next object is on the table and nothing moves.

    At the first call the table must be empty, because later images are compared with that image. An object is new if
    the image is still, differs from the empty table, and either differs from the image at the start of the wait or
    follows an empty table. The table must be at the same angle each time.
    """

    def __init__(self, bench: Bench) -> None:
        self._bench = bench
        self._empty: Cells | None = None

    def place(self, name: str | None) -> None:
        """Wait until the next object is on the table. An object to be enrolled (``name``) is there already.

        Raises `DeviceSilent`: the camera gives no frame.
        """
        if name is not None:
            return
        frames = self._frames()
        first, _ = next(frames)
        old = None if self._empty is None else first
        if self._empty is None:
            self._empty = first
        for now, still_s in frames:
            if still_s < STILL_S:
                continue  # a hand may still be there
            if not changed(self._empty, now):
                self._empty, old = now, None  # follow slow changes of the daylight
            elif old is None or changed(old, now):
                return

    def wait_until_still(self) -> None:
        """Wait until nothing moves before the camera, for example after the operator has scanned a barcode.

        Raises `DeviceSilent`: the camera gives no frame.
        """
        for _, still_s in self._frames():
            if still_s >= STILL_S:
                return

    def clear(self) -> bool:
        """Return whether the table is empty: it must be until `place` has waited for the first object."""
        return self._empty is None

    def _frames(self) -> Iterator[tuple[Cells, float]]:
        """Yield one frame after the other, and for how long nothing has moved."""
        clock = self._bench.clock
        before, still_since_ns = self._capture(), clock.now_ns()
        yield before, 0.0
        while True:
            clock.sleep(POLL_S)
            now = self._capture()
            if changed(before, now):
                still_since_ns = clock.now_ns()
            yield now, seconds_between(still_since_ns, clock.now_ns())
            before = now

    def _capture(self) -> Cells:
        frame = self._bench.camera.capture(self._bench.clock.now_ns())
        return shrunk(frame.image_bgr, self._bench.config.view)


def is_empty_table(image_bgr: NDArray[np.uint8], empty_table_bgr: NDArray[np.uint8] | None, config: ViewConfig) -> bool:
    """Return whether a frame shows the empty table, in any light.

    Nothing may differ from the empty-table image: no speck by the segmentation's own measures, and no cells that
    `TableWatcher` would notice. Without an image of the frame's size, the whole frame must have one colour.
    """
    if empty_table_bgr is None or empty_table_bgr.shape != image_bgr.shape:
        cells = shrunk(image_bgr, config)
        return changed_cells(np.zeros_like(cells), cells) == 0
    frame, empty = (SegmentedFrame(within(one, config.roi)) for one in (image_bgr, empty_table_bgr))
    return _same(frame, empty)


def probability_of_nothing(
    first_bgr: NDArray[np.uint8], rotated_bgr: NDArray[np.uint8], config: ViewConfig
) -> float | None:
    """Return the highest probability of a pixel to show an object, if two views show an empty table; None otherwise.

    Between the views of one size the table rotated by `LEAST_ROTATION_DEG` or more. A round object is not changed by
    that, and a faint one is not seen by the network. So both must agree: nothing rotates, in any light, and the network
    sees no object in either view, with and without the background that the other view shows. Marks on the platter and
    surroundings that move leave it open.
    """
    first, rotated = (SegmentedFrame(within(one, config.roi)) for one in (first_bgr, rotated_bgr))
    if not _same(rotated, first, levels=SAME_LEVELS, cells=1):
        return None
    highest = 0.0
    for frame, other in ((first, rotated), (rotated, first)):
        learned = Background.learned([other.small], other.image.shape[:2])
        for difference in (None, learned.difference(frame.small)):
            highest = max(highest, float(shares(frame, difference).object.max()))
    return highest if highest <= MOST_PROBABLE else None


def _same(frame: SegmentedFrame, other: SegmentedFrame, *, levels: float = STEP_LEVELS, cells: int = CELLS) -> bool:
    """Return whether a frame shows no speck and no cells that another one does not show, in any light."""
    found = frame.difference(hbr.Background(other.image))
    if not found.reliable or cv2.erode((found.certain | found.possible).astype(np.uint8), SPECK).any():
        return False
    corrected = frame.small * np.exp(found.correction.over(*frame.small.shape[:2]))
    return changed_cells(_cells(other.small), _cells(corrected), levels=levels) < cells


def shrunk(image_bgr: NDArray[np.uint8], config: ViewConfig) -> Cells:
    """Return the region of interest of a frame as cells, float32 (`GRID`, `GRID`, 3)."""
    return _cells(within(image_bgr, config.roi))


def _cells(image: NDArray[np.uint8] | NDArray[np.float32]) -> Cells:
    return cv2.resize(image, (GRID, GRID), interpolation=cv2.INTER_AREA).astype(np.float32)


def changed_cells(a: Cells, b: Cells, *, levels: float = STEP_LEVELS) -> int:
    """Return how many cells differ by more than this, apart from a change of the illumination."""
    difference = b - a
    difference -= np.median(difference, axis=(0, 1))
    return int(np.count_nonzero(np.abs(difference).max(axis=2) > levels))


def changed(a: Cells, b: Cells) -> bool:
    """Return whether the scene differs, float32 (`GRID`, `GRID`, 3) each, apart from a change of the illumination."""
    return changed_cells(a, b) >= CELLS
