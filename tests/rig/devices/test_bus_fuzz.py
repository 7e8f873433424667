"""Parsers of bytes from devices, tested with damaged bytes: they never hang, and no wrong value stays.

A packet is accepted only if its checksum is right; the reference functions below search the bytes for such packets.
"""

from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.config import ImuConfig
from rig.core.errors import DeviceSilent, RequestRejected, RigError
from rig.devices.dynamixel.registers import control_table
from rig.devices.imu import Imu, open_imu
from sim.clock import VirtualClock
from sim.i2c import SimI2cBus
from sim.imu.bno055 import SimBno055
from sim.imu.mpu6050 import SimMpu6050
from sim.noise import NoiseModel
from sim.servo.protocol2 import crc16, status_packet
from sim.world import World
from tests.fuzzing import fuzz_settings
from tests.rig.devices.scripted_serial import scripted_bus

pytestmark = pytest.mark.timeout(1200)  # the nightly profile's 20,000 cases a parser

ANSWER_S = 2.0
"""Longest time that a read with two retries may take, with any received bytes."""

TABLE = control_table("xl430_w250")


# -- what a line makes of an answer ------------------------------------------------------------------------------------


@st.composite
def spoiled(draw: st.DrawFn, packet: bytes) -> bytes:
    """Return ``packet`` as it may arrive: whole, damaged, among noise, echoed, doubled, or replaced by another one."""
    data = bytearray(packet)
    for _ in range(draw(st.integers(0, 4))):
        at = draw(st.integers(0, max(len(data) - 1, 0)))
        match draw(st.integers(0, 6)):
            case 0 if data:
                data[at] ^= 1 << draw(st.integers(0, 7))
            case 1:
                del data[at:]
            case 2:
                del data[at : at + draw(st.integers(1, 4))]
            case 3:
                data[at:at] = draw(st.binary(max_size=12))
            case 4:
                data = (
                    bytearray(draw(st.sampled_from([b"\xff", b"\xff\xff", b"\xff\xff\xfd", b"\xff\xff\xfd\x00"])))
                    + data
                )
            case 5:
                other = draw(st.integers(0, 255)), draw(st.binary(max_size=6))
                data = bytearray(status_packet(draw(st.integers(0, 252)), *other)) + data
            case 6:
                data += bytes(data)
    return bytes(data)


def intact(stream: bytes) -> list[bytes]:
    """Return the parameters of every intact status packet of id 1 in ``stream``, wherever it begins."""
    found = []
    for start in range(len(stream) - 5):
        rest = stream[start:]
        if rest[:5] == b"\xff\xff\xfd\x00\x01" and len(rest) > 8 and rest[7] == 0x55:
            end = 7 + int.from_bytes(rest[5:7], "little")
            if (
                end >= 11
                and len(rest) >= end
                and crc16(rest[: end - 2]) == int.from_bytes(rest[end - 2 : end], "little")
            ):
                found.append(rest[9 : end - 2].replace(b"\xff\xff\xfd\xfd", b"\xff\xff\xfd"))
    return found


@fuzz_settings()
@given(data=st.data(), value=st.integers(0, 0xFFFF_FFFF))
def test_read_block_was_sent_by_the_device(data: st.DataObject, value: int) -> None:
    """Four bytes, three attempts: the value of an intact packet with four parameters, a rejection, or silence.

    The value is that of the reading which the driver dates by `sampled_ns`. One that follows only confirms it.
    """
    block = value.to_bytes(4, "little")
    # The driver asks for one byte more each time an answer is owed, from one address lower.
    sent = [b"\x55" * extra + block for extra in range(3)]
    answers = [data.draw(spoiled(status_packet(1, 0, parameters))) for parameters in sent]
    bus, wire = scripted_bus(*answers, retries=2)
    clock = bus.port.clock
    try:
        got = bus.read_block(1, 28, 4)
    except (DeviceSilent, RequestRejected):
        pass
    else:
        attempt = sum(sent_ns <= bus.sampled_ns for sent_ns in wire.written_ns) - 1
        assert got in [parameters[attempt:] for parameters in intact(answers[attempt])]
    assert clock.now_ns() < ANSWER_S * 1e9
    assert not bus.port.is_using
    assert bus.statistics.transactions == len(wire.written)


@fuzz_settings(0.4)
@given(noise=st.lists(st.binary(max_size=60), min_size=6, max_size=6))
def test_noise_is_never_a_value_or_an_acknowledgement(noise: list[bytes]) -> None:
    bus, _ = scripted_bus(*noise, retries=2)
    register = TABLE["Goal Position"]
    if not any(intact(part) for part in noise):
        with pytest.raises(DeviceSilent):
            bus.read(1, register)
        with pytest.raises(DeviceSilent):
            bus.write(1, register, 1)
    assert bus.port.clock.now_ns() < 2 * ANSWER_S * 1e9


# -- I2C: no sums, so that only what the bytes say about each other can be checked


class Spoiler:
    """A device on I2C whose answers are replaced: as many of the next reads as there are replacements."""

    def __init__(self, device: SimMpu6050 | SimBno055) -> None:
        self.replace: list[Callable[[bytes], bytes]] = []
        self._device = device

    @property
    def answers(self) -> bool:
        return getattr(self._device, "answers", True)

    def start(self, reading: bool) -> None:
        self._device.start(reading)

    def write(self, data: bytes) -> int:
        return self._device.write(data)

    def read(self, count: int) -> bytes:
        true = self._device.read(count)
        return self.replace.pop(0)(true)[:count].ljust(count, b"\xff") if self.replace else true

    def stop(self) -> None: ...


@dataclass
class Sensor:
    """A sensor at rest, opened once: opening takes longer than a case."""

    imu: Imu
    spoiler: Spoiler
    clock: VirtualClock


@pytest.fixture(scope="module", params=["mpu6050", "bno055"])
def sensor(request: pytest.FixtureRequest) -> Iterator[Sensor]:
    config = ImuConfig(model=request.param)
    world = World(noise=NoiseModel.none())
    spoiler = Spoiler(SimBno055(world) if config.model == "bno055" else SimMpu6050(world))
    with SimI2cBus(world.clock) as bus:
        bus.attach(config.address, spoiler)
        with closing(open_imu(config, bus.path, world.clock)) as imu:
            yield Sensor(imu, spoiler, world.clock)


def flip(bit: int) -> Callable[[bytes], bytes]:
    def flipped(true: bytes) -> bytes:
        data = bytearray(true)
        data[bit // 8 % len(data)] ^= 1 << bit % 8
        return bytes(data)

    return flipped


def put(garbage: bytes) -> Callable[[bytes], bytes]:
    return lambda _: garbage


def keep(true: bytes) -> bytes:
    return true


replacements = st.lists(
    st.just(keep) | st.integers(0, 500).map(flip) | st.binary(max_size=60).map(put), min_size=1, max_size=8
)


@fuzz_settings()
@given(spoil=replacements, waits=st.lists(st.floats(0.0, 0.4), min_size=1, max_size=3))
def test_any_register_values_of_an_imu_are_handled(
    sensor: Sensor, spoil: list[Callable[[bytes], bytes]], waits: list[float]
) -> None:
    imu, clock = sensor.imu, sensor.clock
    clock.sleep(1.0)
    imu.read_samples()  # too late for what happened before: from here on everything is new
    newest_ns = clock.now_ns() - round(1e9 / imu.rate_hz)
    sensor.spoiler.replace += spoil
    for pause_s in waits:
        clock.sleep(pause_s)
        before_ns = clock.now_ns()
        with suppress(RigError):
            samples = imu.read_samples()
            assert samples.gyro_dps.shape == (samples.time_ns.size, 3)
            assert np.isfinite(samples.gyro_dps).all()
            assert samples.lost >= 0
            if samples.time_ns.size:
                assert (np.diff(samples.time_ns) > 0).all()
                assert newest_ns < samples.time_ns[0]
                assert samples.time_ns[-1] <= clock.now_ns()
                elapsed_s = (clock.now_ns() - newest_ns) * 1e-9
                assert samples.time_ns.size <= 1.15 * elapsed_s * imu.rate_hz + 5  # no more than it can have taken
                newest_ns = int(samples.time_ns[-1])
            assert np.isfinite(imu.read_gravity_g()).all()
        assert clock.now_ns() - before_ns < 0.2e9
    sensor.spoiler.replace.clear()
    clock.sleep(1.0)
    imu.read_samples()
    clock.sleep(0.1)
    samples = imu.read_samples()  # no wrong value was kept
    assert samples.lost == 0
    assert samples.gyro_dps == pytest.approx(0.0)
