"""The angle of the table from the card of its home mark, a small ChArUco board at a fixed place of the platter."""

from math import degrees

import cv2
import numpy as np

from hbr.core.angles import wrap180
from rig.config import MarkConfig
from rig.views.charuco_board import BoardDetection, CharucoBoard

FEWEST_CORNERS = 4
"""A pose from fewer corners has several solutions."""
ASKEW_DEG = 8.0  # larger: a card that was moved is used; smaller: a small card in noise is not
"""Largest rotation of the card about another axis than the table's."""


def mark_angle_deg(seen: BoardDetection, mark: MarkConfig) -> float | None:
    """Return the table's angle within a revolution, from −180° to 180°; None if the card is not seen at its place."""
    if seen.ids.size < FEWEST_CORNERS:
        return None
    fx, fy, cx, cy, *distortion = mark.camera
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    # A small plane has two poses that look nearly alike; that of the card differs from home only about the axis.
    _, poses, _, _ = cv2.solvePnPGeneric(
        CharucoBoard(*mark.card).points_mm()[seen.ids],
        seen.corners_px,
        matrix,
        np.array(distortion),
        flags=cv2.SOLVEPNP_IPPE,
    )
    home, axis = cv2.Rodrigues(np.array(mark.rotation))[0], np.array(mark.axis)
    since_home = [cv2.Rodrigues(cv2.Rodrigues(pose)[0] @ home.T)[0].ravel() for pose in poses]
    askew, angle = min((float(np.linalg.norm(r - r @ axis * axis)), float(r @ axis)) for r in since_home)
    return float(wrap180(degrees(angle))) if degrees(askew) <= ASKEW_DEG else None
