"""Views of a simulated board, without a bench around it."""

from collections.abc import Callable
from functools import cache

import cv2
import numpy as np

from calibration.board_views import MIN_CORNERS, BoardView
from rig.views.charuco_board import CharucoBoard, detect_board
from sim.calibration_board import BoardOnPlatter, boards
from sim.objects.solid import empty_platter
from sim.optics import Optics

Picture = np.ndarray


@cache
def noise() -> Picture:
    """Return the noise of every frame: to compute it for each one takes longer than to draw the board."""
    return 2 * np.random.default_rng(1).standard_normal(empty_platter().shape, dtype=np.float32)


@cache
def seen(
    optics: Optics,
    stands: tuple[str, ...],
    angles_deg: tuple[float, ...],
    *,
    board: CharucoBoard | None = None,
    change: Callable[[BoardOnPlatter], BoardOnPlatter] = lambda board: board,
    spoil: Callable[[Picture], Picture] = lambda picture: picture,
    ratio: float = 1.0,
) -> list[BoardView]:
    """Return the camera's views of the board; the encoder reads ``ratio`` times the table's angle."""
    rng = np.random.default_rng(0)
    views = []
    for number, stand in enumerate(stands):
        thing = change(boards(optics)[stand])
        for angle_deg in angles_deg:
            picture = empty_platter()
            thing.draw(picture, angle_deg)
            noisy = np.clip(spoil(picture) + noise(), 0, 255).astype(np.uint8)
            found = detect_board(board or thing.board, noisy)
            if found.ids.size >= MIN_CORNERS:
                encoder_deg = ratio * angle_deg + float(rng.normal(0, 0.03))
                views.append(BoardView(number, encoder_deg, found.ids, found.corners_px))
    return views


@cache
def optics(seed: int, wobble_deg: float = 0.0) -> Optics:
    return Optics.drawn(np.random.default_rng(seed), wobble_deg=wobble_deg)


def blurred(picture: Picture) -> Picture:
    return cv2.GaussianBlur(picture, (0, 0), 6.0)
