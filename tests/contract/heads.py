"""Rig heads for the contract of an IMU: the firmware in memory, its AVR binary, and a pseudo-terminal."""

import fcntl
import sys
import termios
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pkgutil import resolve_name

import pytest
import serial

from rig.config import ImuConfig
from rig.core.clock import Clock, SystemClock
from rig.devices.dynamixel.port import SerialConnection
from rig.devices.head.head import RigHead
from rig.devices.head.protocol import BAUD, Counters, ReadCounters
from rig.devices.head.samples import HeadSensor, head_sensor
from sim.head.board import SimHead
from sim.head.build import missing
from sim.head.serial_port import HeadSerial
from sim.imu.bno055 import SimBno055
from sim.imu.mpu6050 import SimMpu6050
from sim.noise import NoiseModel
from sim.realtime.port import PtyPort
from sim.world import World
from tests.firmware import avr

CLOCK_ERROR = 2e-3
"""A ceramic resonator's."""


@dataclass
class Head:
    """A driver on its clock, the simulated head that it uses, and the sensor on that head."""

    imu: RigHead
    clock: Clock
    head: SimHead
    sensor: SimMpu6050 | SimBno055
    world: World
    unplug: Callable[[], None]


def needs(kind: str) -> None:
    """Skip the test if this computer cannot build a head: ``memory``, the core, or ``avr``, the emulated binary."""
    if lacking := avr.missing() if kind == "avr" else missing():
        pytest.skip(lacking)


def head_of(kind: str, world: World, *, clock_error: float = 0.0, serial: int = 1) -> SimHead:
    """Return a head of a kind, and skip the test if this computer cannot build it."""
    needs(kind)
    return (avr.emulated_head if kind == "avr" else SimHead)(world, clock_error=clock_error, serial=serial)


def mpu6050() -> HeadSensor:
    return head_sensor(ImuConfig())


def mpu6500() -> HeadSensor:
    return head_sensor(ImuConfig(model="mpu6500"))


def bno055() -> HeadSensor:
    return head_sensor(ImuConfig(model="bno055"))


@contextmanager
def simulated_head(
    kind: str = "memory", noise: NoiseModel | None = None, *, clock_error: float = CLOCK_ERROR
) -> Iterator[tuple[SimHead, World]]:
    """Yield a head with nothing on its bus."""
    world = World(noise=noise, seed=1)
    head = head_of(kind, world, clock_error=clock_error)
    try:
        yield head, world
    finally:
        head.close()


@contextmanager
def opened_head(
    kind: str = "memory",
    noise: NoiseModel | None = None,
    *,
    sensor: Callable[[], HeadSensor] = mpu6050,
    reopen: Callable[[SimHead], SerialConnection] | None = None,
    clock_error: float = CLOCK_ERROR,
    **options: float,
) -> Iterator[Head]:
    """Yield a driver on a simulated head with its sensor."""
    with simulated_head(kind, noise, clock_error=clock_error) as (head, world):
        settings = sensor()
        device = resolve_name(settings.kind.simulator)(head.world_at_board_time)
        head.attach(device.address, device)
        wire = HeadSerial(head)
        again = (lambda: reopen(head)) if reopen else None
        imu = RigHead(wire, world.clock, settings, reopen=again, **options)
        try:
            yield Head(imu, world.clock, head, device, world, wire.unplug)
        finally:
            imu.close()


PUMP_S = 0.001
READ_S = 0.002
"""Time that a read waits for the first byte, as with the timeout of the real port."""


@contextmanager
def head_on_a_pty(noise: NoiseModel | None = None) -> Iterator[Head]:
    """Yield a driver with pyserial on a pseudo-terminal."""
    needs("memory")
    world = World(noise=noise, seed=1)
    clock = world.clock
    head = SimHead(world, clock_error=CLOCK_ERROR)
    device = SimMpu6050(head.world_at_board_time)
    head.attach(device.address, device)
    terminal = PtyPort(lambda: HeadSerial(head))
    stop = clock.every(PUMP_S, terminal.pump)

    def unplug() -> None:
        stop()
        terminal.close()

    try:
        port = serial.Serial(terminal.path, BAUD, timeout=0, exclusive=True)
        wire = _PtyWire(port, clock, terminal)
        imu = RigHead(wire, clock, mpu6050(), deadman_s=2.0)
        try:
            yield Head(imu, clock, head, device, world, unplug)
        finally:
            imu.close()
    finally:
        unplug()
        head.close()


TERMINAL_BYTES = 4095
"""What a terminal holds ready for its reader; the rest waits in the kernel until some is read."""


class _PtyWire:
    """pyserial on a pseudo-terminal whose other end is in this very thread, with virtual time.

    Each end waits for the bytes that the other end has written, because the delay of a busy kernel is not tested.
    """

    def __init__(self, port: serial.Serial, clock: Clock, terminal: PtyPort) -> None:
        self._port = port
        self._clock = clock
        self._terminal = terminal
        self._taken = 0
        self.baudrate = port.baudrate

    @property
    def in_waiting(self) -> int:
        self._settle()
        return self._port.in_waiting

    def read(self, size: int = 1) -> bytes:
        if not self.in_waiting:
            self._clock.sleep(READ_S)
            self._settle()
        data = self._port.read(size)
        self._taken += len(data)
        return data

    def write(self, data: bytes, /) -> int | None:
        written = self._port.write(data)
        self._until(lambda: self._waiting() >= len(data))
        return written

    def _waiting(self) -> int:
        """Return the number of bytes of the host that the head has not received yet."""
        count = fcntl.ioctl(self._terminal.fileno(), termios.FIONREAD, bytes(4))
        return int.from_bytes(count, sys.byteorder)

    def reset_input_buffer(self) -> None:
        self._taken += len(self._port.read(self.in_waiting))

    def close(self) -> None:
        self._port.close()

    def _settle(self) -> None:
        self._until(lambda: self._port.in_waiting >= min(self._terminal.sent - self._taken, TERMINAL_BYTES))

    @staticmethod
    def _until(carried: Callable[[], bool]) -> None:
        for _ in range(600_000):
            if carried():
                return
            SystemClock().sleep(0.0001)
        raise AssertionError("the kernel does not carry what was written")


AVR_NIGHTLY = pytest.mark.parametrize(
    "opened", ["memory", pytest.param("avr", marks=pytest.mark.nightly)], indirect=True
)


def counters(h: Head) -> Counters:
    """Return the head's own counters since it started."""
    return h.imu._link.request(ReadCounters(), Counters)


def switch_on(h: Head) -> None:
    h.imu.set_power(True)
    h.imu.set_light(1.0)
