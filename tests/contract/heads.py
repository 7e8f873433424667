"""Rig heads for the contract of an IMU: the firmware in memory, its AVR binary, and a pseudo-terminal in real time."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import pytest
import serial

from rig.core.clock import Clock, SystemClock
from rig.devices.dynamixel.port import SerialConnection
from rig.devices.head.head import RigHead
from rig.devices.head.protocol import BAUD
from rig.devices.head.sensors import HeadSensor, head_sensor
from sim.head.board import SimHead
from sim.head.build import missing
from sim.head.realtime import HeadPty, PacedClock
from sim.head.serial_port import HeadSerial
from sim.imu.bno055 import SimBno055
from sim.imu.mpu6050 import SimMpu6050
from sim.noise import NoiseModel
from sim.world import World

CLOCK_ERROR = 2e-3
"""A ceramic resonator's."""


@dataclass
class Head:
    """A driver on its clock, the simulated head that it talks to, and the sensor on that one."""

    imu: RigHead
    clock: Clock
    head: SimHead
    sensor: SimMpu6050 | SimBno055
    world: World
    unplug: Callable[[], None]


def needs(kind: str) -> None:
    """Skip the test where this machine cannot build a head of this kind."""
    if lacking := missing(kind):
        pytest.skip(lacking)


def mpu6050() -> HeadSensor:
    return head_sensor("mpu6050", address=0x68, range_dps=250, rate_hz=200.0, bandwidth_hz=42)


def bno055() -> HeadSensor:
    return head_sensor("bno055", address=0x28, range_dps=2000, rate_hz=100.0, bandwidth_hz=42)


@contextmanager
def simulated_head(
    kind: str = "memory", noise: NoiseModel | None = None, *, clock_error: float = CLOCK_ERROR, seed: int = 1
) -> Iterator[tuple[SimHead, World]]:
    """Yield a head with nothing on its bus."""
    needs(kind)
    world = World(noise=noise, seed=seed)
    head = SimHead(world, kind, clock_error=clock_error)
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
        device = (
            SimMpu6050(head.world_at_board_time)
            if settings.kind.key == "mpu6050"
            else SimBno055(head.world_at_board_time)
        )
        head.attach(device.address, device)
        wire = HeadSerial(head)
        again = (lambda: reopen(head)) if reopen else None
        imu = RigHead(wire, world.clock, settings, reopen=again, **options)
        try:
            yield Head(imu, world.clock, head, device, world, wire.unplug)
        finally:
            imu.close()


@contextmanager
def head_on_a_pty(noise: NoiseModel | None = None, speed: float = 4.0) -> Iterator[Head]:
    """Yield a driver with pyserial on a pseudo-terminal, ``speed`` times as fast as real time."""
    needs("memory")
    world = World(noise=noise, seed=1)
    clock = PacedClock(world.clock, speed)
    head = SimHead(world, clock_error=CLOCK_ERROR)
    device = SimMpu6050(head.world_at_board_time)
    head.attach(device.address, device)
    terminal = HeadPty(head)
    try:
        port = serial.Serial(terminal.port, BAUD, timeout=0.002 / speed, exclusive=True)
        wire = _PacedWire(port, clock, terminal)
        imu = RigHead(wire, clock, mpu6050(), deadman_s=2.0)
        try:
            yield Head(imu, clock, head, device, world, terminal.close)
        finally:
            imu.close()
    finally:
        terminal.close()
        head.close()


TERMINAL_BYTES = 4095
"""What a terminal holds ready for its reader; the rest waits in the kernel until some is read."""


class _PacedWire:
    """pyserial on a simulated line in this very thread: time goes on before each look at the port.

    What one end has written is waited for at the other: how long a busy kernel takes to carry it is not under test.
    """

    def __init__(self, port: serial.Serial, clock: Clock, terminal: HeadPty) -> None:
        self._port = port
        self._clock = clock
        self._terminal = terminal
        self._taken = 0
        self.baudrate = port.baudrate

    @property
    def in_waiting(self) -> int:
        self._clock.now_ns()
        self._settle()
        return self._port.in_waiting

    def read(self, size: int = 1) -> bytes:
        self._clock.now_ns()
        self._settle()
        data = self._port.read(size)
        self._taken += len(data)
        return data

    def write(self, data: bytes, /) -> int | None:
        written = self._port.write(data)
        self._until(lambda: self._terminal.waiting() >= len(data))
        return written

    def reset_input_buffer(self) -> None:
        self._taken += len(self._port.read(self.in_waiting))

    def close(self) -> None:
        self._port.close()

    def _settle(self) -> None:
        self._until(lambda: self._port.in_waiting >= min(self._terminal.sent - self._taken, TERMINAL_BYTES))

    @staticmethod
    def _until(carried: Callable[[], bool]) -> None:
        for _ in range(50_000):
            if carried():
                return
            SystemClock().sleep(0.0001)
        raise AssertionError("the kernel does not carry what was written")
