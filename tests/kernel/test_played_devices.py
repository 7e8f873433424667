"""The played devices as a USB host sees them, without a virtual machine."""

import struct
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from errno import ENXIO

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim.camera import SimCapture
from sim.i2c import SimI2cBus
from sim.imu.mpu6050 import SimMpu6050
from sim.realtime.pace import RealTime
from sim.servo import ServoBus, SimSerial
from sim.world import World
from tests.fuzzing import examples
from tests.kernel.usb import descriptors
from tests.kernel.usb.descriptors import Identity
from tests.kernel.usb.device import TO_HOST, UsbDevice
from tests.kernel.usb.diolan_u2c import TO_DEVICE, DiolanU2c
from tests.kernel.usb.ftdi import FtdiAdapter, baud_rate
from tests.kernel.usb.i2c_tiny_usb import I2cTinyUsb
from tests.kernel.usb.usbip import Hang, Stall
from tests.kernel.usb.video import Video
from tests.kernel.usb.webcam import COARSE, HEADER_BYTES, SIZES, Format, Setting, Webcam, encoded
from tests.webcams import WEBCAMS, recorded

GET_DESCRIPTOR = 6


@pytest.fixture
def world() -> World:
    return World(seed=1)


@pytest.fixture
def adapter(world: World) -> Iterator[FtdiAdapter]:
    adapter = FtdiAdapter(SimSerial(ServoBus(world.clock), timeout=0.0))
    adapter.time = RealTime(world.clock, [adapter])
    yield adapter
    adapter.close()


@pytest.fixture
def bus(world: World) -> Iterator[SimI2cBus]:
    with SimI2cBus(world.clock) as bus:
        bus.attach(0x68, SimMpu6050(world))
        yield bus


@pytest.fixture
def i2c(world: World, bus: SimI2cBus) -> Iterator[I2cTinyUsb]:
    i2c = I2cTinyUsb(bus, RealTime(world.clock))
    yield i2c
    i2c.close()


@pytest.fixture
def webcam(world: World) -> Iterator[Webcam]:
    webcam = Webcam(SimCapture(world), RealTime(world.clock))
    yield webcam
    webcam.close()


@pytest.fixture(params=["adapter", "i2c", "webcam"])
def device(request: pytest.FixtureRequest) -> UsbDevice:
    return request.getfixturevalue(request.param)


def ask(device: UsbDevice, kind: int, number: int, value: int = 0, index: int = 0, length: int = 255) -> bytes:
    """Return the answer to a request that reads."""
    return device.control(struct.pack("<BBHHH", kind | TO_HOST, number, value, index, length), b"")


def control_transfer(
    device: UsbDevice, kind: int, number: int, value: int = 0, index: int = 0, data: bytes = b""
) -> None:
    """Send a request that writes."""
    assert device.control(struct.pack("<BBHHH", kind, number, value, index, len(data)), data) == b""


# -- all devices ----------------------------------------------------------------------------------------------------


def test_descriptors_have_the_lengths_that_they_state(device: UsbDevice) -> None:
    first = ask(device, 0, GET_DESCRIPTOR, descriptors.DEVICE << 8)
    assert len(first) == first[0] == 18
    whole = ask(device, 0, GET_DESCRIPTOR, descriptors.CONFIGURATION << 8)
    assert int.from_bytes(whole[2:4], "little") == len(whole)
    kinds = [part[1] for part in descriptors.parts(whole)]
    assert kinds.count(descriptors.INTERFACE) == whole[4]
    ends = sum(part[4] for part in descriptors.parts(whole) if part[1] == descriptors.INTERFACE)
    assert kinds.count(descriptors.ENDPOINT) == ends


def test_strings_are_those_of_the_identity(device: UsbDevice) -> None:
    first = ask(device, 0, GET_DESCRIPTOR, descriptors.DEVICE << 8)
    for index, text in zip(first[14:17], device.identity.strings, strict=True):
        if text:
            answer = ask(device, 0, GET_DESCRIPTOR, descriptors.STRING << 8 | index)
            assert (answer[0], answer[2:].decode("utf-16-le")) == (len(answer), text)
        else:
            assert index == 0
    with pytest.raises(Stall):
        ask(device, 0, GET_DESCRIPTOR, descriptors.STRING << 8 | 9)


def test_any_request_is_answered_or_stalled(adapter: FtdiAdapter, i2c: I2cTinyUsb, webcam: Webcam) -> None:
    @examples(100)
    @given(setup=st.binary(min_size=8, max_size=8), data=st.binary(max_size=64))
    def answers(setup: bytes, data: bytes) -> None:
        for device in (adapter, i2c, webcam):
            with suppress(Stall):
                assert isinstance(device.control(setup, data), bytes)

    answers()


# -- serial adapter -------------------------------------------------------------------------------------------------


def divisor(rate: int) -> tuple[int, int]:
    """Return value and index of the request for a baud rate, as the kernel's driver calculates them for an FT232H."""
    codes = (0, 3, 2, 4, 1, 5, 6, 7)
    eighths = (8 * 120_000_000 + 5 * rate) // (10 * rate)
    code = eighths >> 3 | codes[eighths & 7] << 14
    return code & 0xFFFF, code >> 16 << 8 | 0x0200


@pytest.mark.parametrize("rate", [9_600, 57_600, 115_200, 1_000_000, 2_000_000, 3_000_000, 4_000_000])
def test_adapter_understands_the_divisors_of_the_kernel(adapter: FtdiAdapter, rate: int) -> None:
    value, index = divisor(rate)
    assert baud_rate(value, index) == rate
    control_transfer(adapter, 0x40, 3, value, index)
    assert adapter._connection.baudrate == rate


@examples(100)
@given(st.integers(3_000, 4_400_000))
def test_a_baud_rate_is_right_within_what_a_servo_tolerates(rate: int) -> None:
    assert baud_rate(*divisor(rate)) == pytest.approx(rate, rel=0.035)


def test_adapter_keeps_its_latency_timer_until_it_is_plugged_in_again(adapter: FtdiAdapter) -> None:
    assert ask(adapter, 0x40, 10) == b"\x10"
    control_transfer(adapter, 0x40, 9, 1)
    assert ask(adapter, 0x40, 10) == b"\x01"
    adapter.plugged()
    assert ask(adapter, 0x40, 10) == b"\x10"


# -- I2C adapter ----------------------------------------------------------------------------------------------------

FIRST, LAST, IO = 1, 2, 4
WHO_AM_I = 0x75


def read_register(i2c: I2cTinyUsb, address: int) -> bytes:
    control_transfer(i2c, 0x40, IO | FIRST, 0, address, bytes([WHO_AM_I]))
    return ask(i2c, 0x40, IO | LAST, 1, address, 1)


def test_adapter_reads_a_register_of_a_sensor(i2c: I2cTinyUsb) -> None:
    assert read_register(i2c, 0x68) == b"\x68"
    assert ask(i2c, 0x40, 3) == b"\x01"


def test_adapter_reports_a_missing_acknowledge(i2c: I2cTinyUsb, bus: SimI2cBus) -> None:
    read_register(i2c, 0x50)
    assert ask(i2c, 0x40, 3) == b"\x02"
    read_register(i2c, 0x68)
    assert ask(i2c, 0x40, 3) == b"\x01"
    bus.errors[0x68] = ENXIO
    read_register(i2c, 0x68)
    assert ask(i2c, 0x40, 3) == b"\x02"


def test_adapter_hangs_while_its_bus_hangs(i2c: I2cTinyUsb, bus: SimI2cBus) -> None:
    bus.stuck = True
    with pytest.raises(Hang):
        read_register(i2c, 0x68)
    bus.stuck = False
    assert read_register(i2c, 0x68) == b"\x68"


@pytest.fixture
def u2c(world: World, bus: SimI2cBus) -> Iterator[DiolanU2c]:
    u2c = DiolanU2c(bus, RealTime(world.clock))
    yield u2c
    u2c.close()


def exchanged(u2c: DiolanU2c, *commands: int) -> list[bytes]:
    """Return the answers to the commands of one transfer."""
    u2c.receive(TO_DEVICE, bytes(commands))
    answers = list(u2c.answers)
    u2c.answers.clear()
    return answers


def who_am_i(u2c: DiolanU2c, address: int) -> list[bytes]:
    """Read a register as the driver does: start, address, register, start again, address, a byte."""
    read = (0x0C, 0x13, address << 1, 0x13, WHO_AM_I, 0x0E, 0x13, address << 1 | 1, 0x14, 0)
    return exchanged(u2c, *read) + exchanged(u2c, 0x0D)


def test_second_adapter_reads_a_register_of_a_sensor(u2c: DiolanU2c) -> None:
    assert who_am_i(u2c, 0x68) == [b"\0", b"\0", b"\0", b"\0", b"\0", b"\x68\0", b"\0"]


def test_second_adapter_distinguishes_a_missing_acknowledge_and_a_timeout(u2c: DiolanU2c, bus: SimI2cBus) -> None:
    assert who_am_i(u2c, 0x50)[1] == b"\x07"
    bus.stuck = True
    assert who_am_i(u2c, 0x68)[1] == b"\x09"
    bus.stuck = False
    assert who_am_i(u2c, 0x68)[5] == b"\x68\0"


@examples(50)
@given(st.binary(max_size=64))
def test_second_adapter_survives_any_commands(data: bytes) -> None:
    world = World(seed=1)
    with SimI2cBus(world.clock) as bus, closing(DiolanU2c(bus, RealTime(world.clock))) as u2c:
        u2c.receive(TO_DEVICE, data)
        assert all(answers[-1] in (0, 7, 9) for answers in u2c.answers)


# -- webcam ---------------------------------------------------------------------------------------------------------


@pytest.fixture(params=WEBCAMS)
def real(world: World, request: pytest.FixtureRequest) -> Iterator[Webcam]:
    """Play a webcam by its real descriptors."""
    device, configuration = recorded(request.param)
    identity = Identity.read(device, configuration, ("Maker", "Name", "SN0001"))
    assert identity.device() == device
    webcam = Webcam(SimCapture(world), RealTime(world.clock), identity, configuration, COARSE)
    yield webcam
    webcam.close()


RESERVED = 15
"""This bit of a camera terminal has no meaning; one webcam sets it."""


def test_webcam_answers_for_the_controls_of_its_descriptors(webcam: Webcam, real: Webcam) -> None:
    for one in (webcam, real):
        answers_for_all_controls(one)


def answers_for_all_controls(webcam: Webcam) -> None:
    bits = (webcam.video.camera[1] & ~(1 << RESERVED), webcam.video.processing[1])
    assert len(webcam.controls) == sum(map(int.bit_count, bits)) > 0
    for (unit, selector), known in webcam.controls.items():
        for number in (Setting.NOW, Setting.LEAST, Setting.MOST, Setting.STEP, Setting.FACTORY):
            assert len(ask(webcam, 0x21, number, **control(unit, selector))) == known.size
        assert ask(webcam, 0x21, Setting.SIZE, **control(unit, selector)) == struct.pack("<H", known.size)


class Taken:
    """The host's end of a plug: takes what is delivered, in packets of one size."""

    def __init__(self, packet_bytes: int) -> None:
        self.packets: list[bytes] = []
        self._packet_bytes = packet_bytes

    def deliver(self, endpoint: int, produce: Callable[[int], bytes]) -> bool:
        self.packets += [produce(self._packet_bytes) for _ in range(32)]
        return True

    def close(self) -> None:
        pass


def test_image_is_divided_into_packets_of_the_alternate_setting(real: Webcam) -> None:
    """Each packet has a header; after the image's end they are empty."""
    interface, stream = next(iter(real.video.streams.items()))
    (form, size), mode = next(one for one in stream.modes.items() if one[1].fourcc == "YUYV")
    control_transfer(real, 0x21, Setting.SET, 2 << 8, interface, struct.pack("<HBBI", 0, form, size, mode.usual))
    assert real.mode == mode
    packet_bytes = max(stream.packet_bytes.values())
    plug = Taken(packet_bytes)
    real.plug = plug  # type: ignore[assignment]
    with real._time.present():
        real._streaming.set()
        real._streams += 1
    real._send(bytes(range(256)) * 40, real._streams)
    filled = [packet for packet in plug.packets if packet]
    assert b"".join(packet[HEADER_BYTES:] for packet in filled) == bytes(range(256)) * 40
    assert [packet[1] & 2 for packet in filled] == [0] * (len(filled) - 1) + [2]  # the last one ends the image
    assert max(map(len, filled)) == packet_bytes
    control_transfer(real, 1, 11, 0, interface)
    assert not real._streaming.is_set()


def test_super_speed_gives_each_endpoint_its_companion(real: Webcam) -> None:
    fast = descriptors.at_super_speed(real.configuration)
    assert int.from_bytes(fast[2:4], "little") == len(fast)
    kinds = [part[1] for part in descriptors.parts(fast)]
    assert kinds.count(descriptors.ENDPOINT) == kinds.count(descriptors.COMPANION)
    assert Video.described(fast).streams == real.video.streams


def control(unit: int, selector: int) -> dict[str, int]:
    return {"value": selector << 8, "index": unit << 8}


EXPOSURE_MODE, EXPOSURE = control(1, 0x02), control(1, 0x04)


def test_webcam_keeps_its_settings_in_the_simulated_camera(webcam: Webcam) -> None:
    with pytest.raises(Stall):  # the automatic exposure sets it
        control_transfer(webcam, 0x21, Setting.SET, **EXPOSURE, data=struct.pack("<I", 50))
    control_transfer(webcam, 0x21, Setting.SET, **EXPOSURE_MODE, data=b"\x01")
    control_transfer(webcam, 0x21, Setting.SET, **EXPOSURE, data=struct.pack("<I", 50))
    assert ask(webcam, 0x21, Setting.NOW, **EXPOSURE) == struct.pack("<I", 50)
    assert webcam._camera.get(cv2.CAP_PROP_EXPOSURE) == 50


@pytest.mark.parametrize("size", [1, 2])
@pytest.mark.parametrize("form", list(Format))
def test_webcam_agrees_on_format_and_size(webcam: Webcam, form: Format, size: int) -> None:
    wanted = struct.pack("<HBBI", 0, form, size, 333_333) + bytes(18)
    control_transfer(webcam, 0x21, Setting.SET, 1 << 8, 1, wanted)
    agreed = ask(webcam, 0x21, Setting.NOW, 1 << 8, 1)
    width, height = SIZES[size - 1]
    assert struct.unpack_from("<HBBI", agreed)[1:] == (form, size, 333_333)
    assert struct.unpack_from("<I", agreed, 18)[0] == 2 * width * height


def test_images_are_the_same_after_their_transfer() -> None:
    ramp = np.linspace(0, 255, 64).astype(np.uint8)
    image = np.dstack([np.tile(levels, (48, 1)) for levels in (ramp, ramp[::-1] // 2, ramp // 2 + 60)])
    yuyv = np.frombuffer(encoded(image, "YUYV"), np.uint8).reshape(48, 64, 2)
    assert np.abs(cv2.cvtColor(yuyv, cv2.COLOR_YUV2BGR_YUYV).astype(int) - image).max() <= 8
    mjpg = cv2.imdecode(np.frombuffer(encoded(image, "MJPG"), np.uint8), cv2.IMREAD_COLOR)
    assert np.abs(mjpg.astype(int) - image).max() <= 8
