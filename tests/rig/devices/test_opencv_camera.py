"""The OpenCV camera driver: settings, choice of frames by their time, and errors of a camera."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from rig.bench.hardware import camera_settings
from rig.config import CameraConfig
from rig.core.errors import DeviceFault, DeviceNotFound, DeviceSilent
from rig.devices.opencv_camera import OpenCvCamera, TimeBase
from rig.devices.opencv_capture import open_capture
from sim.camera import SimCapture
from sim.frame_times import FPS
from sim.objects.shelf import shelf
from sim.world import World

PERIOD_NS = 1_000_000_000 // FPS


class ForeignStamps(SimCapture):
    """The simulated camera behind a backend whose time stamps are not the bench's clock."""

    def __init__(self, world: World, offset_ms: float, factor: float = 1.0) -> None:
        super().__init__(world)
        self._offset_ms, self._factor = offset_ms, factor

    def get(self, prop: int) -> float:
        value = super().get(prop)
        return value * self._factor + self._offset_ms if prop == cv2.CAP_PROP_POS_MSEC else value


# -- settings ---------------------------------------------------------------------------------------------------------


def test_settings_are_locked_and_read_back(world: World) -> None:
    settings = CameraConfig(exposure_us=8000, gain=3, white_balance_k=4200, focus=100)
    capture = SimCapture(world)
    camera = OpenCvCamera(capture, clock=world.clock, settings=settings, name="desk camera")
    assert camera.rejected_settings == ()
    locks = camera.read_locks()
    assert (locks.exposure_us, locks.gain, locks.white_balance_k) == (8000, 3, 4200)
    assert (locks.auto_exposure, locks.auto_white_balance) == (False, False)
    identity = camera.identity
    assert (identity.name, identity.width, identity.height, identity.fps) == ("desk camera", 640, 480, 30)
    world.clock.sleep(20)
    assert camera.read_locks() == locks
    capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, 3)  # by another program, or a camera that was plugged in again
    assert camera.read_locks().auto_exposure is True


def test_unset_settings_stay_automatic(world: World) -> None:
    settings = CameraConfig(exposure_us=None, gain=None, white_balance_k=None)
    camera = OpenCvCamera(SimCapture(world), clock=world.clock, settings=settings)
    before = camera.read_locks()
    assert (before.auto_exposure, before.exposure_us is None) == (True, False)
    world.put(shelf()["candle"])
    world.clock.sleep(5)
    assert camera.read_locks().exposure_us != before.exposure_us


def test_rejected_setting_is_reported(world: World) -> None:
    settings = CameraConfig(width=1920, exposure_us=90_000, gain=99)
    camera = OpenCvCamera(SimCapture(world), clock=world.clock, settings=settings)
    assert {(n.setting, n.asked, n.reported) for n in camera.rejected_settings} == {
        ("width", "1920", "640"),
        ("exposure_100us", "900", "333"),
        ("gain", "99", "24"),
    }
    assert camera.identity.width == 640
    assert camera.read_locks().gain == 24


# -- which frame ------------------------------------------------------------------------------------------------------


def test_first_frame_after_the_requested_time_is_returned(world: World) -> None:
    camera = OpenCvCamera(SimCapture(world), clock=world.clock)
    assert camera.time_base is TimeBase.STAMPED
    for pause_s, ahead_ns in ((0.0, 0), (0.01, 0), (0.1, 0), (3.0, 0), (0.0, 700_000_000)):
        world.clock.sleep(pause_s)
        after_ns = world.clock.now_ns() + ahead_ns
        frame = camera.capture(after_ns)
        assert after_ns <= frame.exposed_ns < after_ns + PERIOD_NS + 2000  # the first one, not just any new one


@pytest.mark.parametrize(
    ("offset_ms", "factor"),
    [(1.7e12, 1.0), (-100_000.0, 1.0), (0.0, 0.0), (0.0, 1000.0)],
    ids=["time of day", "since the stream began", "no stamps", "microseconds"],
)
def test_paced_source_uses_only_frames_after_a_wait(world: World, offset_ms: float, factor: float) -> None:
    capture = ForeignStamps(world, offset_ms, factor)
    camera = OpenCvCamera(capture, clock=world.clock)
    assert camera.time_base is TimeBase.PACED
    for pause_s in (0.0, 0.05, 5.0):
        world.clock.sleep(pause_s)
        after_ns = world.clock.now_ns()
        frame = camera.capture(after_ns)
        truly_ns = round((capture.get(cv2.CAP_PROP_POS_MSEC) - offset_ms) / factor * 1e6) if factor else None
        assert after_ns <= frame.exposed_ns <= (truly_ns or world.clock.now_ns())
        assert frame.exposed_ns < after_ns + 6 * PERIOD_NS


# -- failures ---------------------------------------------------------------------------------------------------------


def test_unplugged_camera_raises_device_silent(world: World) -> None:
    capture = SimCapture(world)
    camera = OpenCvCamera(capture, clock=world.clock, name="desk camera")
    capture.unplug()
    with pytest.raises(DeviceSilent, match="desk camera") as error:
        camera.capture(world.clock.now_ns())
    assert "cable" in error.value.next_step
    with pytest.raises(DeviceSilent):
        OpenCvCamera(capture, clock=world.clock)


class Lagging(SimCapture):
    """A camera that can lag: its frames continue, but each is hardly newer than the previous one."""

    stuck_at_ms: float | None = None

    def get(self, prop: int) -> float:
        if prop == cv2.CAP_PROP_POS_MSEC and self.stuck_at_ms is not None:
            self.stuck_at_ms += 0.001
            return self.stuck_at_ms
        return super().get(prop)


def test_camera_with_only_old_frames_times_out(world: World) -> None:
    capture = Lagging(world)
    camera = OpenCvCamera(capture, clock=world.clock)
    capture.stuck_at_ms = capture.get(cv2.CAP_PROP_POS_MSEC)
    asked_ns = world.clock.now_ns()
    with pytest.raises(DeviceSilent, match="no new frame in 3 s") as error:
        camera.capture(asked_ns)
    assert error.value.evidence["dropped_frames"] == pytest.approx(3 * FPS, abs=3)
    assert world.clock.now_ns() - asked_ns == pytest.approx(3e9, abs=2 * PERIOD_NS)


def test_decreasing_stamps_are_not_trusted(world: World) -> None:
    capture = ForeignStamps(world, 0.0)
    camera = OpenCvCamera(capture, clock=world.clock)
    assert camera.time_base is TimeBase.STAMPED
    capture._offset_ms = -60_000.0
    after_ns = world.clock.now_ns()
    assert camera.capture(after_ns).exposed_ns >= after_ns
    assert camera.time_base is TimeBase.PACED


@pytest.mark.parametrize(
    ("answer", "error", "words"),
    [((True, np.zeros((480, 640), np.uint8)), DeviceFault, r"\(480, 640\)"), ((False, None), DeviceSilent, "decoding")],
    ids=["no colour", "undecodable"],
)
def test_image_without_colour_or_content_is_rejected(
    world: World, answer: tuple[bool, np.ndarray | None], error: type[Exception], words: str
) -> None:
    class Broken(SimCapture):
        def retrieve(self) -> tuple[bool, np.ndarray | None]:
            return answer

    with pytest.raises(error, match=words):
        OpenCvCamera(Broken(world), clock=world.clock).capture(0)


def test_opening_errors_name_the_cause(tmp_path: Path) -> None:
    with pytest.raises(DeviceNotFound, match="camera /dev/video97 does not exist") as error:
        open_capture(97)
    assert "Connect" in error.value.next_step
    with pytest.raises(DeviceNotFound, match="missing"):
        open_capture(tmp_path / "missing.avi")
    with pytest.raises(DeviceNotFound, match="Cannot open /dev/null"):
        open_capture("/dev/null")


def test_recording_is_played_from_its_file(world: World, tmp_path: Path) -> None:
    writer = cv2.VideoWriter(str(tmp_path / "video.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 30.0, (64, 48))
    for level in range(40, 240, 5):
        writer.write(np.full((48, 64, 3), level, np.uint8))
    writer.release()
    settings = CameraConfig(exposure_us=None, gain=None, white_balance_k=None)
    camera = OpenCvCamera(open_capture(tmp_path / "video.avi"), clock=world.clock, settings=settings)
    assert (camera.time_base, camera.modes, camera.controls) == (TimeBase.RECORDED, (), ())
    levels = [camera.capture(world.clock.now_ns(), lambda: None).image_bgr.mean() for _ in range(3)]
    assert levels == pytest.approx([levels[0], levels[0] + 5, levels[0] + 10], abs=1)


# -- focus and other controls --------------------------------------------------------------------------------------


def test_drift_of_a_control_from_zero_is_noticed(world: World) -> None:
    """On V4L2, 0 is a value, and -1 says that the camera lacks the control."""
    capture = SimCapture(world)
    capture.remembers = False
    camera = OpenCvCamera(capture, clock=world.clock, settings=CameraConfig(gain=None))
    before = camera.read_locks()
    assert (before.gain, before.backlight_compensation) == (0, 0)
    capture.drift(gain_db=6)
    assert camera.read_locks() == replace(before, gain=6)
    capture.drift(gain_db=0, sharpness=80, power_line_frequency=1, dynamic_frame_rate=True)
    assert camera.read_locks() == replace(before, sharpness=80, power_line_frequency=1, dynamic_frame_rate=True)


def test_gain_that_the_driver_remembers_is_read_back_as_it_was_set(world: World) -> None:
    """As `uvcvideo` does, unless the camera says that its gain changes by itself. A replugged camera is asked again."""
    capture = SimCapture(world)
    camera = OpenCvCamera(capture, clock=world.clock)
    before = camera.read_locks()
    dark = camera.capture(world.clock.now_ns()).image_bgr.mean()
    capture.drift(gain_db=12)
    assert camera.read_locks() == before
    assert camera.capture(world.clock.now_ns()).image_bgr.mean() > 2 * dark
    capture.unplug()
    capture.replug()
    capture.drift(gain_db=12)
    capture.reopen()
    assert camera.read_locks().gain == 12


def test_all_controls_that_the_camera_has_are_locked(world: World) -> None:
    settings = CameraConfig(sharpness=10, backlight_compensation=1, power_line_frequency=1)
    locks = OpenCvCamera(SimCapture(world), clock=world.clock, settings=settings).read_locks()
    assert (locks.gain, locks.sharpness, locks.backlight_compensation) == (0, 10, 1)
    assert (locks.power_line_frequency, locks.dynamic_frame_rate) == (1, False)


def test_pixel_format_is_chosen_or_configured(world: World) -> None:
    for settings, fourcc in ((CameraConfig(), "YUYV"), (CameraConfig(fourcc="MJPG"), "MJPG")):
        capture = SimCapture(world)
        camera = OpenCvCamera(capture, clock=world.clock, settings=settings)
        assert capture.get(cv2.CAP_PROP_FOURCC) == cv2.VideoWriter.fourcc(*fourcc)
        assert camera.rejected_settings == ()
    camera = OpenCvCamera(SimCapture(world), clock=world.clock, settings=CameraConfig(fourcc="H264"))
    (rejected,) = camera.rejected_settings
    assert (rejected.setting, rejected.asked, rejected.reported) == ("fourcc", "H264", "MJPG")


def test_autofocus_is_pinned_where_it_settles(world: World) -> None:
    """A camera starts with its autofocus on. If it is switched off at once, the lens stays at any position."""
    capture = SimCapture(world)
    capture.drift(autofocus=True, focus=0)
    camera = OpenCvCamera(capture, clock=world.clock)
    assert (camera.read_locks().focus, camera.read_locks().autofocus) == (120, False)
    assert camera.rejected_settings == ()
    capture.drift(autofocus=True)  # by another program
    assert camera.read_locks().autofocus is True


def test_focus_is_stored_for_the_next_program(simulated, world: World) -> None:
    """A camera without power forgets its focus, and its autofocus may find another one on the next object."""
    s = simulated("camera.focus=none")
    state, config, device = s.bench.state, s.bench.config, s.bench.camera.identity.device
    assert camera_settings(config, state, device).focus == 120
    assert camera_settings(config, state, "another camera").focus is None
    state.store_file("camera-focus.json", b"damaged")
    assert camera_settings(config, state, device).focus is None
    capture = SimCapture(world)
    capture.drift(autofocus=True, focus=0)
    camera = OpenCvCamera(capture, clock=world.clock, settings=CameraConfig(focus=33))
    assert (camera.read_locks().focus, camera.read_locks().autofocus) == (33, False)
