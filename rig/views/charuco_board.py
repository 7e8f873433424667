"""The calibration board: its layout, its print, and the detection of its corners."""

from dataclasses import dataclass
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

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
