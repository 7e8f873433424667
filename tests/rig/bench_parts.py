"""Real drivers on simulated wires, put together for the tests of the motion layer (no camera needed)."""

from collections.abc import Generator, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import pytest

from rig.bench import Bench
from rig.config import load_config
from rig.core.errors import RigError
from rig.devices.dynamixel.bus import DynamixelBus
from rig.devices.dynamixel.port import READ_SLICE_S, ClockedPort
from rig.devices.dynamixel.servo import DynamixelServo
from rig.devices.mpu6050 import Mpu6050
from rig.safety.saved_state import MemoryStore, SessionEnd, StateStore
from sim.i2c import SimI2cBus
from sim.imu.mpu6050 import SimMpu6050
from sim.noise import NoiseModel
from sim.servo import Sender, SentBytes, ServoBus, SimSerial, SimServo
from sim.world import World


@dataclass
class Wires:
    """The simulated side of a bench, which the tests set."""

    world: World
    bus: ServoBus
    device: SimServo
    serial: SimSerial
    sent: list[SentBytes] = field(default_factory=list)
    i2c: SimI2cBus | None = None

    @property
    def instructions(self) -> list[bytes]:
        """What the host has sent."""
        return [frame.data for frame in self.sent if frame.source is Sender.HOST]


def servo_wires(noise: NoiseModel | None = None, seed: int = 0, **servo: Any) -> Wires:
    world = World(noise=noise, seed=seed)
    bus = ServoBus(world.clock)
    device = SimServo(world, **servo)
    bus.attach(device)
    wires = Wires(world, bus, device, SimSerial(bus, device.baudrate, READ_SLICE_S))
    bus.taps.append(wires.sent.append)
    return wires


def open_bus(wires: Wires, retries: int = 3) -> DynamixelBus:
    return DynamixelBus(ClockedPort(wires.serial, wires.world.clock, wires.serial.name), retries)


def open_servo(wires: Wires, **options: Any) -> DynamixelServo:
    servo = DynamixelServo(open_bus(wires), bus_id=1, model="xl430_w250", clock=wires.world.clock, **options)
    servo.prepare(write=True)
    return servo


def at_rest(servo: SimServo, goal_deg: float, error_deg: float = 0.3) -> Any:
    """Return what an angle at rest equals after a motion upwards to a goal: friction holds the table short of it."""
    return pytest.approx(goal_deg - servo.motor.held_deg, abs=error_deg)


LAG_S = 885 / 5 * 360 / 4096 / (61 * 6)
"""Lag of an XL430 behind its profile: the gain is 5 PWM for each count of error, and 885 are 61 rev/min."""
BRAKED_S = 8.5 * LAG_S
"""Time after the end of a profile until a shaft that was at 90 °/s stands still."""


@contextmanager
def motion_bench(*settings: str, noise: NoiseModel | None = None, seed: int = 0) -> Iterator[tuple[Bench, Wires]]:
    """Yield a bench of servo and IMU, whose cable hangs free, and its wires."""
    with sensor(servo_wires(noise, seed)) as (wires, i2c), program(wires, i2c, MemoryStore(), *settings) as bench:
        bench.safety.set_revolutions(0)
        yield bench, wires


@contextmanager
def sensor(wires: Wires) -> Iterator[tuple[Wires, SimI2cBus]]:
    """Put an IMU beside the servo."""
    with SimI2cBus(wires.world.clock) as i2c:
        i2c.attach(0x68, SimMpu6050(wires.world))
        yield wires, i2c


@contextmanager
def program(wires: Wires, i2c: SimI2cBus, state: StateStore, *settings: str, **servo_options: Any) -> Iterator[Bench]:
    """Yield the bench as one program opens it; the next program finds the devices as this one leaves them."""
    if not wires.serial.is_open:
        wires.serial.open()
    servo = open_servo(wires, **servo_options)
    imu = Mpu6050(i2c.path, clock=wires.world.clock)
    config = load_config(overrides=settings)
    bench = Bench("test", config, wires.world.clock, servo, lambda: imu, lambda: None, state=state)  # type: ignore[arg-type, return-value]
    bench.safety.connect()
    bench.findings = bench.safety.findings
    end = SessionEnd.FINISHED
    try:
        yield bench
    except RigError as error:
        end = SessionEnd.of(error)
        raise
    finally:
        if wires.serial.is_open:  # else it was killed
            bench.safety.end_session(end)
        imu.close()


def kill(wires: Wires, motion: Generator[Any, None, None] | None = None) -> None:
    """End the program as by SIGKILL: no clean-up runs, the kernel closes its port, the servo continues."""
    _dead.append(motion)  # without a reference, the generator would be closed and its clean-up would run
    wires.serial.close()


_dead: list[Any] = []
