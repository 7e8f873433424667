"""The calibration of the camera's time."""

from calibration.camera_time import CameraTime
from rig.calibrations import RejectionCode
from rig.config import load_config
from rig.views.stream import FrameStream
from sim.bench import ShelfOperator, open_sim_bench
from sim.objects.shelf import shelf
from sim.world import World
from tests.calibration.drawn import codes
from tests.rig.motion.times import SMALL, no_frame


def test_camera_that_delivers_no_frame_in_motion_is_rejected(monkeypatch):
    monkeypatch.setattr(FrameStream, "next", no_frame)
    with open_sim_bench(load_config(None, SMALL), ShelfOperator(World(seed=4), shelf())) as bench:
        *_, found = CameraTime().live(bench)
    assert codes(found) == [RejectionCode.TOO_FEW_FRAMES]
    assert not found.settings
