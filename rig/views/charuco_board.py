"""The calibration board: layout, print, detection of its corners, and the table's angle by its home mark."""

from dataclasses import dataclass
from math import degrees
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from hbr.core.angles import wrap180
from rig.config import MarkConfig

DICTIONARY: Final = cv2.aruco.DICT_4X4_50


@dataclass(frozen=True, slots=True)
class CharucoBoard:
    """A ChArUco board: a chessboard with a marker in each white square, which identifies the corners.

    ``columns`` and ``rows`` count the squares; around them is a white margin.
    """

    columns: int = 8
    rows: int = 6
    square_mm: float = 15.0
    marker_mm: float = 11.0
    margin_mm: float = 5.0

    @property
    def size_mm(self) -> tuple[float, float]:
        """Width and height of all squares, without the margin."""
        return self.columns * self.square_mm, self.rows * self.square_mm

    @property
    def corners(self) -> int:
        """Number of inner corners."""
        return (self.columns - 1) * (self.rows - 1)

    def layout(self) -> "cv2.aruco.CharucoBoard":
        """Return the board as an OpenCV object."""
        return cv2.aruco.CharucoBoard(
            (self.columns, self.rows), self.square_mm, self.marker_mm, cv2.aruco.getPredefinedDictionary(DICTIONARY)
        )

    def points_mm(self) -> NDArray[np.float64]:
        """Return the inner corners in the board's coordinates, float64 (n, 3), z = 0."""
        return np.asarray(self.layout().getChessboardCorners(), dtype=np.float64).reshape(-1, 3)

    def picture(self, px_mm: int) -> NDArray[np.uint8]:
        """Return the print with its margin, uint8 (rows, columns), with ``px_mm`` pixels for each millimetre."""
        margin = round(self.margin_mm * px_mm)
        size = (
            round(self.columns * self.square_mm * px_mm) + 2 * margin,
            round(self.rows * self.square_mm * px_mm) + 2 * margin,
        )
        return np.asarray(self.layout().generateImage(size, marginSize=margin, borderBits=1), dtype=np.uint8)


@dataclass(frozen=True, slots=True)
class BoardDetection:
    """The board's corners in one image: ids, int (n,), positions, float64 (n, 2) in pixels, and ids of the markers."""

    ids: NDArray[np.int64]
    corners_px: NDArray[np.float64]
    marker_ids: NDArray[np.int64]


def detect_board(board: CharucoBoard, image_bgr: NDArray[np.uint8]) -> BoardDetection:
    """Find the board in an image, uint8 (H, W, 3). The result has no corners if the board is not visible.

    The shapes of OpenCV's results differ between versions from 4.7 on.
    """
    grey = cv2.cvtColor(image_bgr, cv2.COLOR_BGR2GRAY)
    detector = cv2.aruco.CharucoDetector(board.layout())
    found: list[Any] = list(detector.detectBoard(grey))  # None for parts that were not found
    corners, ids, _, marker_ids = ([] if part is None else part for part in found)
    return BoardDetection(
        np.asarray(ids, dtype=np.int64).ravel(),
        np.asarray(corners, dtype=np.float64).reshape(-1, 2),
        np.asarray(marker_ids, dtype=np.int64).ravel(),
    )


# The home mark: a small board at a fixed place of the platter

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
