"""Cameras behind Linux's drivers: faults, changed settings, formats, and a second driver."""

import json
from pathlib import PurePosixPath
from typing import Any

import cv2
import numpy as np
import pytest

from tests.kernel.guest_bench import GuestBench
from tests.kernel.test_first_day import CAMERA

pytestmark = [pytest.mark.kernel, pytest.mark.timeout(600)]

DELAY_NS = 2_000_000_000
STAMPS = """
from rig.core.clock import SystemClock
from rig.devices.opencv_camera import OpenCvCamera
from rig.devices.opencv_capture import open_capture

clock = SystemClock()
camera = OpenCvCamera(open_capture("{path}"), clock=clock)
before_ns = 0
for _ in range(5):
    asked_ns = clock.now_ns()
    frame = camera.capture(asked_ns)
    assert max(asked_ns, before_ns + 1) <= frame.exposed_ns <= clock.now_ns(), (camera.time_base, frame.exposed_ns)
    before_ns = frame.exposed_ns
camera.close()
"""
"""vivid stamps the end of a frame, ahead of the clock; no frame may count as newer than it is."""


def findings(bench: GuestBench) -> dict[str, Any]:
    doctor = bench.rig("doctor", "--json")
    return {one["code"]: one for one in json.loads(doctor.result)["findings"]}


def test_doctor_finds_a_camera_that_repeats_one_image_and_not_its_delay(bench: GuestBench) -> None:
    """Linux stamps a frame when it arrives, so the delay does not show: the doctor says how to measure it."""
    still: list[np.ndarray] = []
    with bench.played.time.present():
        bench.played.devices.camera.filters.append(lambda image, _: (still.append(image), still[0])[1])
        bench.played.devices.camera.latency_ns = DELAY_NS
    found = findings(bench)
    assert found["camera_frozen"]["evidence"]["frame_age_ms"] < DELAY_NS * 1e-6
    assert "calibrate camera-time" in found["camera_delay_unknown"]["fix"]


def test_a_camera_that_hangs_is_reported(bench: GuestBench) -> None:
    bench.played.camera.stopped = True
    snapshot = bench.rig("snapshot", "hangs.png")
    assert snapshot.code == 4, snapshot.output
    assert "hangs: no frame in" in snapshot.output
    bench.played.camera.stopped = False
    again = bench.rig("snapshot", "again.png")
    assert again.code == 0, again.output


@pytest.mark.parametrize(
    ("drift", "reason"),
    [
        ({"focus": 60.0}, "a setting of the camera has changed"),
        ({"kelvin": 3200.0}, "a setting of the camera has changed"),
        ({"gain_db": 12.0}, "overexposed"),  # the driver remembers a gain, and does not ask the camera again
    ],
    ids=lambda value: "" if isinstance(value, str) else next(iter(value)),
)
def test_a_view_is_rejected_after_a_setting_has_drifted(
    bench: GuestBench, drift: dict[str, float], reason: str
) -> None:
    enroll = bench.start("enroll", f"drift-{next(iter(drift))[:4]}", "--views", 4)
    bench.until_printed(enroll, "view 1, azimuth")
    with bench.played.time.present():
        bench.played.devices.camera.drift(**drift)
    ended = enroll.wait(300)
    assert ended.code == 6, ended.output
    assert reason in ended.output, ended.output


def test_the_same_scene_is_seen_in_both_formats(bench: GuestBench) -> None:
    script = f"""
import cv2
from rig.devices.opencv_capture import open_capture
for name in ("YUYV", "MJPG"):
    camera = open_capture("{CAMERA}")
    camera.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*name))
    camera.grab(), camera.grab()
    ok, image = camera.retrieve()
    form = int(camera.get(cv2.CAP_PROP_FOURCC)).to_bytes(4, "little").decode()
    camera.release()
    print(form, *image.shape, image.mean())
"""
    seen = bench.python(script)
    assert seen.code == 0, seen.output
    (yuyv, *shape, level), (mjpg, *other_shape, other_level) = map(str.split, seen.result.splitlines())
    assert (yuyv, mjpg) == ("YUYV", "MJPG")
    assert shape == other_shape == ["480", "640", "3"]
    assert float(level) == pytest.approx(float(other_level), rel=0.03)


def test_another_driver_delivers_frames_with_plausible_times(bench: GuestBench) -> None:
    bench.sh("modprobe vivid n_devs=1 node_types=0x1 && udevadm settle")
    try:
        node = PurePosixPath(bench.sh("dirname $(grep -l vivid /sys/class/video4linux/*/name | head -1)")).name
        settings = (f"camera.source=/dev/{node}", "camera.width=640", "camera.height=480")
        snapshot = bench.rig("snapshot", "vivid.png", *(word for setting in settings for word in ("--set", setting)))
        assert snapshot.code == 0, snapshot.output
        assert "640x480 pixels" in snapshot.output
        stamps = bench.python(STAMPS.format(path=f"/dev/{node}"))
        assert stamps.code == 0, stamps.output
    finally:
        bench.sh("modprobe -r vivid")


def test_image_of_the_real_driver_is_that_of_the_simulated_camera(bench: GuestBench) -> None:
    assert bench.rig("snapshot", "view.png").code == 0
    encoded = bytes.fromhex(bench.sh("od -An -v -tx1 view.png | tr -d ' \\n'"))
    seen = cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_COLOR)
    with bench.played.time.present():
        camera = bench.played.devices.camera
        for _ in range(6):  # the first ones have waited in the buffers
            camera.grab()
        drawn = camera.retrieve()[1]
    assert np.abs(seen.astype(int) - drawn).mean() < 6
