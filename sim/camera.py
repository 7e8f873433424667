"""The simulated camera: a UVC device with the interface of `cv2.VideoCapture` that sees the simulated platter."""

from collections import deque
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache, partial
from math import ceil, cos, radians, sin
from threading import get_ident
from typing import Any
from zlib import crc32

import cv2
import numpy as np
from numpy.typing import NDArray

from hbr.drawing.bench import Visit
from hbr.drawing.noise import Noise
from rig.devices import v4l2
from rig.devices.camera import Capture
from sim.calibration_board import BoardOnPlatter
from sim.camera_controls import BUFFERS_RANGE, EXPOSURE_RANGE, KELVIN_RANGE, NOMINAL_EXPOSURE, SHARP_AT, Controls
from sim.frame_times import FPS, FrameTimes, bands, frame_after, row_weights, start_ns
from sim.noise import NoiseModel
from sim.objects.projection import CENTRE_PX, HEIGHT, PX_PER_MM, WIDTH, Image
from sim.objects.solid import empty_platter
from sim.optics import Optics
from sim.room import relight, room
from sim.sensor import STRIP, Sensor
from sim.world import HISTORY_S, Activity, Scene, World

CAMERA_DEVICE = "simulated camera"
"""Identity of the camera of a simulated bench; a bench has one camera."""
READOUT_NS = 15_000_000  # time from the end of the exposure until the computer has the frame
SELECT_S = 10.0  # how long OpenCV's V4L2 backend waits for a frame (OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT)

_FOCUS_STEP = 15  # distance by which the autofocus moves the lens between two measurements
_FOURCCS = ("MJPG", "YUYV")  # MJPG has no errors of compression
_NO_CONTROLS = (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT, cv2.CAP_PROP_FPS, cv2.CAP_PROP_POS_MSEC)
"""Properties that OpenCV answers without asking the camera."""
_REMEMBERED = (
    *(cv2.CAP_PROP_GAIN, cv2.CAP_PROP_SHARPNESS, cv2.CAP_PROP_BACKLIGHT),
    *(v4l2.POWER_LINE_FREQUENCY, v4l2.EXPOSURE_DYNAMIC_FRAMERATE),
)
"""Controls that change by themselves although the camera does not report it; the driver reads them once."""


_METER_FRAMES = 5  # number of frames between two changes of the automatic settings
_METER_TARGET = 70.0
_EDGE_PX_PER_DEG = radians(1.0) * 80 * PX_PER_MM  # motion in the image of a point 80 mm from the axis
_STILL_PX = 0.25
_MAX_SUBFRAMES = 16  # more: smoother smear of fast motion, at one drawn image each


class SimCapture(Capture):
    """A simulated `cv2.VideoCapture` on the world's clock.

    Frame k is stamped k / 30 s. Its exposure begins before, by the errors of `sim.frame_times`, and row by row (rolling
    shutter). The frame arrives `READOUT_NS` and a delay of the USB after an exposure from its stamp. As in V4L2, up to
    four frames wait in buffers; while the buffers are full, new frames are lost. A frame is drawn when it is retrieved,
    from the world's state at its exposure, so dropped frames take no time and change nothing. The width selects one of
    two modes: the size of the backdrop (640x480), and half of it. Properties have the units of OpenCV's V4L2 backend;
    for an unknown property `set` returns False and `get` -1. As on V4L2, `isOpened` stays True after an unplug, while
    `grab` fails. The camera begins with the focus that an earlier program left; plugged in again, it wakes out of focus
    with its autofocus on.
    """

    def __init__(self, world: World, backdrop: Image | None = None) -> None:
        self.remembers = True
        """Whether the driver remembers controls that it has set or asked for once, as ``uvcvideo`` does. A gain that
        the camera changes by itself is not read back then."""
        self._remembered: dict[int, float] = {}
        self.every = 1
        """The camera exposes one of this many frames: more than 1 for a slow camera."""
        self.latency_ns = 0
        """Additional delay of each frame."""
        self.grab_failures: list[Callable[[], bool]] = []
        """Called at each `grab`; True makes it fail."""
        self.hangs = False
        """Whether no frame arrives; `grab` fails after `SELECT_S`."""
        self.orbits = False
        """Whether the table moves the camera around the object instead of rotating the object. The camera then sees the
        room around the object (`sim.room`), and the light stays in the room."""
        self.blur_px = 0.0
        """Sigma of an additional blur."""
        self.noise = Noise(world.noise.gaussian_variance, world.noise.motion_px)
        """The paper's motion blur and Gaussian noise of each frame, in addition to the sensor's own noise."""
        self.lamp: tuple[float, float] | None = None
        """Frequency in Hz and depth of the light's flicker, which leaves bands because rows are read out one after the
        other; None for a steady light."""
        self.visit: Visit | None = None
        """A hard change of the bench, through which everything is seen (`sim.change`)."""
        self.filters: list[Callable[[Image, int], Image]] = []
        """Called in order with each fetched frame and its number; each returns a frame."""
        self._world = world
        self._clock = world.clock
        self._binning = 1
        self._fourcc = _FOURCCS[0]
        self._noise = world.noise
        self.times = FrameTimes(world)
        """The errors of its time."""
        self.stamp_shift_ns = 0
        """Jump of the time stamps by a fault."""
        self._draws_bench = backdrop is None
        self.backdrop = empty_platter() if backdrop is None else backdrop
        """What is behind the objects: wall, table and platter, uint8 (480, 640, 3), or another ground of any size for
        objects that fill the frame. Such frames do not depend on the camera's mounting and on its orbit."""
        self._height, self._width = self.backdrop.shape[:2]
        # A well-mounted camera sees the objects as they are drawn; calibration boards are drawn through its lens.
        self._moved = Optics.of(world).from_drawn() if world.noise.camera_mount and self._draws_bench else None
        self._open = self._plugged = True
        self._lost = False
        self._plugs = 1
        self._queue: deque[int] = deque()
        self._next = frame_after(self._clock.now_ns())
        self._grabbed: int | None = None
        self._controls: list[tuple[int, Controls]] = [(self._clock.now_ns(), Controls())]
        self._metered = self._next

    # -- for tests and faults ---------------------------------------------------------------------------------------

    def unplug(self) -> None:
        """Unplug the camera: no frame arrives any more."""
        self._plugged, self._lost = False, True

    def replug(self) -> None:
        """Plug the camera in; it must be opened again, and has the settings of its power-up."""
        if not self._plugged:
            self._plugged = True
            self._plugs += 1
            self._remembered.clear()
            self._change(self._clock.now_ns(), Controls(autofocus=True, focus=0))

    def node(self) -> tuple[int, ...] | None:
        """Return the identity of its device file until it is unplugged; None while it is unplugged."""
        return (self._plugs,) if self._plugged else None

    def reopen(self) -> bool:
        """Open the stream again with the same settings; return whether the camera is plugged in."""
        if self._plugged and (self._lost or not self._open):
            self._queue.clear()
            self._next = self._exposed_from(frame_after(self._clock.now_ns()))
            self._open, self._lost = True, False
        return self._plugged

    @property
    def controls(self) -> Controls:
        """The settings in force."""
        return self._controls[-1][1]

    def drift(self, **values: Any) -> None:
        """Change settings (fields of `Controls`) although they are locked, as a faulty camera does."""
        self._change(self._clock.now_ns(), replace(self.controls, **values))

    # -- interface of cv2.VideoCapture --------------------------------------------------------------------------------

    def modes(self) -> tuple[v4l2.VideoMode, ...]:
        """Return the modes that the camera offers."""
        sizes = [(self._width // n, self._height // n) for n in (1, 2)]
        return tuple(v4l2.VideoMode(fourcc, *size, float(FPS)) for fourcc in _FOURCCS for size in sizes)

    def isOpened(self) -> bool:  # noqa: N802
        return self._open

    def release(self) -> None:
        self._open = False

    @property
    def _delivers(self) -> bool:
        return self._open and not self._lost

    def read(self) -> tuple[bool, Image | None]:
        return self.retrieve() if self.grab() else (False, None)

    def grab(self) -> bool:
        """Take the oldest waiting frame, or wait for the next one."""
        if not self._delivers or any(fails() for fails in self.grab_failures):
            return False
        self._receive()
        if self.hangs and not self._queue:
            self._clock.sleep(SELECT_S)
            return False
        while not self._queue:
            self._clock.advance_to(self._arrival_ns(self._next))
            self._receive()
        self._grabbed = self._queue.popleft()
        return True

    def wait_ns(self) -> int:
        """Return the time that `grab` would wait for a frame that is on its way."""
        self._receive()
        if not self._delivers or self._queue:
            return 0
        if self.hangs:
            return round(SELECT_S * 1e9)
        return max(self._arrival_ns(self._next) - self._clock.now_ns(), 0)

    def wait(self, seconds: float) -> bool:
        """Wait for a frame for at most this time; return whether `grab` then returns at once."""
        self._clock.advance_to(self._clock.now_ns() + min(self.wait_ns(), round(seconds * 1e9)))
        return not self.wait_ns()

    def retrieve(self) -> tuple[bool, Image | None]:
        """Return the frame that was grabbed last, uint8 (height, width, 3)."""
        if self._grabbed is None or not self._delivers:
            return False, None
        self._world.notify(Activity.FRAME_FETCHED)
        image = self._frame(self._grabbed)
        for tamper in self.filters:
            image = tamper(image, self._grabbed)
        return True, image

    def get(self, prop: int) -> float:
        self._meter()
        values: dict[int, float] = {
            cv2.CAP_PROP_FRAME_WIDTH: self._width // self._binning,
            cv2.CAP_PROP_FRAME_HEIGHT: self._height // self._binning,
            cv2.CAP_PROP_FPS: FPS,
            cv2.CAP_PROP_FOURCC: v4l2.fourcc_number(self._fourcc),
            cv2.CAP_PROP_POS_MSEC: 0.0 if self._grabbed is None else self._stamp_ns(self._grabbed) * 1e-6,
            **self.controls.values,
        }
        if self._lost and prop not in _NO_CONTROLS:
            return -1.0
        value = float(values.get(prop, -1.0))
        return self._remembered.setdefault(prop, value) if self.remembers and prop in _REMEMBERED else value

    def set(self, prop: int, value: float) -> bool:
        """Change a setting for later frames; return False for settings that the camera controls automatically."""
        self._meter()
        now = self.controls
        match prop:
            case cv2.CAP_PROP_FOURCC if value in {v4l2.fourcc_number(fourcc) for fourcc in _FOURCCS}:
                self._fourcc = int(value).to_bytes(4, "little").decode("ascii")
            case cv2.CAP_PROP_FRAME_WIDTH if value in (self._width, self._width // 2):
                self._binning = 1 if value == self._width else 2
            case cv2.CAP_PROP_FRAME_WIDTH | cv2.CAP_PROP_FRAME_HEIGHT | cv2.CAP_PROP_FPS:
                return value == self.get(prop)
            case cv2.CAP_PROP_BUFFERSIZE if BUFFERS_RANGE[0] <= value <= BUFFERS_RANGE[1]:
                self._queue.clear()  # OpenCV frees its buffers and starts the stream again
                self._next = frame_after(self._clock.now_ns())
                now = replace(now, buffers=int(value))
            case _:
                changed = now.with_value(prop, value)
                if changed is None:
                    return False
                now = changed
        self._change(self._clock.now_ns(), now)
        self._remembered.pop(prop, None)
        return True

    # -- time ---------------------------------------------------------------------------------------------------------

    def _receive(self) -> None:
        """Queue the frames that have arrived while there is room; the others are lost."""
        self._meter()
        now_ns = self._clock.now_ns()
        room = self.controls.buffers
        if self.hangs:
            self._next = max(self._next, self._exposed_from(frame_after(now_ns)))
        while len(self._queue) < room and self._arrival_ns(self._next) <= now_ns:
            self._queue.append(self._next)
            self._next = self._exposed_from(self._next + 1)
        if len(self._queue) == room:
            self._next = max(self._next, self._exposed_from(frame_after(now_ns - self.latency_ns) - 2))
            while self._arrival_ns(self._next) <= now_ns:
                self._next = self._exposed_from(self._next + 1)

    def _exposed_from(self, frame: int) -> int:
        """Return the number of the next exposed frame that is not lost, ``frame`` or later."""
        frame = -(-frame // self.every) * self.every
        while self.times.is_lost(frame):
            frame += self.every
        return frame

    def _stamp_ns(self, frame: int) -> int:
        return start_ns(frame) + self.stamp_shift_ns + self.times.stamp_error_ns(frame)

    def _arrival_ns(self, frame: int) -> int:
        start = start_ns(frame)
        return start + self._controls_at(start).exposure_ns + READOUT_NS + self.times.late_ns(frame) + self.latency_ns

    def _controls_at(self, time_ns: int) -> Controls:
        return next((c for since, c in reversed(self._controls) if since <= time_ns), self._controls[0][1])

    def _change(self, time_ns: int, controls: Controls) -> None:
        self._controls.append((time_ns, controls))
        horizon = self._clock.now_ns() - round(HISTORY_S * 1e9)
        while len(self._controls) > 1 and self._controls[1][0] <= horizon:
            del self._controls[0]

    # -- light --------------------------------------------------------------------------------------------------------

    def _frame(self, frame: int) -> Image:
        start = start_ns(frame)
        controls = self._controls_at(start)
        exposed = self.times.exposed_ns(start, frame)
        scene = self._world.scene_at(exposed)
        seen = self._exposed(scene, exposed, controls.exposure_ns)
        blur = max(abs(controls.focus - SHARP_AT) * 0.04, self.blur_px)
        if blur > 0.1:
            seen = np.asarray(cv2.GaussianBlur(seen, (0, 0), blur), dtype=np.float32)
        if self.lamp is not None:
            seen = np.asarray(
                seen * bands(*self.lamp, start, controls.exposure_ns, self.times.readout_ns, self._height),
                dtype=np.float32,
            )
        rng = np.random.default_rng([self._world.seed, crc32(b"camera frame"), frame])
        image = _sensor(self._noise, self._world.seed, self._binning, (self._width, self._height), get_ident()).expose(
            seen,
            light=scene.light,
            exposure=controls.exposure / NOMINAL_EXPOSURE,
            gains=controls.gains,
            rng=rng,
        )
        return self.noise.apply(image, rng)

    def _exposed(self, scene: Scene, start: int, exposure: int) -> NDArray[np.uint8] | NDArray[np.float32]:
        """Return the light that the rows collect: all are exposed equally long, the last `FrameTimes.readout_ns` later.

        At rest this is one image, otherwise a mean of images in steps of a pixel of motion in the present mode.
        """
        readout = self.times.readout_ns
        angles = self._world.table_angles(start + np.linspace(0, exposure + readout, 9).astype(np.int64))
        path_px = np.abs(np.diff(angles)).sum() * _EDGE_PX_PER_DEG
        if path_px < _STILL_PX:
            return self._picture(scene, float(angles[0]))
        n = min(1 + max(ceil(path_px / self._binning), 1), _MAX_SUBFRAMES * (1 + readout // max(exposure, 1)))
        steps, weights = row_weights(exposure, readout, n, self._height)
        seen = np.zeros((self._height, self._width, 3), dtype=np.float32)
        for angle, weight in zip(self._world.table_angles(start + steps.astype(np.int64)), weights, strict=True):
            exposed = np.flatnonzero(weight)
            if len(exposed):
                rows = int(exposed[0]), int(exposed[-1]) + 1
                picture = self._picture(scene, float(angle), rows)
                for top in range(*rows, STRIP):
                    part = slice(top, min(top + STRIP, rows[1]))
                    seen[part] += picture[part] * weight[part, None, None]
        return seen

    def _picture(self, scene: Scene, table_deg: float, rows: tuple[int, int] = (0, HEIGHT)) -> Image:
        """Return the image of a scene under nominal light; only the ``rows`` need to be right."""
        image = self._without_mark(scene, table_deg, rows)
        if isinstance(scene.mark, BoardOnPlatter):  # it stands in front of the object while it faces the camera
            scene.mark.draw(image, -table_deg if self.orbits else table_deg, rows=rows)
        return image

    def _without_mark(self, scene: Scene, table_deg: float, rows: tuple[int, int]) -> Image:
        table_deg = -table_deg if self.orbits else table_deg
        in_room = self.orbits and self._draws_bench
        empty = room(self._world.seed, table_deg) if in_room else self.backdrop
        image = empty.copy()
        if scene.object is None:
            return self._as_mounted(image if self.visit is None else seen_on_visit(self.visit, None, table_deg))
        x, y = scene.offset_mm
        c, s = cos(radians(table_deg)), sin(radians(table_deg))
        offset_mm = c * x - s * y, s * x + c * y
        if self.visit is not None and not isinstance(scene.object, BoardOnPlatter):
            drawn = partial(scene.object.draw, azimuth_deg=table_deg + scene.yaw_deg, offset_mm=offset_mm)
            return self._as_mounted(seen_on_visit(self.visit, drawn, table_deg))
        if isinstance(scene.object, BoardOnPlatter):
            scene.object.draw(image, table_deg + scene.yaw_deg, offset_mm, rows)
            return image
        scene.object.draw(image, table_deg + scene.yaw_deg, offset_mm)
        if in_room:
            relight(image, empty, table_deg)
        return self._as_mounted(image)

    def _as_mounted(self, image: Image) -> Image:
        """Return the drawn image as the camera sees it from its mounting position."""
        if self._moved is None:
            return image
        seen = cv2.warpPerspective(image, self._moved, (WIDTH, HEIGHT), borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(seen, dtype=np.uint8)

    def _meter(self) -> None:
        """Apply the automatic settings to the frames since the last call.

        Automatic exposure changes the mean brightness towards a target. Automatic white balance makes the means of red
        and blue equal (the grey world), for objects of any colour.
        """
        now_ns = self._clock.now_ns()
        self._metered = max(self._metered, frame_after(now_ns - round(HISTORY_S * 1e9)))
        while start_ns(self._metered + _METER_FRAMES) <= now_ns:
            self._metered += _METER_FRAMES
            time_ns = start_ns(self._metered)
            controls = self.controls
            if controls.autofocus and controls.focus != SHARP_AT:
                step = min(max(SHARP_AT - controls.focus, -_FOCUS_STEP), _FOCUS_STEP)
                controls = replace(controls, focus=controls.focus + step)
                self._change(time_ns, controls)
            if not (controls.auto_exposure or controls.auto_white_balance):
                continue
            scene = self._world.scene_at(time_ns)
            mean = np.array(cv2.mean(self._picture(scene, self._world.table_deg(time_ns)))[:3])
            mean *= np.array(scene.light) * controls.gains * controls.exposure / NOMINAL_EXPOSURE
            if controls.auto_exposure:
                factor = np.clip(_METER_TARGET / max(mean.mean(), 1e-3), 0.25, 4.0) ** 0.5
                controls = replace(controls, exposure=float(np.clip(controls.exposure * factor, *EXPOSURE_RANGE)))
            if controls.auto_white_balance and mean.min() > 0:
                factor = (mean[0] / mean[2]) ** 0.3
                controls = replace(controls, kelvin=float(np.clip(controls.kelvin * factor, *KELVIN_RANGE)))
            self._change(time_ns, controls)


@lru_cache(maxsize=4)
def _sensor(noise: NoiseModel, seed: int, binning: int, size: tuple[int, int], _thread: int) -> Sensor:
    """Return the sensor of a world, built for the first frame and shared by all benches of that world in a thread."""
    return Sensor(noise, np.random.default_rng([seed, crc32(b"camera")]), binning, size)


_GROUNDS = (24, 232)  # dark and bright, but not clipped: a shadow still changes both
_OPAQUE = 104  # an object's pixels differ by less on the two grounds; those of its soft shadow by more


# -- after a hard change of the bench: the drawn object on a bench of `rig eval` ---------------------------------------


def seen_on_visit(visit: Visit, draw: Callable[[Image], None] | None, table_deg: float) -> Image:
    """Return the camera's image under nominal light, uint8 (480, 640, 3); without an object, the empty table.

    The object is cut out by drawing it on a dark and on a bright ground. The bench is drawn at half the size.
    """
    if draw is None:
        seen = visit.empty(table_deg)
    else:
        dark, bright = (np.full((HEIGHT, WIDTH, 3), level, np.uint8) for level in _GROUNDS)
        draw(dark)
        draw(bright)
        mask = np.max(cv2.absdiff(dark, bright), axis=2) < _OPAQUE
        foot_px = float(CENTRE_PX[0]), float(CENTRE_PX[1])
        seen = visit.photograph(dark, mask, table_deg, foot_px=foot_px, px_per_px=0.5).image
    return np.asarray(cv2.resize(seen, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC), dtype=np.uint8)
