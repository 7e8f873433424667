"""The calibration board: its layout, its picture, and where its corners are in an image."""

from dataclasses import dataclass
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

DICTIONARY: Final = cv2.aruco.DICT_4X4_50


@dataclass(frozen=True, slots=True)
class Board:
    """A ChArUco board: a chessboard with a marker in each white square, so that each corner has a name.

    Attributes
    ----------
    columns, rows
        Squares.
    square_mm, marker_mm
        Sides of a square and of a marker.
    margin_mm
        White paper around the squares.
    """

    columns: int = 8
    rows: int = 6
    square_mm: float = 15.0
    marker_mm: float = 11.0
    margin_mm: float = 5.0

    @property
    def size_mm(self) -> tuple[float, float]:
        """Width and height of the squares, without the margin."""
        return self.columns * self.square_mm, self.rows * self.square_mm

    @property
    def corners(self) -> int:
        """How many inner corners it has."""
        return (self.columns - 1) * (self.rows - 1)

    def layout(self) -> "cv2.aruco.CharucoBoard":
        """Return the board as OpenCV has it."""
        return cv2.aruco.CharucoBoard(
            (self.columns, self.rows),
            self.square_mm,
            self.marker_mm,
            cv2.aruco.getPredefinedDictionary(DICTIONARY),
        )

    def points_mm(self) -> NDArray[np.float64]:
        """Return the inner corners in the board's frame, float64 (n, 3), z = 0."""
        return np.asarray(self.layout().getChessboardCorners(), dtype=np.float64).reshape(-1, 3)

    def picture(self, px_mm: int) -> NDArray[np.uint8]:
        """Return the print, with its margin, uint8 (rows, columns), at ``px_mm`` pixels a millimetre."""
        margin = round(self.margin_mm * px_mm)
        size = (
            round(self.columns * self.square_mm * px_mm) + 2 * margin,
            round(self.rows * self.square_mm * px_mm) + 2 * margin,
        )
        return np.asarray(self.layout().generateImage(size, marginSize=margin, borderBits=1), dtype=np.uint8)


@dataclass(frozen=True, slots=True)
class BoardDetection:
    """The board's corners in one image: which ones, int (n,), where, float64 (n, 2) pixels, and the markers' ids."""

    ids: NDArray[np.int64]
    corners_px: NDArray[np.float64]
    marker_ids: NDArray[np.int64]


def detect_board(board: Board, image_bgr: NDArray[np.uint8]) -> BoardDetection:
    """Find the board in an image, uint8 (H, W, 3); no corners where it is not seen.

    OpenCV 4.7 and later return them in shapes of their own.
    """
    grey = cv2.cvtColor(image_bgr, cv2.COLOR_BGR2GRAY)
    detector = cv2.aruco.CharucoDetector(board.layout())
    found: list[Any] = list(detector.detectBoard(grey))  # None for what was not seen
    corners, ids, _, marker_ids = ([] if part is None else part for part in found)
    return BoardDetection(
        np.asarray(ids, dtype=np.int64).ravel(),
        np.asarray(corners, dtype=np.float64).reshape(-1, 2),
        np.asarray(marker_ids, dtype=np.int64).ravel(),
    )
