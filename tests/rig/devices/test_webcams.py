"""What seven real webcams show by their USB descriptors: formats, controls that lack, names and ids."""

from collections.abc import Iterator
from pathlib import Path

import cv2
import pytest

from rig.bench.computer import Computer
from rig.config import CameraConfig
from rig.core.next_steps import Do
from rig.devices import v4l2
from rig.devices.opencv_camera import NO_CONTROL, OpenCvCamera
from rig.devices.opencv_capture import OpenedCapture
from rig.devices.v4l2 import CAPTURE, VideoMode, choose_mode
from rig.doctor.device_scan import camera_settings
from sim.world import World
from tests.rig.devices.test_v4l2 import driver
from tests.rig.doctor.doctor_parts import unopened
from tests.webcams import WEBCAMS, ModelledWebcam

META = 0x0080_0000


class Sizes(dict[tuple[int, int], list[tuple[int, int]]]):
    """The sizes of a pixel format; ``listed`` is their order in the descriptors, which may repeat one."""

    def __init__(self, modes: list[VideoMode]) -> None:
        super().__init__({(mode.width, mode.height): [(100, round(100 * mode.fps))] for mode in modes})
        self.listed = [(mode.width, mode.height) for mode in modes]

    def __iter__(self) -> Iterator[tuple[int, int]]:
        return iter(self.listed)


LARGE = {"canyon_cne_cwc2": VideoMode("MJPG", 1280, 720, 15.0), "trust_webcam": VideoMode("YUYV", 1280, 1024, 5.0)}


@pytest.mark.parametrize("name", WEBCAMS)
def test_mode_is_one_that_opencv_converts_and_that_is_fast_enough(
    name: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    node = tmp_path / "video0"
    node.touch()
    model = WEBCAMS[name]
    formats = {
        fourcc.encode(): Sizes([mode for mode in model.modes if mode.fourcc == fourcc]) for fourcc in model.formats
    }
    monkeypatch.setattr(v4l2, "ioctl", driver(formats))
    offered = v4l2.modes(node)
    assert len(set(offered)) == len(offered)
    assert set(offered) == {mode for mode in model.modes if mode.fourcc in ("YUYV", "MJPG")}
    assert choose_mode(offered, 640, 480, 30) == VideoMode("YUYV", 640, 480, 30.0)
    assert choose_mode(offered, 1280, 720, 30) == LARGE.get(name, VideoMode("MJPG", 1280, 720, 30.0))


@pytest.mark.parametrize("name", WEBCAMS)
def test_controls_that_exist_are_locked_and_the_others_are_named_once(name: str, world: World) -> None:
    model = WEBCAMS[name]
    camera = OpenCvCamera(ModelledWebcam(world, model), clock=world.clock)
    without = {"trust_webcam": ["exposure_100us", "white_balance_k"], "canyon_cne_cwc2": ["white_balance_k"]}
    assert [one.setting for one in camera.rejected_settings] == without.get(name, [])
    assert {one.reported for one in camera.rejected_settings} <= {NO_CONTROL}
    locks = camera.read_locks()
    assert locks.exposure_us == (None if name == "trust_webcam" else 10_000)
    assert locks.gain == (None if cv2.CAP_PROP_GAIN in model.missing else 1)  # the smallest one
    assert (locks.focus is None) == (name not in ("anker_powerconf_c200", "logitech_streamcam"))
    automatics = (locks.auto_exposure, locks.auto_white_balance, locks.autofocus, locks.dynamic_frame_rate)
    assert not any(automatics)


def test_steps_of_a_control_are_no_rejection(world: World) -> None:
    def rejected(**settings: float) -> list[str]:
        capture = ModelledWebcam(world, WEBCAMS["logitech_streamcam"])
        camera = OpenCvCamera(capture, clock=world.clock, settings=CameraConfig(**settings))
        return [one.setting for one in camera.rejected_settings]

    assert rejected(white_balance_k=2850) == []  # of 100 K
    assert rejected(white_balance_k=2000) == ["white_balance_k"]
    assert rejected(gain=99) == ["gain"]


def test_limits_of_a_control_are_those_of_the_driver(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    node = tmp_path / "video0"
    node.touch()
    monkeypatch.setattr(v4l2, "ioctl", driver({}, controls={0x0098_0913: (1, 128, 1), 0x0098_091A: (2800, 12500, 100)}))
    capture = OpenedCapture(cv2.VideoCapture(), str(node))
    assert capture.limits(cv2.CAP_PROP_GAIN) == (1, 1)
    assert capture.limits(cv2.CAP_PROP_WB_TEMPERATURE) == (2800, 100)
    assert capture.limits(cv2.CAP_PROP_FOCUS) is capture.limits(cv2.CAP_PROP_FPS) is None


def test_doctor_names_what_a_camera_lacks_with_the_setting_that_accepts_it() -> None:
    with unopened() as bench:
        bench.devices.camera = ModelledWebcam(bench.devices.world, WEBCAMS["trust_webcam"])
        found = bench.findings("camera")
        assert "not_locked" not in {one.code for one in found}
        problems = {one.evidence["setting"]: one for one in found if one.code == "setting_rejected"}
        assert list(problems) == ["exposure_100us", "white_balance_k"]
        assert problems["exposure_100us"].steps[-1] == Do.SET_KEY(key="camera.exposure_us", value="none")
    with unopened("camera.fourcc=HEVC") as bench:
        bench.devices.camera = ModelledWebcam(bench.devices.world, WEBCAMS["elp_h265"])
        problem = next(one for one in bench.findings("camera") if one.code == "mode_not_offered")
        assert problem.steps == (Do.SET_KEY(key="camera.fourcc", value="none"),)
        assert "(HEVC); nearest: 640x480 at 30 frames/s (YUYV)" in problem.words


class Decodes(ModelledWebcam):
    """It can be set to any format, as with ``uvcvideo``."""

    asked: int | None = None

    def set(self, prop: int, value: float) -> bool:
        if prop == cv2.CAP_PROP_FOURCC:
            self.asked = int(value)
            return True
        return super().set(prop, value)


def test_a_format_that_opencv_does_not_convert_is_rejected_without_asking_for_it(world: World) -> None:
    capture = Decodes(world, WEBCAMS["elp_h265"])
    camera = OpenCvCamera(capture, clock=world.clock, settings=CameraConfig(fourcc="HEVC"))
    assert [(one.setting, one.asked) for one in camera.rejected_settings] == [("fourcc", "HEVC")]
    assert capture.asked is None


def test_cameras_without_names_and_with_one_id_are_distinguished() -> None:
    with unopened(plugged=False) as bench:
        files, computer = bench.computer, bench.context.computer
        for number, (name, model) in enumerate(WEBCAMS.items()):
            label = name if "p" in model.strings else f"UVC Camera ({model.vendor:04x}:{model.product:04x})"
            usb = (f"{model.vendor:04x}", f"{model.product:04x}", name if "p" in model.strings else "")
            serial = "SN0001" if "s" in model.strings else None
            second = 2 if name == "elp_h264" else 1  # its second stream; the others have a node of metadata
            for at, index in ((2 * number, 0), (2 * number + 1, second)):
                caps = META if index == 1 else CAPTURE
                files.camera(at, label, index=index, serial=serial, usb_port=f"1-{number}", usb=usb, capabilities=caps)
        cameras = computer.cameras()
        assert [node.path for node in cameras] == [f"/dev/video{2 * number}" for number in range(len(WEBCAMS))]
        assert cameras[4].name == "UVC Camera (046d:0825)"
        assert len({str(camera_settings(node)) for node in cameras}) == len(WEBCAMS)
        devices = [Computer.camera_device(computer, node.path) for node in cameras]
        assert len(set(devices)) == len(WEBCAMS)
        assert devices[1] == "USB 0c45:6340 (canyon_cne_cwc2) at usb-1-1-video-index0"
        assert devices[4] == "USB 046d:0825, serial number SN0001"
        assert devices[6] == "USB 0c45:6340 (trust_webcam), serial number SN0001"


def test_cameras_with_the_same_texts_are_known_by_their_place() -> None:
    """Their makers give many webcams one name and one serial number."""
    with unopened(plugged=False) as bench:
        for number in range(2):
            usb = ("32e4", "9422", "HD USB Camera")
            bench.computer.camera(number, "HD USB Camera", serial="01.00.00", usb_port=f"1-{number}", usb=usb)
        bench.computer.camera(2, "HD Webcam", serial="01.00.00", usb_port="1-2", usb=("046d", "0825", "HD Webcam"))
        assert [camera.stable for camera in bench.context.computer.cameras()] == [
            "/dev/v4l/by-path/usb-1-0-video-index0",
            "/dev/v4l/by-path/usb-1-1-video-index0",
            "/dev/v4l/by-id/usb-HD_Webcam-video-index0",
        ]
