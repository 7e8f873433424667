"""Seven real webcams, by their descriptors, behind Linux's driver ``uvcvideo``.

The texts and the ranges of the controls are not in the recorded descriptors: they are made up, as cheap cameras have
them. Two cameras have the same name and the same serial number, and a gain begins at 1.
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import pytest

from rig.devices.v4l2 import COMPRESSED, UNCOMPRESSED
from sim.camera import SimCapture
from tests.kernel.conftest import FirstDay
from tests.kernel.guest_bench import GuestBench
from tests.kernel.usb.descriptors import Identity, Speed, at_super_speed
from tests.kernel.usb.webcam import COARSE, Webcam
from tests.webcams import WEBCAMS, recorded

pytestmark = [pytest.mark.kernel, pytest.mark.timeout(600)]

TEXTS = {
    "anker_powerconf_c200": ("Anker", "Anker PowerConf C200", "ACNV9P0D"),
    "canyon_cne_cwc2": ("Sonix", "USB 2.0 Camera", ""),
    "elp_h264": ("HD USB Camera", "HD USB Camera", "01.00.00"),
    "elp_h265": ("HD USB Camera", "HD USB Camera", "01.00.00"),
    "logitech_c270": ("", "", "5A2B7C10"),
    "logitech_streamcam": ("", "Logitech StreamCam", "61A4E2F5"),
    "trust_webcam": ("Sonix", "USB 2.0 Camera", "SN0001"),
}
"""Maker, product and serial number."""
FOUND = {
    "anker_powerconf_c200": ("Anker PowerConf C200: Anker Pow", "by-id/usb-Anker_Anker_PowerConf_C200_ACNV9P0D"),
    "canyon_cne_cwc2": ("USB 2.0 Camera: USB 2.0 Camera", "by-id/usb-Sonix_USB_2.0_Camera"),
    "elp_h264": ("HD USB Camera: HD USB Camera", "by-path/"),
    "elp_h265": ("HD USB Camera: HD USB Camera", "by-path/"),
    "logitech_c270": ("UVC Camera (046d:0825)", "by-id/usb-046d_0825_5A2B7C10"),
    "logitech_streamcam": ("Logitech StreamCam", "by-id/usb-046d_Logitech_StreamCam_61A4E2F5"),
    "trust_webcam": ("USB 2.0 Camera: USB 2.0 Camera", "by-id/usb-Sonix_USB_2.0_Camera_SN0001"),
}
"""Name in Linux, and how the stable name begins."""
OPEN = """
import json
from dataclasses import asdict
from rig.config import CameraConfig
from rig.core.clock import SystemClock
from rig.devices.opencv_camera import OpenCvCamera
from rig.devices.opencv_capture import open_capture

clock = SystemClock()
capture = open_capture({path!r})
camera = OpenCvCamera(capture, clock=clock, settings=CameraConfig({settings}))
image = camera.capture(clock.now_ns()).image_bgr
print(json.dumps({{
    "modes": [(mode.fourcc, mode.width, mode.height, mode.fps) for mode in camera.modes],
    "rejected": [(one.setting, one.reported) for one in camera.rejected_settings],
    "locks": asdict(camera.read_locks()),
    "time_base": camera.time_base.value,
    "shape": image.shape,
    "mean": image.mean(),
}}))
camera.close()
"""
LIST = """
import json
from rig.bench.computer import Computer

computer = Computer()
print(json.dumps([
    (camera.path, camera.name, camera.stable, computer.camera_device(camera.path)) for camera in computer.cameras()
]))
"""


@dataclass(frozen=True, slots=True)
class Plugged:
    """A webcam in the virtual machine."""

    played: Webcam
    path: str


def played(bench: GuestBench, name: str, speed: Speed = Speed.HIGH) -> Webcam:
    device, configuration = recorded(name)
    identity = Identity.read(device, configuration, TEXTS[name])
    if speed is Speed.SUPER:
        identity, configuration = identity.at_super_speed(), at_super_speed(configuration)
    camera = SimCapture(bench.played.devices.world)
    return Webcam(camera, bench.played.time, identity, configuration, COARSE, speed)


@pytest.fixture(scope="module")
def webcams(guest: GuestBench, first_day: FirstDay) -> Iterator[dict[str, Plugged]]:
    """Plug all of them in."""
    plugged: dict[str, Plugged] = {}
    for number, name in enumerate(WEBCAMS):
        webcam = played(guest, name)
        plugged[name] = Plugged(webcam, guest.plug_in_webcam(webcam, number))
    yield plugged
    for one in plugged.values():
        one.played.close()


def opened(bench: GuestBench, path: str, settings: str = "") -> dict[str, Any]:
    """Return what the rig's driver sees of a camera."""
    seen = bench.python(OPEN.format(path=path, settings=settings))
    assert seen.code == 0, seen.output
    result: dict[str, Any] = json.loads(seen.result.splitlines()[-1])
    return result


def test_all_are_found_with_their_names(bench: GuestBench, webcams: dict[str, Plugged]) -> None:
    find = bench.rig("find")
    assert find.code == 0, find.output
    for name, plugged in webcams.items():
        assert f"{plugged.path}: {FOUND[name][0]}: 640x480 at 30 frames/s" in find.output


def test_each_has_a_stable_name_and_an_identity_of_its_own(bench: GuestBench, webcams: dict[str, Plugged]) -> None:
    listed = bench.python(LIST)
    assert listed.code == 0, listed.output
    cameras = {path: rest for path, *rest in json.loads(listed.result)}
    assert {plugged.path for plugged in webcams.values()} < set(cameras)  # beside the bench's own
    for name, plugged in webcams.items():
        linux_name, stable, _ = cameras[plugged.path]
        assert (linux_name, stable.startswith(f"/dev/v4l/{FOUND[name][1]}")) == (FOUND[name][0], True), stable
        assert bench.sh(f"readlink -f {stable}") == plugged.path
    assert len({stable for _, stable, _ in cameras.values()}) == len(cameras)
    assert len({identity for *_, identity in cameras.values()}) == len(cameras)


@pytest.mark.parametrize("name", WEBCAMS)
def test_settings_that_a_camera_has_are_locked_and_read_back(
    bench: GuestBench, webcams: dict[str, Plugged], name: str
) -> None:
    model, seen = WEBCAMS[name], opened(bench, webcams[name].path)
    offered = {tuple(mode) for mode in seen["modes"]}
    expected = {(one.fourcc, one.width, one.height, one.fps) for one in model.modes}
    assert offered == {mode for mode in expected if mode[0] in UNCOMPRESSED + COMPRESSED}
    lacking = {"trust_webcam": ["exposure_100us", "white_balance_k"], "canyon_cne_cwc2": ["white_balance_k"]}
    assert seen["rejected"] == [[setting, "no such control"] for setting in lacking.get(name, [])]
    locks = seen["locks"]
    assert locks["exposure_us"] == (None if cv2.CAP_PROP_EXPOSURE in model.missing else 10_000)
    assert locks["gain"] == (None if cv2.CAP_PROP_GAIN in model.missing else 1)  # the smallest one
    assert locks["white_balance_k"] == (None if cv2.CAP_PROP_WB_TEMPERATURE in model.missing else 5000)
    assert (locks["focus"] is None) == (cv2.CAP_PROP_FOCUS in model.missing)
    automatics = ("auto_exposure", "auto_white_balance", "autofocus", "dynamic_frame_rate")
    assert not any(locks[automatic] for automatic in automatics)
    with bench.played.time.present():  # the camera itself has them
        camera = webcams[name].played._camera
        if locks["exposure_us"] is not None:
            assert camera.get(cv2.CAP_PROP_EXPOSURE) == 100
        if locks["white_balance_k"] is not None:
            assert camera.get(cv2.CAP_PROP_WB_TEMPERATURE) == 5000
    assert (seen["time_base"], seen["shape"]) == ("stamped", [480, 640, 3])
    assert 40 < seen["mean"] < 90


def test_a_large_mode_is_streamed(bench: GuestBench, webcams: dict[str, Plugged]) -> None:
    seen = opened(bench, webcams["logitech_c270"].path, "width=1280, height=720")
    assert (seen["rejected"], seen["shape"]) == ([], [720, 1280, 3])


@pytest.mark.parametrize("fourcc", ["HEVC", "H264"])
def test_a_format_that_opencv_cannot_decode_is_rejected(
    bench: GuestBench, webcams: dict[str, Plugged], fourcc: str
) -> None:
    """The driver offers it, and sets it."""
    path = webcams["elp_h265"].path
    assert opened(bench, path, f"fourcc={fourcc!r}")["rejected"][0][0] == "fourcc"
    settings = (f"camera.source={path}", f"camera.fourcc={fourcc}")
    doctor = bench.rig("doctor", "--json", *(word for setting in settings for word in ("--set", setting)))
    problems = {one["code"]: one for one in json.loads(doctor.result)["findings"]}
    assert "rig config set camera.fourcc none" in problems["mode_not_offered"]["fix"]


def test_a_camera_at_super_speed_is_opened(bench: GuestBench) -> None:
    """No descriptors at this speed are recorded: each endpoint gets the companion that it has there."""
    webcam = played(bench, "logitech_streamcam", Speed.SUPER)
    try:
        path = bench.plug_in_webcam(webcam, len(WEBCAMS))
        assert bench.sh("cat $(dirname $(grep -lx 0893 /sys/bus/usb/devices/*/idProduct | tail -1))/speed") == "5000"
        assert opened(bench, path)["rejected"] == []
    finally:
        webcam.close()
