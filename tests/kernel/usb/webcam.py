"""A played webcam, for the driver ``uvcvideo``: a Logitech C920, or any webcam by its descriptors.

Sources: USB Device Class Definition for Video Devices 1.0 and 1.1 (descriptors: 3.7 and 3.9; requests: 4.2 and 4.3),
and the class's definitions of the payload formats.
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
from sim.camera_controls import KELVIN_RANGE, V4L2_EXPOSURE_APERTURE_PRIORITY, V4L2_EXPOSURE_MANUAL
from sim.frame_times import FPS
from sim.objects.projection import HEIGHT, WIDTH
from sim.realtime.pace import RealTime
from sim.world import Activity
from tests.kernel.usb.descriptors import BULK, Identity, Speed, configuration, endpoint, interface
from tests.kernel.usb.device import Request, UsbDevice
from tests.kernel.usb.usbip import Stall
from tests.kernel.usb.video import (
    CAMERA,
    CLASS_INTERFACE,
    CONTROL,
    HEADER,
    MJPEG,
    PROCESSING,
    STREAM,
    UNCOMPRESSED,
    VIDEO,
    Mode,
    Video,
)

ENDPOINT: Final = 1
"""Number of the C920's endpoint of the images."""
PAYLOAD_BYTES: Final = 16_384
HEADER_BYTES: Final = 12
CLOCK_HZ: Final = 30_000_000
LONGEST_WAIT_S: Final = 0.05
EVERY: Final = 5
"""The camera exposes one of this many frames, because an emulated processor does not process more."""

_CAMERA_UNIT, _PROCESSING_UNIT, _OUTPUT = 1, 2, 3
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

    RAW = 1
    MJPG = 2


@dataclass(frozen=True, slots=True)
class Control:
    """A control of the camera as UVC shows it, and the property of `SimCapture` behind it.

    Without a property it only keeps its value.
    """

    size: int
    least: int
    most: int
    factory: int
    property: int | None = None
    step: int = 1
    changes: bool = False
    """The camera may change it by itself, and says that (bit 3 of the abilities): the driver does not remember it."""

    def now(self, camera: SimCapture) -> int:
        return max(round(camera.get(self.property or 0)), self.least)

    def set(self, camera: SimCapture, value: int) -> bool:
        return camera.set(self.property or 0, value)

    def encoded(self, value: int) -> bytes:
        return (value & (1 << 8 * self.size) - 1).to_bytes(self.size, "little")


class ExposureMode(Control):
    """The mode of the exposure: bits in UVC, numbers in V4L2; its step lists the possible bits."""

    _MANUAL, _APERTURE_PRIORITY = 1, 8

    def now(self, camera: SimCapture) -> int:
        manual = camera.get(cv2.CAP_PROP_AUTO_EXPOSURE) == V4L2_EXPOSURE_MANUAL
        return self._MANUAL if manual else self._APERTURE_PRIORITY

    def set(self, camera: SimCapture, value: int) -> bool:
        mode = {self._MANUAL: V4L2_EXPOSURE_MANUAL, self._APERTURE_PRIORITY: V4L2_EXPOSURE_APERTURE_PRIORITY}.get(value)
        return mode is not None and camera.set(cv2.CAP_PROP_AUTO_EXPOSURE, mode)


_BOTH: Final = 1 << 32 | 1
"""Pan and tilt are two numbers in one control."""
CAMERA_CONTROLS: Final = {
    1: (0x02, ExposureMode(1, 0, 0, 8, cv2.CAP_PROP_AUTO_EXPOSURE, step=0b1001)),
    2: (0x03, Control(1, 0, 1, 1, v4l2.EXPOSURE_DYNAMIC_FRAMERATE)),
    3: (0x04, Control(4, 1, 333, 100, cv2.CAP_PROP_EXPOSURE, changes=True)),
    5: (0x06, Control(2, 0, 255, 0, cv2.CAP_PROP_FOCUS, changes=True)),
    9: (0x0B, Control(2, 100, 500, 100)),  # zoom
    11: (0x0D, Control(8, 0, 36_000 * _BOTH, 0, step=3600 * _BOTH)),
    13: (0x0F, Control(2, -180, 180, 0)),  # roll
    17: (0x08, Control(1, 0, 1, 1, cv2.CAP_PROP_AUTOFOCUS)),
}
PROCESSING_CONTROLS: Final = {
    0: (0x02, Control(2, -64, 64, 0)),  # brightness
    1: (0x03, Control(2, 0, 64, 32)),  # contrast
    2: (0x06, Control(2, -40, 40, 0)),  # hue
    3: (0x07, Control(2, 0, 128, 64)),  # saturation
    4: (0x08, Control(2, 0, 255, 3, cv2.CAP_PROP_SHARPNESS)),
    5: (0x09, Control(2, 72, 500, 100)),  # gamma
    6: (0x0A, Control(2, *KELVIN_RANGE, 4600, cv2.CAP_PROP_WB_TEMPERATURE, changes=True)),
    8: (0x01, Control(2, 0, 1, 0, cv2.CAP_PROP_BACKLIGHT)),
    9: (0x04, Control(2, 0, 24, 0, cv2.CAP_PROP_GAIN)),
    10: (0x05, Control(1, 0, 2, 2, v4l2.POWER_LINE_FREQUENCY)),
    12: (0x0B, Control(1, 0, 1, 1, cv2.CAP_PROP_AUTO_WB)),
}
"""Selectors and controls by their bits in the descriptors of the units."""
COARSE: Final = PROCESSING_CONTROLS | {
    6: (0x0A, Control(2, *KELVIN_RANGE, 4600, cv2.CAP_PROP_WB_TEMPERATURE, step=100, changes=True)),
    9: (0x04, Control(2, 1, 24, 1, cv2.CAP_PROP_GAIN)),
}
"""As some webcams have them: the gain begins at 1, and the white balance has steps of 100 K."""
_CAMERA_BITS, _PROCESSING_BITS = 0b10_0000_0000_0010_1110, 0b1_0111_0101_0000
SIZES: Final = ((WIDTH, HEIGHT), (WIDTH // 2, HEIGHT // 2))
"""Width and height of each mode, by the index of its descriptor minus one."""
_INTERVALS = (10_000_000 // FPS, 20_000_000 // FPS, 10_000_000 // 5)
_UNCOMPRESSED: Final = {
    "YUYV": (bytes.fromhex("5955593200001000800000aa00389b71"), 16),
    "BGR3": (bytes.fromhex("7deb36e44f52ce119f530020af0ba770"), 24),
}
"""GUID of a format, and its bits in a pixel."""


def video_configuration(uncompressed: str = "YUYV") -> bytes:
    """Return the configuration: a camera, its processing unit, and a stream in two formats and two sizes.

    One of the formats is MJPG, the other ``uncompressed``: YUYV or BGR3.
    """
    return configuration(
        [
            struct.pack("8B", 8, 11, 0, 2, VIDEO, 3, 0, 0),  # both interfaces belong together
            interface(0, (VIDEO, CONTROL, 0)),
            *_units(),
            interface(1, (VIDEO, STREAM, 0), 1),
            *_formats(uncompressed),
            endpoint(0x80 | ENDPOINT, BULK, 512),
        ],
        interfaces=2,
        milliamps=500,
    )


def _units() -> list[bytes]:
    camera = struct.pack("<4BH2B3HB", 18, CLASS_INTERFACE, CAMERA, _CAMERA_UNIT, 0x0201, 0, 0, 0, 0, 0, 3)
    processing = struct.pack("<5BHB", 11, CLASS_INTERFACE, PROCESSING, _PROCESSING_UNIT, _CAMERA_UNIT, 0, 2)
    units = [
        camera + _CAMERA_BITS.to_bytes(3, "little"),
        processing + _PROCESSING_BITS.to_bytes(2, "little") + b"\0",
        struct.pack("<4BH3B", 9, CLASS_INTERFACE, 3, _OUTPUT, 0x0101, 0, _PROCESSING_UNIT, 0),
    ]
    total = 13 + sum(map(len, units))
    return [struct.pack("<3BHHI2B", 13, CLASS_INTERFACE, HEADER, 0x0100, total, CLOCK_HZ, 1, 1), *units]


def _formats(uncompressed: str) -> list[bytes]:
    colours = bytes([6, CLASS_INTERFACE, 0x0D, 1, 1, 4])
    sizes = len(SIZES)
    guid, bits = _UNCOMPRESSED[uncompressed]
    raw = struct.pack("5B", 27, CLASS_INTERFACE, UNCOMPRESSED, Format.RAW, sizes) + guid + bytes([bits, 1, 0, 0, 0, 0])
    mjpg = bytes([11, CLASS_INTERFACE, MJPEG, Format.MJPG, sizes, 1, 1, 0, 0, 0, 0])
    parts = [raw, *_frames(UNCOMPRESSED + 1), colours, mjpg, *_frames(MJPEG + 1), colours]
    total = 15 + sum(map(len, parts))
    header = struct.pack(
        "<4BHBBBBBBBBB", 15, CLASS_INTERFACE, HEADER, 2, total, 0x80 | ENDPOINT, 0, _OUTPUT, 0, 0, 0, 1, 0, 0
    )
    return [header, *parts]


def _frames(kind: int) -> list[bytes]:
    frames = []
    for index, (width, height) in enumerate(SIZES, 1):
        size, count = 2 * width * height, len(_INTERVALS)
        rates = (size * 8 * 5, size * 8 * FPS)
        frames.append(
            struct.pack("<5BHH", 26 + 4 * count, CLASS_INTERFACE, kind, index, 0, width, height)
            + struct.pack("<IIIIB", *rates, size, _INTERVALS[0], count)
            + struct.pack(f"<{count}I", *_INTERVALS)
        )
    return frames


C920: Final = Identity(0x046D, 0x082D, 0x0011, "", "HD Pro Webcam C920", "8E2A9F0F", kind=(0xEF, 2, 1))


class Webcam(UsbDevice):
    """A webcam that sees what a simulated camera sees, in real time.

    It streams YUYV, BGR3 and MJPG. In a mode with another pixel format, which OpenCV does not convert, no image comes.
    ``stopped`` holds the stream in the middle of an image, as a camera does that has crashed.

    Parameters
    ----------
    processing
        The controls of the processing unit by their bits; the descriptors say which of them the camera has.
    """

    def __init__(
        self,
        camera: SimCapture,
        time: RealTime,
        identity: Identity = C920,
        configuration: bytes | None = None,
        processing: dict[int, tuple[int, Control]] = PROCESSING_CONTROLS,
        speed: Speed = Speed.HIGH,
    ) -> None:
        self.identity = identity
        self.speed = speed
        self.configuration = configuration or video_configuration()
        self.video = Video.described(self.configuration)
        self.controls = {
            (unit, selector): control
            for (unit, bits), table in ((self.video.camera, CAMERA_CONTROLS), (self.video.processing, processing))
            for bit, (selector, control) in table.items()
            if bits >> bit & 1
        }
        self._kept = {key: control.factory for key, control in self.controls.items()}
        self.stopped = False
        self.frames_sent = 0
        self._camera = camera
        self._time = time
        self._number, self._stream = next(iter(self.video.streams.items()))
        self._mode = next(iter(self._stream.modes))
        self._interval = 0
        self._streaming = Event()
        self._streams = 0
        self._wanted = Event()
        self._over = False
        self._odd = False
        camera.every = EVERY
        camera.remembers = False  # Linux's driver does
        super().__init__()
        self._streamer = Thread(target=self._run, name="stream", daemon=True)
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

    def interface_set(self, interface: int, setting: int) -> None:
        """Start a stream of isochronous transfers, or stop it with the setting 0, which has no bandwidth."""
        if interface == self._number and setting in self._stream.packet_bytes:
            self._start()
        elif interface == self._number:
            self._streaming.clear()

    # -- requests ---------------------------------------------------------------------------------------------------

    def request(self, request: Request) -> bytes:
        interface, unit, selector = request.index & 0xFF, request.index >> 8, request.value >> 8
        if interface in self.video.streams:
            return self._negotiate(request, interface, selector)
        control = self.controls.get((unit, selector))
        if control is None:
            raise Stall
        match request.number:
            case Setting.SET:
                value = int.from_bytes(request.data[: control.size], "little")
                if control.property is None:
                    self._kept[unit, selector] = value
                    return b""
                with self._time.present():
                    if not control.set(self._camera, value):
                        raise Stall
                return b""
            case Setting.NOW if control.property is None:
                return control.encoded(self._kept[unit, selector])
            case Setting.NOW:
                with self._time.present():
                    return control.encoded(control.now(self._camera))
            case Setting.SIZE:
                return struct.pack("<H", control.size)
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
        return control.encoded(values[Setting(request.number)])

    def _negotiate(self, request: Request, interface: int, selector: int) -> bytes:
        """Agree on format, size and frame rate (probe), and begin to stream (commit)."""
        stream = self.video.streams[interface]
        match request.number:
            case Setting.SET if len(request.data) >= 8:
                _, form, size, self._interval = struct.unpack_from("<HBBI", request.data)
                self._number, self._stream = interface, stream
                known = [one for one in stream.modes if one == (form, size)] or list(stream.modes)
                self._mode = known[0]
                if selector == 2 and not stream.packet_bytes:
                    self._start()
                return b""
            case Setting.ABILITIES:
                return b"\x03"
            case Setting.SIZE:
                return struct.pack("<H", self._negotiation_bytes)
            case Setting.SET:
                raise Stall
        key = self._mode if interface == self._number else next(iter(stream.modes))
        mode = stream.modes[key]
        interval = self._interval or mode.usual
        payload = max(stream.packet_bytes.values(), default=PAYLOAD_BYTES)
        agreed = struct.pack("<HBBI5HII", 1, *key, interval, 0, 0, 0, 0, 0, 2 * mode.width * mode.height, payload)
        return agreed.ljust(self._negotiation_bytes, b"\0")

    @property
    def _negotiation_bytes(self) -> int:
        return 26 if self.video.version < 0x0110 else 34

    @property
    def mode(self) -> Mode:
        """The mode that host and camera have agreed on."""
        return self._stream.modes[self._mode]

    # -- the stream -------------------------------------------------------------------------------------------------

    def _start(self) -> None:
        with self._time.present():
            self._camera.set(cv2.CAP_PROP_FRAME_WIDTH, WIDTH if self.mode.width > WIDTH // 2 else WIDTH // 2)
            while not self._camera.wait_ns() and self._camera.grab():
                pass  # a webcam has no frames from before the stream
        self._streams += 1
        self._streaming.set()

    def _run(self) -> None:
        clock = SystemClock()
        while not self._over:
            if not self._streaming.wait(LONGEST_WAIT_S):
                continue
            mode = self.mode
            with self._time.present():
                stream = self._streams
                wait_ns = 1 if self.stopped or mode.fourcc not in STREAMED else self._camera.wait_ns()
                still = None if wait_ns or not self._camera.grab() else still_of(self._camera)
            image = None if still is None else still.retrieve()[1]  # while the world continues
            if image is None:
                clock.sleep(min(max(wait_ns * 1e-9, 0.001), LONGEST_WAIT_S))
                continue
            if image.shape[:2] != (mode.height, mode.width):
                image = np.asarray(cv2.resize(image, (mode.width, mode.height)), dtype=np.uint8)
            self._send(encoded(image, mode.fourcc), stream)

    def _send(self, data: bytes, stream: int) -> None:
        """Send an image of a stream in payloads, as the host asks for them; no part of it is sent in the next
        stream. Packets of an isochronous transfer that are left after the image's end are empty.
        """
        self._odd = not self._odd
        position = 0

        def payload(length: int) -> bytes:
            nonlocal position
            if position >= len(data):
                return b""
            part = data[position : position + min(length, PAYLOAD_BYTES) - HEADER_BYTES]
            position += len(part)
            flags = 0x8C | (2 if position >= len(data) else 0) | self._odd  # end of header, both clocks; end of image
            ticks = self._time.now_ns() * self.video.clock_hz // 1_000_000_000 & 0xFFFF_FFFF
            return struct.pack("<BBIIH", HEADER_BYTES, flags, ticks, ticks, ticks & 0x7FF) + part

        while position < len(data) and self._streaming.is_set() and stream == self._streams and not self._over:
            plug = self.plug
            if plug is None:
                return
            self._wanted.clear()
            if self.stopped or not plug.deliver(self._stream.endpoint, payload):
                self._wanted.wait(LONGEST_WAIT_S)
        self.frames_sent += position >= len(data)


STREAMED: Final = ("YUYV", "BGR3", "MJPG")


def encoded(image: NDArray[np.uint8], fourcc: str) -> bytes:
    """Return an image, uint8 (height, width, 3), in the format of the stream."""
    if fourcc == "MJPG":
        return bytes(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1])
    if fourcc == "BGR3":
        return image.tobytes()
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
