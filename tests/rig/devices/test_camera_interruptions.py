"""The OpenCV camera driver with an unplugged cable, with another camera after that, and with slow frames."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from rig.bench.computer import Computer
from rig.bench.hardware import CameraPlug
from rig.core.errors import DeviceMismatch, DeviceNotFound, DeviceSilent
from rig.devices.opencv_camera import OpenCvCamera
from sim.camera import SimCapture
from sim.computer import ComputerFiles
from sim.frame_times import FPS
from sim.world import World

PERIOD_NS = 1_000_000_000 // FPS


def test_camera_with_another_number_after_replugging_is_found(tmp_path: Path, world: World) -> None:
    """The kernel gives it a new number while a program holds its old device file."""

    class Local(Computer):
        def open_capture(self, source: int | str) -> SimCapture:
            if self.device_node(source) is None:
                raise DeviceNotFound("missing", next_step="connect it")
            opened.append(source)
            return SimCapture(world)

    opened: list[int | str] = []
    files = ComputerFiles(tmp_path)
    files.camera(0, "Cam", serial="A1", usb_port="1-1")
    plug = CameraPlug(Local(tmp_path), 0)
    plug.open()
    node = plug.node()
    for gone in ("dev/video0", "sys/class/video4linux/video0/device"):
        (tmp_path / gone).unlink()
    assert plug.node() is None
    with pytest.raises(DeviceNotFound):
        plug.open()
    files.camera(1, "Cam again", serial="A1", usb_port="1-2")
    plug.open()
    assert opened == [0, "/dev/video1"]
    assert plug.node() not in (None, node)


def returning(world: World, capture: SimCapture, away_s: float) -> OpenCvCamera:
    """Return a camera that is unplugged now, and plugged in again ``away_s`` later."""

    def reopen() -> SimCapture:
        if not capture.reopen():
            raise DeviceNotFound("there is no camera", next_step="connect the camera")
        return capture

    camera = OpenCvCamera(capture, clock=world.clock, reopen=reopen, node=capture.node)
    capture.unplug()
    world.clock.call_at(world.clock.now_ns() + round(away_s * 1e9), capture.replug)
    return camera


@pytest.mark.parametrize("away_s", [0.0, 0.5, 2.0])
def test_replugged_camera_continues_with_its_settings(world: World, away_s: float) -> None:
    capture = SimCapture(world)
    capture.set(cv2.CAP_PROP_SHARPNESS, 77)  # by another program
    camera = returning(world, capture, away_s)
    after_ns = world.clock.now_ns()
    frame = camera.capture(after_ns)
    assert frame.exposed_ns >= after_ns + away_s * 1e9
    locks = camera.read_locks()
    assert (locks.exposure_us, locks.gain, locks.sharpness) == (10_000, 0, 77)
    assert (locks.focus, locks.autofocus) == (120, False)  # it woke out of focus, with its autofocus on


def test_meanwhile_is_called_while_the_camera_is_unplugged(world: World) -> None:
    camera = returning(world, SimCapture(world), 2.0)
    done_ns = [world.clock.now_ns()]
    camera.capture(world.clock.now_ns(), lambda: done_ns.append(world.clock.now_ns()))
    assert np.diff([*done_ns, world.clock.now_ns()]).max() < 0.8e9  # the gyro's FIFO lasts for 0.85 s


def test_missing_camera_raises_device_silent_in_bounded_time(world: World) -> None:
    capture = SimCapture(world)
    camera = returning(world, capture, 3600.0)
    begun_ns = world.clock.now_ns()
    with pytest.raises(DeviceSilent, match="was disconnected for more than") as caught:
        camera.capture(begun_ns)
    assert caught.value.next_step == "connect the camera"
    assert world.clock.now_ns() - begun_ns < 4e9


def test_different_camera_after_replugging_is_rejected(world: World) -> None:
    capture = SimCapture(world)

    class Small(SimCapture):
        def set(self, prop: int, value: float) -> bool:
            return False

        def get(self, prop: int) -> float:
            return 320.0 if prop == cv2.CAP_PROP_FRAME_WIDTH else super().get(prop)

    camera = OpenCvCamera(capture, clock=world.clock, reopen=lambda: Small(world), node=capture.node)
    capture.unplug()
    with pytest.raises(DeviceMismatch, match="another camera") as caught:
        camera.capture(world.clock.now_ns())
    assert caught.value.evidence["got"][0] == 320


@pytest.mark.parametrize("seconds_a_frame", [1.0, 1.5, 2.5])
def test_meanwhile_is_called_while_waiting_for_a_slow_camera(world: World, seconds_a_frame: float) -> None:
    capture = SimCapture(world)
    camera = OpenCvCamera(capture, clock=world.clock)
    capture.every = round(FPS * seconds_a_frame)
    for _ in range(3):  # the driver measures its speed with the first frames
        camera.capture(world.clock.now_ns())
    done_ns: list[int] = [world.clock.now_ns()]
    for _ in range(3):
        frame = camera.capture(world.clock.now_ns(), lambda: done_ns.append(world.clock.now_ns()))
        assert frame.exposed_ns > done_ns[0]
    gaps_s = np.diff([*done_ns, world.clock.now_ns()]) * 1e-9
    assert gaps_s.max() < 0.8  # the gyro's FIFO lasts for 0.85 s


def test_meanwhile_does_not_slow_down_a_fast_camera(world: World) -> None:
    camera = OpenCvCamera(SimCapture(world), clock=world.clock)
    calls: list[int] = []
    begun_ns = world.clock.now_ns()
    for _ in range(10):
        camera.capture(world.clock.now_ns(), lambda: calls.append(1))
    assert calls == []
    assert world.clock.now_ns() - begun_ns < 10 * 2.1 * PERIOD_NS + 1e8
