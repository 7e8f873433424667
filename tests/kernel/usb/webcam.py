"""A played webcam with the identity of a Logitech C920, for the driver ``uvcvideo``.

Sources: USB Device Class Definition for Video Devices 1.0 (descriptors: 3.7 and 3.9; requests: 4.2 and 4.3), and the
class's definitions of the payload formats.
"""

import struct
from copy import copy
from dataclasses import dataclass
from enum import IntEnum
from threading import Event, Thread
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from rig.core.clock import SystemClock
from rig.devices import v4l2
from sim.camera import SimCapture
from sim.camera_controls import V4L2_EXPOSURE_APERTURE_PRIORITY, V4L2_EXPOSURE_MANUAL
from sim.frame_times import FPS
from sim.objects.projection import HEIGHT, WIDTH
from sim.realtime.pace import RealTime
from sim.world import Activity
from tests.kernel.usb.descriptors import BULK, Identity, configuration, endpoint, interface
from tests.kernel.usb.device import Request, UsbDevice
from tests.kernel.usb.usbip import Stall

STREAM: Final = 1
"""Number of the endpoint of the images."""
PAYLOAD_BYTES: Final = 16_384
HEADER_BYTES: Final = 12
CLOCK_HZ: Final = 30_000_000
LONGEST_WAIT_S: Final = 0.05
EVERY: Final = 5
"""The camera exposes one of this many frames, because an emulated processor does not process more."""

_CAMERA_UNIT, _PROCESSING_UNIT, _OUTPUT = 1, 2, 3
_VIDEO, _CONTROL_INTERFACE, _STREAM_INTERFACE = 14, 1, 2
_CLASS_INTERFACE = 0x24
_JPEG_QUALITY = 90


class Setting(IntEnum):
    """Requests for a setting of the camera."""

    SET = 0x01
    NOW = 0x81
    LEAST = 0x82
    MOST = 0x83
    STEP = 0x84
    SIZE = 0x85
    ABILITIES = 0x86
    FACTORY = 0x87


class Format(IntEnum):
    """Formats of the images, by their index in the descriptors."""

    YUYV = 1
    MJPG = 2


@dataclass(frozen=True, slots=True)
class Control:
    """A control of the camera as UVC shows it, and the property of `SimCapture` behind it."""

    size: int
    least: int
    most: int
    factory: int
    property: int
    step: int = 1
    changes: bool = False
    """The camera may change it by itself, and says that (bit 3 of the abilities): the driver does not remember it."""

    def now(self, camera: SimCapture) -> int:
        return round(camera.get(self.property))

    def set(self, camera: SimCapture, value: int) -> bool:
        return camera.set(self.property, value)


class ExposureMode(Control):
    """The mode of the exposure: bits in UVC, numbers in V4L2; its step lists the possible bits."""

    _MANUAL, _APERTURE_PRIORITY = 1, 8

    def now(self, camera: SimCapture) -> int:
        manual = camera.get(self.property) == V4L2_EXPOSURE_MANUAL
        return self._MANUAL if manual else self._APERTURE_PRIORITY

    def set(self, camera: SimCapture, value: int) -> bool:
        mode = {self._MANUAL: V4L2_EXPOSURE_MANUAL, self._APERTURE_PRIORITY: V4L2_EXPOSURE_APERTURE_PRIORITY}.get(value)
        return mode is not None and camera.set(self.property, mode)


CONTROLS: Final[dict[tuple[int, int], Control]] = {
    (_CAMERA_UNIT, 0x02): ExposureMode(1, 0, 0, 8, cv2.CAP_PROP_AUTO_EXPOSURE, step=0b1001),
    (_CAMERA_UNIT, 0x03): Control(1, 0, 1, 1, v4l2.EXPOSURE_DYNAMIC_FRAMERATE),
    (_CAMERA_UNIT, 0x04): Control(4, 1, 333, 100, cv2.CAP_PROP_EXPOSURE, changes=True),
    (_CAMERA_UNIT, 0x06): Control(2, 0, 255, 0, cv2.CAP_PROP_FOCUS, changes=True),
    (_CAMERA_UNIT, 0x08): Control(1, 0, 1, 1, cv2.CAP_PROP_AUTOFOCUS),
    (_PROCESSING_UNIT, 0x01): Control(2, 0, 1, 0, cv2.CAP_PROP_BACKLIGHT),
    (_PROCESSING_UNIT, 0x04): Control(2, 0, 24, 0, cv2.CAP_PROP_GAIN),
    (_PROCESSING_UNIT, 0x05): Control(1, 0, 2, 2, v4l2.POWER_LINE_FREQUENCY),
    (_PROCESSING_UNIT, 0x08): Control(2, 0, 255, 3, cv2.CAP_PROP_SHARPNESS),
    (_PROCESSING_UNIT, 0x0A): Control(2, 2800, 6500, 4600, cv2.CAP_PROP_WB_TEMPERATURE, changes=True),
    (_PROCESSING_UNIT, 0x0B): Control(1, 0, 1, 1, cv2.CAP_PROP_AUTO_WB),
}
"""The controls by unit and selector; the units' descriptors list them as bits."""
_CAMERA_BITS, _PROCESSING_BITS = 0b10_0000_0000_0010_1110, 0b1_0111_0101_0000
SIZES: Final = ((WIDTH, HEIGHT), (WIDTH // 2, HEIGHT // 2))
"""Width and height of each mode, by the index of its descriptor minus one."""
_INTERVALS = (10_000_000 // FPS, 20_000_000 // FPS, 10_000_000 // 5)
_YUYV_GUID = bytes.fromhex("5955593200001000800000aa00389b71")


def video_configuration() -> bytes:
    """Return the configuration: a camera, its processing unit, and a stream in two formats and two sizes."""
    return configuration(
        [
            struct.pack("8B", 8, 11, 0, 2, _VIDEO, 3, 0, 0),  # both interfaces belong together
            interface(0, (_VIDEO, _CONTROL_INTERFACE, 0)),
            *_units(),
            interface(1, (_VIDEO, _STREAM_INTERFACE, 0), 1),
            *_formats(),
            endpoint(0x80 | STREAM, BULK, 512),
        ],
        interfaces=2,
        milliamps=500,
    )


def _units() -> list[bytes]:
    camera = struct.pack("<4BH2B3HB", 18, _CLASS_INTERFACE, 2, _CAMERA_UNIT, 0x0201, 0, 0, 0, 0, 0, 3)
    processing = struct.pack("<5BHB", 11, _CLASS_INTERFACE, 5, _PROCESSING_UNIT, _CAMERA_UNIT, 0, 2)
    units = [
        camera + _CAMERA_BITS.to_bytes(3, "little"),
        processing + _PROCESSING_BITS.to_bytes(2, "little") + b"\0",
        struct.pack("<4BH3B", 9, _CLASS_INTERFACE, 3, _OUTPUT, 0x0101, 0, _PROCESSING_UNIT, 0),
    ]
    total = 13 + sum(map(len, units))
    return [struct.pack("<3BHHI2B", 13, _CLASS_INTERFACE, 1, 0x0100, total, CLOCK_HZ, 1, STREAM), *units]


def _formats() -> list[bytes]:
    colours = bytes([6, _CLASS_INTERFACE, 0x0D, 1, 1, 4])
    sizes = len(SIZES)
    yuyv = struct.pack("5B", 27, _CLASS_INTERFACE, 4, Format.YUYV, sizes) + _YUYV_GUID + bytes([16, 1, 0, 0, 0, 0])
    mjpg = bytes([11, _CLASS_INTERFACE, 6, Format.MJPG, sizes, 1, 1, 0, 0, 0, 0])
    parts = [yuyv, *_frames(5), colours, mjpg, *_frames(7), colours]
    total = 15 + sum(map(len, parts))
    header = struct.pack(
        "<4BHBBBBBBBBB", 15, _CLASS_INTERFACE, 1, 2, total, 0x80 | STREAM, 0, _OUTPUT, 0, 0, 0, 1, 0, 0
    )
    return [header, *parts]


def _frames(kind: int) -> list[bytes]:
    frames = []
    for index, (width, height) in enumerate(SIZES, 1):
        size, count = 2 * width * height, len(_INTERVALS)
        rates = (size * 8 * 5, size * 8 * FPS)
        frames.append(
            struct.pack("<5BHH", 26 + 4 * count, _CLASS_INTERFACE, kind, index, 0, width, height)
            + struct.pack("<IIIIB", *rates, size, _INTERVALS[0], count)
            + struct.pack(f"<{count}I", *_INTERVALS)
        )
    return frames


class Webcam(UsbDevice):
    """A webcam that sees what a simulated camera sees, in real time.

    ``stopped`` holds the stream in the middle of an image, as a camera does that has crashed.
    """

    identity = Identity(0x046D, 0x082D, 0x0011, "", "HD Pro Webcam C920", "8E2A9F0F", kind=(0xEF, 2, 1))

    def __init__(self, camera: SimCapture, time: RealTime) -> None:
        self.configuration = video_configuration()
        self.stopped = False
        self.frames_sent = 0
        self._camera = camera
        self._time = time
        self._mode = (Format.YUYV, 1, _INTERVALS[0])
        self._streaming = Event()
        self._streams = 0
        self._wanted = Event()
        self._over = False
        self._odd = False
        camera.every = EVERY
        camera.remembers = False  # Linux's driver does
        super().__init__()
        self._streamer = Thread(target=self._stream, name="stream", daemon=True)
        self._streamer.start()

    def close(self) -> None:
        self._over = True
        self._streaming.set()
        self._wanted.set()
        super().close()
        self._streamer.join()

    def plugged(self) -> None:
        with self._time.present():
            self._camera.replug()
            self._camera.reopen()

    def unplugged(self) -> None:
        self._streaming.clear()
        with self._time.present():
            self._camera.unplug()

    def asked(self, endpoint: int) -> None:
        self._wanted.set()

    def halt_cleared(self, endpoint: int) -> None:
        """Stop the stream, because a host ends a stream of bulk transfers in this way."""
        self._streaming.clear()

    # -- requests ---------------------------------------------------------------------------------------------------

    def request(self, request: Request) -> bytes:
        interface, unit, selector = request.index & 0xFF, request.index >> 8, request.value >> 8
        if interface == 1:
            return self._negotiate(request, selector)
        control = CONTROLS.get((unit, selector))
        if control is None:
            raise Stall
        size = control.size
        match request.number:
            case Setting.SET:
                with self._time.present():
                    if not control.set(self._camera, int.from_bytes(request.data[:size], "little")):
                        raise Stall
                return b""
            case Setting.NOW:
                with self._time.present():
                    return control.now(self._camera).to_bytes(size, "little")
            case Setting.SIZE:
                return struct.pack("<H", size)
            case Setting.ABILITIES:
                return b"\x0b" if control.changes else b"\x03"
        values = {
            Setting.LEAST: control.least,
            Setting.MOST: control.most,
            Setting.STEP: control.step,
            Setting.FACTORY: control.factory,
        }
        if request.number not in values:
            raise Stall
        return values[Setting(request.number)].to_bytes(size, "little")

    def _negotiate(self, request: Request, selector: int) -> bytes:
        """Agree on format, size and frame rate (probe), and begin to stream (commit)."""
        match request.number:
            case Setting.SET if len(request.data) >= 8:
                _, form, size, interval = struct.unpack_from("<HBBI", request.data)
                form = Format(form) if form in set(Format) else Format.YUYV
                self._mode = (form, size if 1 <= size <= len(SIZES) else 1, interval or _INTERVALS[0])
                if selector == 2:
                    with self._time.present():
                        self._camera.set(cv2.CAP_PROP_FRAME_WIDTH, SIZES[self._mode[1] - 1][0])
                        while not self._camera.wait_ns() and self._camera.grab():
                            pass  # a webcam has no frames from before the stream
                    self._streams += 1
                    self._streaming.set()
                return b""
            case Setting.ABILITIES:
                return b"\x03"
            case Setting.SIZE:
                return struct.pack("<H", 26)
            case Setting.SET:
                raise Stall
        form, size, interval = self._mode
        width, height = SIZES[size - 1]
        return struct.pack("<HBBI5HII", 1, form, size, interval, 0, 0, 0, 0, 0, 2 * width * height, PAYLOAD_BYTES)

    # -- the stream -------------------------------------------------------------------------------------------------

    def _stream(self) -> None:
        clock = SystemClock()
        while not self._over:
            if not self._streaming.wait(LONGEST_WAIT_S):
                continue
            with self._time.present():
                stream = self._streams
                wait_ns = 1 if self.stopped else self._camera.wait_ns()
                still = None if wait_ns or not self._camera.grab() else still_of(self._camera)
            image = None if still is None else still.retrieve()[1]  # while the world continues
            if image is None:
                clock.sleep(min(max(wait_ns * 1e-9, 0.001), LONGEST_WAIT_S))
                continue
            self._send(encoded(image, self._mode[0]), stream)

    def _send(self, data: bytes, stream: int) -> None:
        """Send an image of a stream in payloads, as the host asks for them; no part of it is sent in the next
        stream."""
        self._odd = not self._odd
        position = 0

        def payload(length: int) -> bytes:
            nonlocal position
            part = data[position : position + min(length, PAYLOAD_BYTES) - HEADER_BYTES]
            position += len(part)
            flags = 0x8C | (2 if position >= len(data) else 0) | self._odd  # end of header, both clocks; end of image
            ticks = self._time.now_ns() * CLOCK_HZ // 1_000_000_000 & 0xFFFF_FFFF
            return struct.pack("<BBIIH", HEADER_BYTES, flags, ticks, ticks, ticks & 0x7FF) + part

        while position < len(data) and self._streaming.is_set() and stream == self._streams and not self._over:
            plug = self.plug
            if plug is None:
                return
            self._wanted.clear()
            if self.stopped or not plug.deliver(STREAM, payload):
                self._wanted.wait(LONGEST_WAIT_S)
        self.frames_sent += position >= len(data)


def encoded(image: NDArray[np.uint8], form: Format) -> bytes:
    """Return an image, uint8 (height, width, 3), in the format of the stream."""
    if form is Format.MJPG:
        return bytes(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1])
    # In YUYV levels reach from 16 to 235 (ITU-R BT.601), in JPEG from 0 to 255.
    return bytes(np.ascontiguousarray(cv2.cvtColor(image, cv2.COLOR_BGR2YUV_YUYV)))


def still_of(camera: SimCapture) -> SimCapture:
    """Return a copy of a camera that shows the grabbed frame at any time, in any thread."""
    camera._world.notify(Activity.FRAME_FETCHED)
    still, world = copy(camera), copy(camera._world)
    world.listeners = []
    world._scenes, world._motions, world._slips = world._scenes[:], world._motions[:], world._slips[:]
    still._world, still._controls = world, camera._controls[:]
    return still
