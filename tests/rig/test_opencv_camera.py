"""The OpenCV camera driver: settings, choosing frames by their time, and what it says when a camera fails."""

import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import cv2
import numpy as np
import pytest

from rig.clock import SystemClock
from rig.devices.opencv_camera import CameraSettings, OpenCvCamera, TimeBase, open_capture
from rig.errors import DeviceFault, DeviceNotFound, DeviceSilent
from sim.camera import FPS, SimCapture
from sim.noise import NoiseModel
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


@pytest.fixture
def world() -> World:
    world = World(noise=NoiseModel.none())
    world.put(shelf()["teapot"])
    world.clock.sleep(100.0)
    return world


# -- settings ---------------------------------------------------------------------------------------------------------


def test_the_settings_are_locked_and_read_back(world: World) -> None:
    settings = CameraSettings(exposure_us=8000, gain=3, white_balance_k=4200, focus=100)
    camera = OpenCvCamera(SimCapture(world), clock=world.clock, settings=settings, name="desk camera")
    assert camera.not_taken == ()
    locks = camera.read_locks()
    assert (locks.exposure_us, locks.gain, locks.white_balance_k) == (8000, 3, 4200)
    assert (locks.auto_exposure, locks.auto_white_balance) == (False, False)
    identity = camera.identity
    assert (identity.name, identity.width, identity.height, identity.fps) == ("desk camera", 640, 480, 30)
    world.clock.sleep(20)
    assert camera.read_locks() == locks


def test_what_is_left_to_the_camera_stays_automatic(world: World) -> None:
    settings = CameraSettings(exposure_us=None, gain=None, white_balance_k=None)
    camera = OpenCvCamera(SimCapture(world), clock=world.clock, settings=settings)
    before = camera.read_locks()
    assert (before.auto_exposure, before.exposure_us is None) == (True, False)
    world.put(shelf()["candle"])
    world.clock.sleep(5)
    assert camera.read_locks().exposure_us != before.exposure_us


def test_a_setting_that_the_camera_does_not_take_is_reported(world: World) -> None:
    settings = CameraSettings(width=1920, exposure_us=90_000, gain=99)
    camera = OpenCvCamera(SimCapture(world), clock=world.clock, settings=settings)
    assert {(n.setting, n.asked, n.reported) for n in camera.not_taken} == {
        ("width", 1920, 640),
        ("exposure_100us", 900, 333),
        ("gain", 99, 24),
    }
    assert camera.identity.width == 640
    assert camera.read_locks().gain == 24


def test_a_drifting_lock_shows(world: World) -> None:
    capture = SimCapture(world)
    camera = OpenCvCamera(capture, clock=world.clock)
    capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, 3)  # another program, a camera that was plugged in again
    assert camera.read_locks().auto_exposure is True


@pytest.mark.parametrize("field", ["width", "height", "fps", "exposure_us", "white_balance_k"])
def test_impossible_settings_are_refused(field: str) -> None:
    for value in (0, -1, float("nan"), float("inf")):
        with pytest.raises(ValueError, match=field):
            CameraSettings(**{field: value})


# -- which frame ------------------------------------------------------------------------------------------------------


def test_stale_frames_are_dropped_by_their_stamps(world: World) -> None:
    camera = OpenCvCamera(SimCapture(world), clock=world.clock)
    assert camera.time_base is TimeBase.STAMPED
    for pause_s in (0.0, 0.01, 0.1, 3.0):
        world.clock.sleep(pause_s)
        after_ns = world.clock.now_ns()
        frame = camera.capture(after_ns)
        assert after_ns <= frame.exposed_ns < after_ns + PERIOD_NS + 2000  # the first one, not just any new one


def test_a_frame_of_the_future_is_waited_for(world: World) -> None:
    camera = OpenCvCamera(SimCapture(world), clock=world.clock)
    after_ns = world.clock.now_ns() + 700_000_000
    assert after_ns <= camera.capture(after_ns).exposed_ns < after_ns + PERIOD_NS + 2000


@pytest.mark.parametrize(
    ("offset_ms", "factor"),
    [(1.7e12, 1.0), (-100_000.0, 1.0), (0.0, 0.0), (0.0, 1000.0)],
    ids=["time of day", "since the stream began", "no stamps", "microseconds"],
)
def test_without_stamps_only_frames_that_had_to_be_waited_for_count(
    world: World, offset_ms: float, factor: float
) -> None:
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


def test_the_image_is_the_one_of_the_stamp(world: World) -> None:
    camera = OpenCvCamera(SimCapture(world), clock=world.clock)
    teapot = camera.capture(world.clock.now_ns()).image_bgr
    world.put(shelf()["dice"])
    dice = camera.capture(world.clock.now_ns()).image_bgr
    assert teapot.shape == dice.shape == (480, 640, 3)
    assert (teapot != dice).mean() > 0.05


# -- failures ---------------------------------------------------------------------------------------------------------


def test_an_unplugged_camera_is_silent(world: World) -> None:
    capture = SimCapture(world)
    camera = OpenCvCamera(capture, clock=world.clock, name="desk camera")
    capture.unplug()
    with pytest.raises(DeviceSilent, match="desk camera") as error:
        camera.capture(world.clock.now_ns())
    assert "cable" in error.value.next_step
    with pytest.raises(DeviceSilent):
        OpenCvCamera(capture, clock=world.clock)


class Lagging(SimCapture):
    """Falls behind when told so: its frames keep coming, each hardly younger than the one before."""

    stuck_at_ms: float | None = None

    def get(self, prop: int) -> float:
        if prop == cv2.CAP_PROP_POS_MSEC and self.stuck_at_ms is not None:
            self.stuck_at_ms += 0.001
            return self.stuck_at_ms
        return super().get(prop)


def test_a_camera_that_shows_only_the_past_times_out(world: World) -> None:
    capture = Lagging(world)
    camera = OpenCvCamera(capture, clock=world.clock, timeout_s=1.5)
    capture.stuck_at_ms = capture.get(cv2.CAP_PROP_POS_MSEC)
    asked_ns = world.clock.now_ns()
    with pytest.raises(DeviceSilent, match=r"no new frame in 1\.5 s") as error:
        camera.capture(asked_ns)
    assert error.value.evidence["dropped_frames"] == pytest.approx(1.5 * FPS, abs=3)
    assert world.clock.now_ns() - asked_ns == pytest.approx(1.5e9, abs=2 * PERIOD_NS)


def test_stamps_that_fall_back_are_trusted_no_more(world: World) -> None:
    capture = ForeignStamps(world, 0.0)
    camera = OpenCvCamera(capture, clock=world.clock)
    assert camera.time_base is TimeBase.STAMPED
    capture._offset_ms = -60_000.0
    after_ns = world.clock.now_ns()
    assert camera.capture(after_ns).exposed_ns >= after_ns
    assert camera.time_base is TimeBase.PACED


def test_a_picture_that_is_not_colour_is_refused(world: World) -> None:
    class Raw(SimCapture):
        def retrieve(self) -> tuple[bool, np.ndarray | None]:
            ok, image = super().retrieve()
            return ok, None if image is None else image[..., 0]

    with pytest.raises(DeviceFault, match=r"\(480, 640\)"):
        OpenCvCamera(Raw(world), clock=world.clock).capture(0)


def test_a_frame_that_cannot_be_decoded_is_reported(world: World) -> None:
    class Torn(SimCapture):
        def retrieve(self) -> tuple[bool, None]:
            return False, None

    with pytest.raises(DeviceSilent, match="decoding"):
        OpenCvCamera(Torn(world), clock=world.clock).capture(0)


def test_opening_says_what_is_wrong(tmp_path: Path) -> None:
    with pytest.raises(DeviceNotFound, match="no camera /dev/video97") as error:
        open_capture(97)
    assert "connect" in error.value.next_step
    with pytest.raises(DeviceNotFound, match="missing"):
        open_capture(tmp_path / "missing.avi")


@pytest.mark.skipif(not Path("/dev/null").exists(), reason="no device files on this system")
def test_a_device_that_is_no_camera_cannot_be_opened() -> None:
    with pytest.raises(DeviceNotFound, match="cannot open /dev/null"):
        open_capture("/dev/null")


# -- recordings and streams -------------------------------------------------------------------------------------------


def test_a_recording_is_read_frame_by_frame_to_its_end(tmp_path: Path, world: World) -> None:
    levels = (10, 90, 170)
    for k, level in enumerate(levels):
        cv2.imwrite(str(tmp_path / f"img_{k:02d}.png"), np.full((48, 64, 3), level, np.uint8))
    camera = OpenCvCamera(open_capture(tmp_path / "img_%02d.png"), clock=world.clock)
    assert camera.time_base is TimeBase.RECORDED
    assert "exposure_100us" in {n.setting for n in camera.not_taken}
    assert camera.read_locks().exposure_us is None
    for level in levels:
        after_ns = world.clock.now_ns() + 1000
        frame = camera.capture(after_ns)
        assert frame.exposed_ns >= after_ns
        assert (frame.image_bgr == level).all()
    with pytest.raises(DeviceSilent) as error:
        camera.capture(world.clock.now_ns())
    assert "end" in error.value.next_step


@pytest.fixture
def stream() -> Iterator[tuple[str, list[float]]]:
    """An MJPEG stream on the loopback whose brightness can be set: the one source here that runs in real time."""
    level, stop = [40.0], threading.Event()

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
            self.end_headers()
            while not stop.wait(1 / 30):
                ok, jpeg = cv2.imencode(".jpg", np.full((120, 160, 3), int(level[0]), np.uint8))
                assert ok
                try:
                    self.wfile.write(b"--frame\r\nContent-Type: image/jpeg\r\n\r\n" + jpeg.tobytes() + b"\r\n")
                except OSError:
                    return

        def log_message(self, format: str, *args: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}/video", level
    stop.set()
    server.shutdown()
    server.server_close()


def test_a_network_stream_shows_the_present_after_a_pause(stream: tuple[str, list[float]]) -> None:
    url, level = stream
    clock = SystemClock()
    settings = CameraSettings(None, None, None, None, None, None)
    # The latency leaves a busy machine time to drain what piled up before a stall can pass for waiting.
    camera = OpenCvCamera(open_capture(url), clock=clock, settings=settings, timeout_s=20.0, latency_s=0.4)
    try:
        assert camera.time_base is TimeBase.PACED
        clock.sleep(0.5)  # frames pile up in the socket
        level[0] = 200.0
        frame = camera.capture(clock.now_ns())
        assert frame.image_bgr.mean() == pytest.approx(200, abs=3)
        assert frame.exposed_ns <= clock.now_ns()
    finally:
        camera.close()
