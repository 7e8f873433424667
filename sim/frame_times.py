"""Times of exposure and arrival of the frames of a simulated camera, and of the rows of a frame; and lost frames.

Each number is drawn from the frame's number and the world's seed alone, so that it does not depend on what a program
has read before.
"""

from math import log
from statistics import NormalDist
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from sim.world import World

_NORMAL = NormalDist()
FPS = 30  # what UVC cameras offer at 640 x 480


class FrameTimes:
    """The errors of a camera's time: offset and jitter of its stamps, its read-out, late and lost frames."""

    def __init__(self, world: World) -> None:
        noise = world.noise
        self._seed = world.seed
        self._jitter_ns = noise.stamp_jitter_ms * 1e6
        self._latency_ns = noise.usb_latency_ms * 1e6
        self.offset_ns = round(abs(world.rng("camera stamps").standard_normal()) * noise.stamp_offset_ms * 1e6)
        """Mean time from the beginning of the exposure of the first row to the frame's time stamp."""
        self.readout_ns = round(noise.camera_readout_ms * 1e6)
        """Time from the exposure of the first row to that of the last one."""
        self.stamped_late_ns = 0.0
        """Standard deviation of the delay with which the computer stamps frames during a fault."""
        self.lost_share = noise.lost_frames
        """Share of the frames that do not arrive; a fault raises it."""

    def exposed_ns(self, stamp_ns: int, frame: int) -> int:
        """Return the true beginning of the exposure of a frame's first row."""
        if not self._jitter_ns:
            return stamp_ns - self.offset_ns
        return stamp_ns - self.offset_ns + round(self._jitter_ns * _NORMAL.inv_cdf(self._uniform(b"jitter", frame)))

    def stamp_error_ns(self, frame: int) -> int:
        """Return the delay with which the busy computer stamps a frame."""
        if not self.stamped_late_ns:
            return 0
        return round(self.stamped_late_ns * abs(_NORMAL.inv_cdf(self._uniform(b"busy", frame))))

    def late_ns(self, frame: int) -> int:
        """Return the delay of a frame on the USB."""
        return round(-self._latency_ns * log(self._uniform(b"late", frame))) if self._latency_ns else 0

    def is_lost(self, frame: int) -> bool:
        """Return whether a frame never arrives."""
        return self.lost_share > 0 and self._uniform(b"lost", frame) < self.lost_share

    def _uniform(self, what: bytes, frame: int) -> float:
        """Return a number in (0, 1) that looks random."""
        return (crc32(b"%s %d %d" % (what, self._seed, frame)) + 0.5) / 2**32


def start_ns(frame: int) -> int:
    """Return the nominal beginning of a frame's exposure; V4L2 stamps whole microseconds."""
    return frame * 1_000_000 // FPS * 1000


def frame_after(time_ns: int) -> int:
    """Return the first frame that begins at or after a time."""
    frame = max(time_ns, 0) * FPS // 1_000_000_000
    return frame if start_ns(frame) >= time_ns else frame + 1


def row_weights(exposure: int, readout: int, steps: int, rows: int) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Return times at which a frame is drawn, (n,), and the share of each image in each row, (n, rows).

    A row is the mean of images that are interpolated linearly between those of the times. So its mean time is exactly
    the middle of its exposure. Times in ns from the beginning of the first row; at least two.
    """
    times = np.linspace(0, exposure + readout, steps)
    begins = (np.arange(rows) + 0.5) / rows * readout
    weights = _below(begins + exposure, times) - _below(begins, times)
    return times, (weights / weights.sum(axis=0)).astype(np.float32)


def _below(until: NDArray[np.float64], times: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the integrals up to ``until`` (m,) of functions that are 1 at one of ``times`` and 0 at its neighbours."""
    away = np.clip((until - times[:, None]) / (times[1] - times[0]), -1, 1)
    below: NDArray[np.float64] = np.where(away < 0, np.square(1 + away) / 2, 1 - np.square(1 - away) / 2)
    return below


def bands(hz: float, depth: float, start: int, exposure: int, readout: int, rows: int) -> NDArray[np.float32]:
    """Return the light that each row receives from a flickering lamp during its exposure, (rows, 1, 1)."""
    begins_s = start * 1e-9 + np.arange(rows) / rows * readout * 1e-9
    middle_s = begins_s + exposure * 0.5e-9
    light = 1 + depth * np.sinc(hz * exposure * 1e-9) * np.cos(2 * np.pi * hz * middle_s)
    return light.astype(np.float32)[:, None, None]
