"""The outline of the object in a view, to draw over the live picture."""

import cv2
import numpy as np
from numpy.typing import NDArray

from rig.bench import Bench
from rig.core.errors import RigError
from rig.views.description import ViewDescriber, within
from rig.views.empty_table import empty_table_status

TOLERANCE_PX = 1.0
"""Points that change the outline by less are left out."""


class Outliner:
    """The outlines of the object in the views of one job, with the segmentation of their descriptions."""

    def __init__(self, bench: Bench) -> None:
        self._region = bench.config.view.roi
        status = empty_table_status(bench)
        self._describer = ViewDescriber(
            bench.config.view, empty_table=None if status.table is None else status.table.image_bgr
        )

    def __call__(self, image_bgr: NDArray[np.uint8]) -> dict[str, list[list[int]] | list[int]] | None:
        """Return ``box`` (x, y, width, height) and ``points`` in pixels of the frame; None if no object is found."""
        try:
            found = self._describer.segment(image_bgr)
        except (RigError, ValueError):
            return None
        if found.box is None:
            return None
        x, y = (0, 0) if self._region is None else self._region[:2]
        height, width = within(image_bgr, self._region).shape[:2]
        mask = found.frame_mask(width, height).astype(np.uint8)
        contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
        points = max(contours, key=cv2.contourArea, default=np.empty((0, 1, 2), np.int32))
        shortened = cv2.approxPolyDP(points, TOLERANCE_PX, closed=True) if len(points) else points
        left, top, box_width, box_height = found.box
        return {
            "box": [left + x, top + y, box_width, box_height],
            "points": [[int(px) + x, int(py) + y] for px, py in shortened.reshape(-1, 2)],
        }
