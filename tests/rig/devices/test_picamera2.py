"""A camera on the ribbon cable of a Raspberry Pi: the same locks, true time stamps, and errors for missing parts."""

import sys
from types import ModuleType

import cv2
import numpy as np
import pytest

from rig.bench.computer import Computer
from rig.config import CameraConfig
from rig.core.errors import DeviceNotFound, DeviceSilent
from rig.devices import v4l2
from rig.devices.opencv_camera import OpenCvCamera, TimeBase
from rig.devices.opencv_capture import open_capture
from rig.devices.picamera2_capture import Picamera2Capture
from rig.doctor.device_scan import DeviceScan
from sim.camera import SimCapture
from sim.objects.shelf import shelf
from sim.world import World
from tests import fake_picamera2 as picamera2
from tests.rig.doctor.doctor_parts import unopened


@pytest.fixture
def world():
    world = World(seed=1)
    world.put(shelf()["toy-house"])
    return world


@pytest.fixture
def sensor(world, monkeypatch):
    sensor = SimCapture(world)
    monkeypatch.setitem(sys.modules, "picamera2", picamera2.module(sensor, world.clock))
    return sensor


def test_settings_are_locked_and_read_back_from_the_frames(world, sensor):
    camera = OpenCvCamera(open_capture("picamera2"), clock=world.clock)
    locks = camera.read_locks()
    assert camera.rejected_settings == ()
    assert (locks.exposure_us, locks.gain, locks.white_balance_k) == (10_000, 0, 5000)
    assert (locks.auto_exposure, locks.auto_white_balance, locks.dynamic_frame_rate) == (False, False, False)
    assert (locks.focus, locks.autofocus) == (pytest.approx(120 / 17, abs=0.01), False)  # where the autofocus settled
    assert camera.time_base is TimeBase.STAMPED
    sensor.drift(gain_db=3.0, kelvin=4000)  # a fault of the sensor shows in the metadata of the next frame
    camera.capture(world.clock.now_ns())
    assert (camera.read_locks().gain, camera.read_locks().white_balance_k) == (3.0, 4000)


def test_configured_settings_are_in_force_before_they_are_read(world, sensor):
    """libcamera applies a setting some frames after it was requested."""
    settings = CameraConfig(width=320, height=240, exposure_us=5000, gain=6, white_balance_k=3000, focus=2, sharpness=4)
    camera = OpenCvCamera(open_capture("picamera2:0"), clock=world.clock, settings=settings)
    locks = camera.read_locks()
    assert camera.rejected_settings == ()
    assert (locks.exposure_us, locks.gain, locks.white_balance_k, locks.focus, locks.sharpness) == (
        5000,
        6,
        3000,
        2,
        4,
    )
    assert camera.capture(world.clock.now_ns()).image_bgr.shape == (240, 320, 3)


def test_value_beyond_the_range_is_reported(world, sensor):
    camera = OpenCvCamera(open_capture("picamera2"), clock=world.clock, settings=CameraConfig(exposure_us=90_000))
    (rejected,) = camera.rejected_settings
    assert (rejected.setting, rejected.asked, rejected.reported) == ("exposure_100us", "900", "330")


def test_time_stamp_is_the_start_of_the_exposure(world, sensor):
    capture = open_capture("picamera2")
    capture.grab()
    assert capture.get(cv2.CAP_PROP_POS_MSEC) == pytest.approx(sensor.get(cv2.CAP_PROP_POS_MSEC), abs=0.01)


def test_frames_are_copies_in_the_order_of_opencv_and_buffers_are_given_back(world, sensor):
    capture = open_capture("picamera2")
    for _ in range(12):
        assert capture.grab()
        image = capture.retrieve()[1]
    np.testing.assert_array_equal(image, sensor.retrieve()[1])
    assert capture._camera.held == 1
    capture.release()
    capture.release()
    assert not capture.isOpened()
    assert not capture.grab()
    open_capture("picamera2").release()  # it can be opened again


@pytest.mark.parametrize(
    ("model", "rates"), [("imx219", (41.85, 41.85, 21.19, 21.19)), ("imx708", (56.03, 56.03, 56.03, 14.35))]
)
def test_frame_has_the_whole_field_of_the_sensor_at_any_size(model, rates, world, monkeypatch):
    sensor = SimCapture(world)
    monkeypatch.setitem(sys.modules, "picamera2", picamera2.module(sensor, world.clock, model))
    capture = open_capture("picamera2")
    for size, fps in zip(((320, 240), (640, 480), (1920, 1080), (4608, 2592)), rates, strict=True):
        for prop, value in zip((cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT), size, strict=True):
            capture.set(prop, value)
        capture.set(cv2.CAP_PROP_FPS, 90)
        assert capture.get(cv2.CAP_PROP_FPS) == fps
        assert capture.grab()
        assert capture._camera.field == 1.0
        np.testing.assert_array_equal(capture.retrieve()[1], sensor.retrieve()[1])


def test_hanging_sensor_is_silent_in_bounded_time(world, sensor):
    camera = OpenCvCamera(open_capture("picamera2"), clock=world.clock)
    sensor.hangs = True
    begun_ns = world.clock.now_ns()
    with pytest.raises(DeviceSilent, match="delivers no frames"):
        camera.capture(begun_ns)
    assert world.clock.now_ns() - begun_ns < 8e9
    for _ in range(5):
        with pytest.raises(DeviceSilent):
            camera.capture(world.clock.now_ns())
    sensor.hangs = False
    assert camera.capture(world.clock.now_ns()).exposed_ns > begun_ns


def test_frame_that_arrives_at_the_time_out_is_not_lost(sensor, monkeypatch):
    """Its buffer would never be given back."""
    capture = open_capture("picamera2")
    assert capture.wait(0)
    assert capture.grab()
    fake = type(capture._camera)

    def cancelled(camera):
        sensor.hangs = camera._given_up = False
        camera.complete(camera._jobs[-1], 0.0)

    monkeypatch.setattr(fake, "cancel_all_and_flush", cancelled)
    for _ in range(2 * capture._camera.camera_configuration()["buffer_count"]):
        sensor.hangs = True
        assert capture.wait(0.1)
        assert capture.grab()
    assert capture._camera.held == 1


def test_usb_camera_of_libcamera_is_rejected(sensor):
    """Its images are JPEG, or have another order of colours; OpenCV opens it by its device file."""
    capture = open_capture("picamera2:1")
    lacking = (cv2.CAP_PROP_AUTO_EXPOSURE, cv2.CAP_PROP_AUTO_WB, v4l2.EXPOSURE_DYNAMIC_FRAMERATE, cv2.CAP_PROP_GAIN)
    assert [capture.get(prop) for prop in lacking] == [-1] * 4
    assert capture.limits(cv2.CAP_PROP_GAIN) is None
    with pytest.raises(DeviceNotFound, match="delivers MJPEG images") as rejected:
        capture.grab()
    assert "device file" in rejected.value.next_step
    capture.release()


def test_camera_that_does_not_start_has_a_reason(sensor, monkeypatch):
    def start(_):
        raise OSError(12, "Cannot allocate memory")

    capture = open_capture("picamera2")
    monkeypatch.setattr(type(capture._camera), "start", start)
    with pytest.raises(DeviceNotFound, match="cannot be started") as failed:
        capture.grab()
    assert "Cannot allocate memory" in failed.value.evidence["reason"]
    capture.release()


def test_missing_camera_other_user_and_missing_package_have_a_next_step(sensor, monkeypatch):
    with pytest.raises(DeviceNotFound, match="no camera 2") as missing:
        open_capture("picamera2:2")
    assert missing.value.evidence == {"found": ["imx708", picamera2.WEBCAM]}
    first = open_capture("picamera2")
    with pytest.raises(DeviceNotFound, match="cannot be opened") as used:
        open_capture("picamera2")
    assert used.value.evidence == {"reason": "Failed to acquire camera: Device or resource busy"}
    first.release()
    assert Computer().camera_device("picamera2:0") == "imx708 at /base/axi/pcie/i2c/imx708@1a"
    assert Computer().camera_device("picamera2:2") is None
    monkeypatch.setitem(sys.modules, "picamera2", None)
    with pytest.raises(DeviceNotFound, match="needs picamera2") as missing:
        Picamera2Capture(0)
    assert "apt install -y python3-picamera2" in missing.value.next_step
    assert Computer().camera_device("picamera2:0") is None


@pytest.mark.parametrize("receiver", ["unicam-image", "rp1-cfe-csi2_ch0"])
def test_sensor_on_the_ribbon_cable_is_recognised_and_not_opened(receiver, monkeypatch):
    with unopened(plugged=False) as bench:
        files = bench.computer
        files.serial_port()
        files.i2c_bus()
        files.camera(0, receiver)
        files.camera(10, "bcm2835-codec-decode")
        files.write("sys/class/video4linux/v4l-subdev0/name", "imx708 10-001a\n")
        files.write("sys/class/video4linux/v4l-subdev1/name", "dw9807 10-000c\n")
        assert bench.context.computer.cameras() == []
        assert bench.context.computer.ribbon_cameras() == ["imx708"]
        monkeypatch.setitem(sys.modules, "picamera2", None)
        scan = DeviceScan()
        (found,) = scan.find_cameras(bench.context)
        assert (found.code, found.evidence["name"]) == ("ribbon_camera_unreachable", "imx708")
        assert "python3-picamera2" in found.fix
        monkeypatch.setitem(sys.modules, "picamera2", ModuleType("picamera2"))
        (found,) = scan.find_cameras(bench.context)
        assert (found.code, found.evidence["number"]) == ("ribbon_camera", 0)
        assert scan.candidates["camera"][-1] == {("camera", "source"): "picamera2:0"}


@pytest.mark.parametrize(
    ("statement", "reason", "fix"),
    [
        (
            "raise ValueError('numpy.dtype size changed, may indicate binary incompatibility')",
            "ValueError: numpy.dtype size changed, may indicate binary incompatibility",
            "pip install --ignore-installed --no-deps simplejpeg",
        ),
        ("raise OSError('libcamera.so: no file')", "OSError: libcamera.so: no file", "apt install --reinstall"),
        ("raise RuntimeError('no manager')", "RuntimeError: no manager", "apt install --reinstall"),
        ("raise ImportError('DLL load failed')", "ImportError: DLL load failed", "apt install --reinstall"),
        ("import no_libcamera", "No module named 'no_libcamera'", "apt install -y python3-picamera2"),
    ],
)
def test_any_failure_of_the_import_is_an_error_and_a_finding_with_its_fix(
    statement, reason, fix, monkeypatch, tmp_path
):
    (tmp_path / "picamera2.py").write_text(statement, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "picamera2", raising=False)
    with pytest.raises(DeviceNotFound, match="needs picamera2") as caught:
        open_capture("picamera2")
    assert caught.value.evidence == {"reason": reason}
    assert fix in caught.value.next_step
    assert Computer().camera_device("picamera2") is None
    with unopened("camera.source=picamera2", plugged=False) as bench:
        bench.computer.camera(0, "rp1-cfe-csi2_ch0")
        bench.computer.write("sys/class/video4linux/v4l-subdev0/name", "imx708 10-001a\n")
        (found,) = DeviceScan().find_cameras(bench.context)  # rig find
        assert (found.code, found.evidence["reason"]) == ("ribbon_camera_unreachable", reason)
        assert fix in found.fix
        monkeypatch.setattr(bench.context.computer, "open_capture", open_capture)
        problem = bench.problem("camera")  # rig doctor
        assert (problem.code, problem.evidence["reason"]) == ("error", reason)
        assert fix in problem.fix
