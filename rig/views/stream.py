"""Frames of a running camera: each with the time at the middle of its exposure, and whether that time can be trusted.

A frame's angle is the platter's at the middle of the exposure of the middle row. `rig calibrate camera-time` measures
the time from the frame's time stamp to that moment.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from math import hypot
from typing import Final

import numpy as np

from rig.config import CameraTimeConfig, RigConfig
from rig.core.clock import Clock
from rig.devices.camera import Camera, Frame

LATEST_S: Final = 1.0
"""Largest time from the stamp to the arrival of a frame whose time can be trusted."""
PATIENCE_S: Final = 0.1
"""Longest wait of the control loop of a moving table for a frame, because it must also feed the servo's watchdog."""
SURE_SIGMAS: Final = 2.0
"""Smallest difference of the camera's time from that of its stamps that counts, in standard uncertainties."""


class _NoFrameYet(Exception):
    """An exception that ends the wait for a frame."""


class FrameStream:
    """Delivers the frames of a camera one after the other."""

    def __init__(self, camera: Camera, clock: Clock) -> None:
        self._camera = camera
        self._clock = clock
        self._last: Frame | None = None
        self._delay_ns = 0
        self._after_ns = clock.now_ns()
        self.skipped = 0
        """Frames that were not used because the program was too slow."""

    @property
    def period_s(self) -> float:
        """Time between two frames by the camera's mode."""
        fps = self._camera.identity.fps
        return 1 / fps if 1 <= fps <= 1000 else 1 / 30

    def next(self, meanwhile: Callable[[], object], *, newest: bool = False) -> Frame | None:
        """Return the next frame; None if the camera has delivered none after `PATIENCE_S`, so that the caller can work.

        ``meanwhile`` is called while the method waits for a slow camera. With ``newest``, frames that have waited for
        two periods are dropped.

        Raises `DeviceSilent`: the camera has failed.
        """
        after_ns = self._after_ns
        # A program that is too slow for each frame would otherwise steer the table by ever older ones.
        if newest and self._last is not None:
            oldest_ns = self._clock.now_ns() - min(self._delay_ns, round(LATEST_S * 1e9)) - round(2e9 * self.period_s)
            if oldest_ns > after_ns:
                self.skipped += max(int((oldest_ns - after_ns) * 1e-9 / self.period_s), 0)
                after_ns = oldest_ns
        until_ns = self._clock.now_ns() + round(PATIENCE_S * 1e9)

        def waited() -> None:
            meanwhile()
            if self._clock.now_ns() >= until_ns:
                raise _NoFrameYet

        try:
            frame = self._camera.capture(after_ns, waited)
        except _NoFrameYet:
            return None
        if self._last is not None and np.array_equal(frame.image_bgr, self._last.image_bgr):
            frame = replace(frame, repeated=True)
        self._last, self._after_ns = frame, frame.exposed_ns + 1
        self._delay_ns = self._clock.now_ns() - frame.exposed_ns
        return frame


def middle_ns(stamp_ns: int, config: CameraTimeConfig) -> int:
    """Return the middle of the exposure of a frame with this time stamp; the camera's time must be calibrated."""
    assert config.offset_ms is not None
    return stamp_ns + round(config.offset_ms * 1e6)


def after_middle_row_ns(config: RigConfig, box_px: Sequence[int]) -> int:
    """Return how long after the frame's middle row the middle row of a box is exposed (x, y, width, height)."""
    top_px = 0 if config.view.roi is None else config.view.roi[1]
    share = (top_px + box_px[1] + box_px[3] / 2) / config.camera.height - 0.5
    return round(share * config.camera_time.readout_ms * 1e6)


def exposed_before_stamp_ns(config: RigConfig) -> int:
    """Return how long before its time stamp the exposure of a frame may begin: 0 if the camera's time is not known.

    It begins in the first row, half the readout and half the exposure time before the middle of the middle row.
    """
    time, exposure_us = config.camera_time, config.camera.exposure_us
    if time.offset_ms is None or exposure_us is None:
        return 0
    begins_ms = time.offset_ms - (exposure_us * 1e-3 + time.readout_ms) / 2
    unsure_ms = SURE_SIGMAS * hypot(time.uncertainty_ms, time.jitter_ms)
    return round(max(-begins_ms - unsure_ms, 0.0) * 1e6)
