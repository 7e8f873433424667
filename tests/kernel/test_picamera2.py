"""picamera2 itself, on libcamera's pipeline ``uvcvideo``: requests, buffers, time-outs, and cameras that are gone.

libcamera drives a camera of a Raspberry Pi only with the hardware of one. Here it drives a played webcam that delivers
BGR, as those cameras do. This pipeline reports the times of the frames, but not their settings.
"""

import json
from collections.abc import Iterator

import cv2
import numpy as np
import pytest

from sim.camera import SimCapture
from tests.kernel.guest_bench import GuestBench
from tests.kernel.usb.webcam import C920, Webcam, video_configuration

pytestmark = [pytest.mark.kernel, pytest.mark.timeout(900)]

PREPARE = """
ln -s system /dev/dma_heap/linux,cma
sed -i 's|/firmware_node/path|/./././././modalias|' /usr/lib/*/libcamera.so.*
"""
"""picamera2 takes its buffers from the heap with this name. libcamera asks for the firmware's path of the USB
controller, to make the camera's identity, and the virtual controller has none: its driver's name is taken instead."""
TINT: tuple[int, int, int] = (200, 100, 20)
USE = """
import json
import cv2
from rig.config import CameraConfig
from rig.core.clock import SystemClock
from rig.core.errors import DeviceNotFound
from rig.devices.opencv_camera import OpenCvCamera
from rig.devices.opencv_capture import open_capture

found, clock = {}, SystemClock()
capture = open_capture("picamera2")
camera = OpenCvCamera(capture, clock=clock, settings=CameraConfig(width=320, height=240))
found["base"] = camera.time_base.value
found["lacking"] = [rejected.setting for rejected in camera.rejected_settings]
for prop, value in ((cv2.CAP_PROP_AUTO_EXPOSURE, 1), (cv2.CAP_PROP_EXPOSURE, 50)):
    capture.set(prop, value)
    camera.capture(clock.now_ns())
found["early"] = []
for _ in range(6):  # more than there are buffers
    asked_ns = clock.now_ns()
    frame = camera.capture(asked_ns)
    found["early"].append(not asked_ns <= frame.exposed_ns <= clock.now_ns())
found["shape"], found["colour"] = frame.image_bgr.shape, frame.image_bgr.mean(axis=(0, 1)).tolist()

capture._release_request()
held = [capture._camera.capture_request(wait=20.0) for _ in range(4)]
found["without a buffer"] = [capture.wait(seconds) for seconds in (0, 0.5)]
for one in held:
    one.release()
found["with buffers"] = capture.wait(20.0)
print(json.dumps(found), flush=True)

def first_error():
    while True:
        try:
            camera.capture(clock.now_ns())
        except Exception as error:
            return error
"""
HANG = """
print("hang", flush=True)
silent = first_error()
print("silent:", type(silent).__name__, silent, flush=True)
while True:
    try:
        camera.capture(clock.now_ns())
        break
    except Exception as error:
        print("again:", error, flush=True)
print("frames", flush=True)
"""
GONE = """
print("unplug", flush=True)
gone = first_error()
print("gone:", type(gone).__name__, gone, flush=True)
camera.close()
camera.close()
print("closed", flush=True)
"""
OTHERS = """
from rig.core.errors import DeviceNotFound
from rig.devices.opencv_capture import open_capture
from rig.devices.picamera2_capture import camera_id

print(camera_id(0), camera_id(9))
for number in (0, 1, 9):
    try:
        open_capture(f"picamera2:{number}").grab()
    except DeviceNotFound as error:
        print(number, error, error.evidence)
"""


@pytest.fixture(scope="module")
def webcam(guest: GuestBench) -> Iterator[Webcam]:
    """Plug it in."""
    if guest.start_sh("python3 -c 'import libcamera, picamera2'").wait(200.0).code:
        pytest.skip(
            "the virtual machine has no picamera2: sh tests/kernel/guest/computer.sh picamera2 FOLDER, and "
            "RIG_TEST_KERNEL=FOLDER"
        )
    guest.sh(PREPARE)
    camera = SimCapture(guest.played.devices.world)
    camera.filters.append(lambda image, _: np.full_like(image, TINT))
    webcam = Webcam(camera, guest.played.time, C920, video_configuration("BGR3"))
    guest.plug_in_webcam(webcam, 0)
    yield webcam
    webcam.close()


def test_frames_buffers_other_programs_a_hang_and_a_pulled_cable(guest: GuestBench, webcam: Webcam) -> None:
    program = guest.start(code=USE + HANG + GONE, folder="/")
    guest.until_printed(program, "hang", 300.0)
    found = json.loads(program.output.split("hang")[0].splitlines()[-1])
    assert (found["base"], found["shape"]) == ("stamped", [240, 320, 3])
    assert found["early"] == [False] * 6
    assert found["colour"] == pytest.approx(TINT, abs=1)
    assert (found["without a buffer"], found["with buffers"]) == ([False, False], True)
    # Settings reach the camera with a request, not at the start, and no frame reports them.
    assert found["lacking"] == ["exposure_100us", "white_balance_k"]
    with guest.played.time.present():
        assert webcam._camera.get(cv2.CAP_PROP_EXPOSURE) == 50
        assert webcam._camera.get(cv2.CAP_PROP_AUTO_EXPOSURE) == 1

    # Another program cannot have the camera; the bench's own webcam has another format, and a third one is not there.
    others = guest.start(code=OTHERS, folder="/").wait(300.0).output
    assert "HD Pro Webcam C920 at platform:vhci_hcd" in others
    assert "0 The camera 0 of the Raspberry Pi cannot be opened." in others
    assert "Device or resource busy" in others, others
    assert "1 libcamera delivers MJPEG images" in others
    assert "9 libcamera finds no camera 9." in others

    webcam.stopped = True
    guest.until_printed(program, "silent: DeviceSilent", 120.0)
    webcam.stopped = False
    guest.until_printed(program, "frames", 120.0)
    guest.until_printed(program, "unplug", 30.0)
    webcam.unplug()
    guest.until_printed(program, "gone: Device", 120.0)
    guest.until_printed(program, "closed", 60.0)
