"""Configurations with the true time of a simulated camera, as a calibration would find it; a camera without frames."""

from collections.abc import Callable

from rig.config import RigConfig, load_config
from rig.views.stream import PATIENCE_S, FrameStream
from sim.frame_times import FrameTimes
from sim.world import World
from tests import small

SMALL = (*small.SMALL, "view.max_smear_px=2")
"""Settings for small frames."""


def camera_time(world: World, *settings: str) -> RigConfig:
    """Return a configuration in which the camera's time is calibrated, with an error of 0.2 ms."""
    times = FrameTimes(world)
    offset_ms = (times.readout_ns / 2 - times.offset_ns) * 1e-6 + 5.0 + 0.2
    known = (f"camera_time.offset_ms={offset_ms}", "camera_time.uncertainty_ms=0.25", "camera_time.jitter_ms=0.3")
    return load_config(None, (*known, *settings))


def no_frame(stream: FrameStream, meanwhile: Callable[[], object], **_: object) -> None:
    """Take the place of `FrameStream.next`: the camera delivers no frame."""
    meanwhile()
    stream._clock.sleep(PATIENCE_S)
