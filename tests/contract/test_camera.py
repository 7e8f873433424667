"""The contract of every `rig.devices.camera.Camera`."""

import os
import sys
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest

from rig.core.clock import Clock, SystemClock
from rig.devices.camera import Camera, CameraIdentity, CameraLocks, Frame
from rig.devices.opencv_camera import OpenCvCamera
from rig.devices.opencv_capture import open_capture
from sim.camera import SimCapture
from sim.objects.shelf import shelf
from sim.world import World
from tests import fake_picamera2 as picamera2

Opened = tuple[Camera, Clock]


def simulated(_: Path) -> Opened:
    world = World(seed=1)
    world.put(shelf()["toy-house"])
    return OpenCvCamera(SimCapture(world), clock=world.clock), world.clock


def picture(k: int) -> np.ndarray[tuple[int, int, int], np.dtype[np.uint8]]:
    image = np.zeros((96, 128, 3), np.uint8)
    cv2.circle(image, (20 + 8 * k, 48), 12, (40, 200, 250), cv2.FILLED)
    return image


def image_sequence(folder: Path) -> Opened:
    for k in range(12):
        cv2.imwrite(str(folder / f"img_{k:02d}.png"), picture(k))
    world = World()
    return OpenCvCamera(open_capture(folder / "img_%02d.png"), clock=world.clock), world.clock


def video_file(folder: Path) -> Opened:
    path = folder / "recording.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 30.0, (128, 96))
    for k in range(12):
        writer.write(picture(k))
    writer.release()
    world = World()
    return OpenCvCamera(open_capture(path), clock=world.clock), world.clock


def raspberry_pi(_: Path) -> Opened:
    world = World(seed=1)
    world.put(shelf()["toy-house"])
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "picamera2", picamera2.module(SimCapture(world), world.clock))
        return OpenCvCamera(open_capture("picamera2:0"), clock=world.clock), world.clock


def device_file(_: Path, form: str = "YUYV") -> Opened:
    path = os.environ.get("RIG_TEST_CAMERA", "")
    if not path:
        pytest.skip("`make kernel-test` gives it a device file")
    capture, clock = open_capture(path), SystemClock()
    capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*form))
    return OpenCvCamera(capture, clock=clock), clock


def device_file_mjpg(folder: Path) -> Opened:
    return device_file(folder, "MJPG")


IN_MEMORY = (simulated, raspberry_pi, image_sequence, video_file)
DEVICE_FILES = tuple(pytest.param(kind, marks=pytest.mark.kernel) for kind in (device_file, device_file_mjpg))


@pytest.fixture(params=[*IN_MEMORY, *DEVICE_FILES], ids=lambda kind: kind.__name__)
def opened(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Opened]:
    kind: Callable[[Path], Opened] = request.param
    camera, clock = kind(tmp_path)
    yield camera, clock
    camera.close()


def test_frame_has_the_size_of_the_identity_eight_bits_and_its_time(opened: Opened) -> None:
    camera, clock = opened
    identity = camera.identity
    assert isinstance(identity, CameraIdentity)
    assert identity.name
    assert identity.fps == pytest.approx(30, abs=6)
    frame = camera.capture(clock.now_ns())
    assert isinstance(frame, Frame)
    assert frame.image_bgr.shape == (identity.height, identity.width, 3)
    assert frame.image_bgr.dtype == np.uint8
    assert isinstance(frame.exposed_ns, int)
    assert frame.exposed_ns <= clock.now_ns()


@pytest.mark.parametrize(
    "ahead_ns", [0, 400_000_000, *(pytest.param(ns, marks=pytest.mark.nightly) for ns in (1, 5_000_000))]
)
def test_no_frame_is_older_than_requested(opened: Opened, ahead_ns: int) -> None:
    camera, clock = opened
    for pause_s in (0.0, 0.02, 1.0):
        clock.sleep(pause_s)
        after_ns = clock.now_ns() + ahead_ns
        assert camera.capture(after_ns).exposed_ns >= after_ns


def test_frames_are_not_repeated_and_keep_their_pixels(opened: Opened) -> None:
    camera, _ = opened
    frames = [camera.capture(0)]
    before = frames[0].image_bgr.copy()
    for _ in range(4):
        frames.append(camera.capture(frames[-1].exposed_ns + 1))
    times = [frame.exposed_ns for frame in frames]
    assert times == sorted(set(times))
    for one, other in pairwise(frames):
        assert (one.image_bgr != other.image_bgr).any()
    np.testing.assert_array_equal(frames[0].image_bgr, before)


def test_locks_are_numbers_or_none_and_close_can_be_called_twice(opened: Opened) -> None:
    camera, clock = opened
    locks = camera.read_locks()
    assert isinstance(locks, CameraLocks)
    for value in (locks.exposure_us, locks.gain, locks.white_balance_k):
        assert value is None or value >= 0
    assert locks.auto_exposure in (True, False, None)
    camera.capture(clock.now_ns())
    assert camera.read_locks() == locks
    camera.close()
    camera.close()
