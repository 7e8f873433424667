"""Pictures for the pages: the newest frame, and the outline of a silhouette."""

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from rig.core.clock import Clock, seconds_between

JPEG_QUALITY: Final = 80  # for the eye only; no descriptor sees it
MAX_SIDE_PX: Final = 1280  # the width of a page; more loads a slow network
TOLERANCE_PX: Final = 1.0
"""Points that change an outline by less are left out."""


class LivePicture:
    """The newest frame. Viewers never wait for the camera, and the camera never waits for viewers."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._frame: tuple[int, NDArray[np.uint8], int] | None = None
        """Number, image and time of the newest frame: replaced as one, because two threads use it."""
        self._wanted_until_ns = 0

    @property
    def number(self) -> int:
        """Number of the newest frame, from 1; 0 if there is none."""
        return 0 if self._frame is None else self._frame[0]

    # The image becomes a JPEG only when a viewer asks: encoding each frame would take the control loop's time.
    def show(self, image_bgr: NDArray[np.uint8]) -> None:
        """Replace the picture, from the bench's thread; the array must not be changed afterwards."""
        self._frame = (self.number + 1, image_bgr, self._clock.now_ns())

    def want(self) -> None:
        """Ask for pictures from an idle camera for the next five seconds."""
        self._wanted_until_ns = self._clock.now_ns() + 5_000_000_000

    @property
    def wanted(self) -> bool:
        return self._clock.now_ns() < self._wanted_until_ns

    @property
    def age_s(self) -> float | None:
        """Age of the newest frame in seconds; None if there is none."""
        return None if self._frame is None else seconds_between(self._frame[2], self._clock.now_ns())

    def jpeg(self) -> tuple[int, bytes] | None:
        """Return the number of the newest frame and the frame as JPEG; None if there is none yet."""
        frame = self._frame
        return None if frame is None else (frame[0], jpeg(frame[1]))


def jpeg(image_bgr: NDArray[np.uint8], max_side_px: int = MAX_SIDE_PX) -> bytes:
    """Return an image as JPEG, reduced to at most ``max_side_px``."""
    scale = max_side_px / max(image_bgr.shape[:2])
    if scale < 1:
        image_bgr = cv2.resize(image_bgr, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA).astype(np.uint8)
    encoded, content = cv2.imencode(".jpg", image_bgr, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not encoded:
        raise ValueError("the image cannot be encoded")
    return content.tobytes()


def outlines_of(mask: NDArray[np.bool_]) -> list[list[list[int]]]:
    """Return the outlines of the parts of a silhouette, bool (h, w), as points in pixels; the largest part first."""
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    parts = sorted(contours, key=cv2.contourArea, reverse=True)
    shortened = (cv2.approxPolyDP(part, TOLERANCE_PX, closed=True).reshape(-1, 2) for part in parts)
    return [[[int(px), int(py)] for px, py in part] for part in shortened]
