"""A ChArUco board on the platter, drawn through the lens of `sim.optics`."""

from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from math import cos, radians, sin

import cv2
import numpy as np
from numpy.typing import NDArray

from rig.views.charuco_board import CharucoBoard
from sim.objects.projection import HEIGHT, WIDTH, Floats, Image
from sim.optics import SUPERSAMPLING, Optics
from sim.table import TABLE

_BLACK, _WHITE = 25, 215  # levels of the print
_LEVELS = np.clip(np.arange(256, dtype=np.float32) * (_WHITE - _BLACK) / 255 + _BLACK, 0, 255).astype(np.uint8)
_COVERAGE = np.minimum(np.rint(np.arange(256) * (255 / _WHITE)), 255).astype(np.uint8)
_NEIGHBOURS = np.ones((3, 3), np.uint8)
TEXTURE_PX_MM = 10  # five texels for a pixel of the frame; fewer: corners are rounded; more: a board takes more memory


@dataclass(frozen=True)
class BoardOnPlatter:
    """The printed board on its stand."""

    board: CharucoBoard = field(default_factory=CharucoBoard)
    """The printed layout."""
    optics: Optics = field(default_factory=Optics)
    """The camera that sees it."""
    tilt_deg: float = 15.0
    """Lean of its top away from the camera when the table is at home."""
    swing_deg: float = 0.0
    roll_deg: float = 0.0
    """Rotation about the vertical and in its own plane."""
    centre_mm: tuple[float, float, float] = (0.0, 0.0, 75.0)
    """Its centre in the platter's frame: x to the right, y away from the camera, z up."""
    loose_deg: float = 0.0
    """Largest rotation about the vertical after the table has moved, for a loose stand."""
    name: str = "calibration-board"

    def put(self, *, tilt_deg: float, swing_deg: float = 0.0, roll_deg: float = 0.0) -> "BoardOnPlatter":
        """Return the board in another position on its stand."""
        return replace(self, tilt_deg=tilt_deg, swing_deg=swing_deg, roll_deg=roll_deg)

    def pose(self, table_deg: float) -> tuple[Floats, Floats]:
        """Return rotation (3, 3) and translation (3,), mm, from the board's frame into the camera's.

        The board's frame is OpenCV's: x to its right, y down, from its first corner.
        """
        loose = self.loose_deg * sin(table_deg * 7.3) if self.loose_deg else 0.0
        rotate = radians(self.swing_deg + loose)
        about = np.array([[cos(rotate), -sin(rotate), 0.0], [sin(rotate), cos(rotate), 0.0], [0.0, 0.0, 1.0]])
        lean = radians(self.tilt_deg)
        upright = np.array([[1.0, 0.0, 0.0], [0.0, -sin(lean), cos(lean)], [0.0, -cos(lean), -sin(lean)]])
        c, s = cos(radians(self.roll_deg)), sin(radians(self.roll_deg))
        rolled = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        on_platter = about @ upright @ rolled
        width, height = self.board.size_mm
        corner = np.array(self.centre_mm) - on_platter @ np.array([width / 2, height / 2, 0.0])
        rotation, translation = self.optics.to_camera(table_deg)
        return rotation @ on_platter, rotation @ corner + translation

    def draw(
        self,
        image: Image,
        azimuth_deg: float,
        offset_mm: tuple[float, float] = (0.0, 0.0),  # noqa: ARG002
        rows: tuple[int, int] = (0, HEIGHT),
    ) -> None:
        """Draw the board into ``image``, at least between two ``rows``.

        `centre_mm` is its position, not ``offset_mm``.
        """
        rotation, translation = self.pose(azimuth_deg)
        normal = rotation[:, 2]
        if float(normal @ translation) <= 0:  # the camera sees its back
            return
        x, y = self._box(rotation, translation)
        y = slice(max(y.start, rows[0]), min(y.stop, rows[1]))
        if x.start >= x.stop or y.start >= y.stop:  # out of the frame
            return
        # A ray meets the board's plane where the homography [r1 r2 t]⁻¹ takes it; from there to texels.
        to_board = np.linalg.inv(np.column_stack([rotation[:, 0], rotation[:, 1], translation]))
        margin = TEXTURE_PX_MM * self.board.margin_mm - 0.5
        to_texels = np.array([[TEXTURE_PX_MM, 0, margin], [0, TEXTURE_PX_MM, margin], [0, 0, 1]]) @ to_board
        fine_y, fine_x = (slice(each.start * SUPERSAMPLING, each.stop * SUPERSAMPLING) for each in (y, x))
        places = cv2.perspectiveTransform(self.optics.rays()[fine_y, fine_x], to_texels)
        drawn = cv2.remap(self._texture, places, None, cv2.INTER_LINEAR)  # type: ignore[call-overload]
        # The ground is 0 and the print is not, and the board's edge is white: there the level shows the coverage.
        inside = cv2.erode(cv2.threshold(drawn, 0, 255, cv2.THRESH_BINARY)[1], _NEIGHBOURS)
        covers = cv2.max(cv2.LUT(drawn, _COVERAGE), inside)
        size = (x.stop - x.start, y.stop - y.start)
        grey, cover = (cv2.resize(each, size, interpolation=cv2.INTER_AREA) for each in (drawn, covers))
        seen = image[y, x]
        cv2.copyTo(cv2.merge([grey] * 3), cv2.threshold(cover, 254, 255, cv2.THRESH_BINARY)[1], seen)
        edge = (cover > 0) & (cover < 255)
        behind = seen[edge] * (1 - cover[edge, None] / np.float32(255))
        seen[edge] = np.clip(grey[edge, None] + behind, 0, 255)

    def _box(self, rotation: Floats, translation: Floats) -> tuple[slice, slice]:
        """Return the columns and rows of the image that show the board."""
        (width, height), margin = self.board.size_mm, self.board.margin_mm
        side, zero = np.linspace(0.0, 1.0, 9), np.zeros(9)
        outline = np.column_stack([np.r_[side, side, zero, zero + 1], np.r_[zero, zero + 1, side, side], np.zeros(36)])
        outline = outline * (width + 2 * margin, height + 2 * margin, 0) - (margin, margin, 0)
        if (rotation[2] @ outline.T + translation[2]).min() <= 0:  # partly behind the camera
            return slice(0, WIDTH), slice(0, HEIGHT)
        rotate = cv2.Rodrigues(rotation)[0]
        at = cv2.projectPoints(outline, rotate, translation, self.optics.matrix, np.array(self.optics.distortion))[0]
        low, high = at.min(axis=(0, 1)) - 2, at.max(axis=(0, 1)) + 3
        (left, right), (top, bottom) = (
            np.clip([low[axis], high[axis]], 0, size).astype(int).tolist() for axis, size in enumerate((WIDTH, HEIGHT))
        )
        return slice(left, right), slice(top, bottom)

    @cached_property
    def _texture(self) -> NDArray[np.uint8]:
        """The print, uint8 (rows, columns)."""
        return _texture(self.board)


@lru_cache(maxsize=4)
def _texture(board: CharucoBoard) -> NDArray[np.uint8]:
    return np.asarray(cv2.LUT(board.picture(TEXTURE_PX_MM), _LEVELS))


HOME_MARK = "home-mark"


def home_mark(optics: Optics) -> BoardOnPlatter:
    """Return the card of the home mark: it stands at the edge of the platter, and faces the camera at home."""
    card = TABLE["home_card"]
    layout = CharucoBoard(card["columns"], card["rows"])
    return BoardOnPlatter(layout, optics, tilt_deg=card["tilt_deg"], centre_mm=tuple(card["centre"]), name=HOME_MARK)


def boards(optics: Optics) -> dict[str, BoardOnPlatter]:
    """Return the board in each position that calibrations need, by name."""
    layout = CharucoBoard()
    return {
        "calibration-board upright": BoardOnPlatter(layout, optics, tilt_deg=4.0),
        "calibration-board back": BoardOnPlatter(layout, optics, tilt_deg=31.0, centre_mm=(0.0, 10.0, 70.0)),
        "calibration-board left": BoardOnPlatter(
            layout, optics, tilt_deg=8.0, roll_deg=12.0, centre_mm=(-70.0, 0.0, 110.0)
        ),
        "calibration-board right": BoardOnPlatter(
            layout, optics, tilt_deg=18.0, roll_deg=-15.0, centre_mm=(70.0, -10.0, 60.0)
        ),
    }
