"""Times of exposure and arrival of the frames of a simulated camera, and lost frames.

Each number is drawn from the frame's number and the world's seed alone, so that it does not depend on what a program
has read before.
"""

from math import log
from statistics import NormalDist
from zlib import crc32

from sim.world import World

_NORMAL = NormalDist()
FPS = 30  # what UVC cameras offer at 640 x 480


class FrameTimes:
    """The errors of a camera's time: offset and jitter of its stamps, its read-out, late and lost frames.

    Attributes
    ----------
    offset_ns
        Mean time from the beginning of the exposure of the first row to the frame's time stamp.
    readout_ns
        Time from the exposure of the first row to that of the last one.
    stamped_late_ns
        Standard deviation of the delay with which the computer stamps frames during a fault.
    lost_share
        Share of the frames that do not arrive; a fault raises it.
    """

    def __init__(self, world: World) -> None:
        noise = world.noise
        self._seed = world.seed
        self._jitter_ns = noise.stamp_jitter_ms * 1e6
        self._latency_ns = noise.usb_latency_ms * 1e6
        self.offset_ns = round(abs(world.rng("camera stamps").standard_normal()) * noise.stamp_offset_ms * 1e6)
        self.readout_ns = round(noise.camera_readout_ms * 1e6)
        self.stamped_late_ns = 0.0
        self.lost_share = noise.lost_frames

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
