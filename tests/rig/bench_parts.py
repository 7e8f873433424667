"""Real drivers on simulated wires, put together for the tests of the motion layer (no camera needed)."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from rig.bench import Bench
from rig.config import load_config
from rig.devices.dynamixel.bus import DynamixelBus
from rig.devices.dynamixel.port import READ_SLICE_S, ClockedPort
from rig.devices.dynamixel.register_servo import prepare_servo
from rig.devices.dynamixel.servo import DynamixelServo
from rig.devices.mpu6050 import Mpu6050
from sim.i2c import SimI2cBus
from sim.imu.mpu6050 import SimMpu6050
from sim.noise import NoiseModel
from sim.servo import Frame, ServoBus, SimSerial, Source, XSeriesServo
from sim.world import World


@dataclass
class Wires:
    """The simulated side of a bench, which the tests set."""

    world: World
    bus: ServoBus
    device: XSeriesServo
    serial: SimSerial
    sent: list[Frame] = field(default_factory=list)

    @property
    def instructions(self) -> list[bytes]:
        """What the host has sent."""
        return [frame.data for frame in self.sent if frame.source is Source.HOST]


def servo_wires(noise: NoiseModel | None = None, seed: int = 0, **servo: Any) -> Wires:
    world = World(noise=noise, seed=seed)
    bus = ServoBus(world.clock)
    device = XSeriesServo(world, **servo)
    bus.attach(device)
    wires = Wires(world, bus, device, SimSerial(bus, device.baudrate, READ_SLICE_S))
    bus.taps.append(wires.sent.append)
    return wires


def open_bus(wires: Wires, retries: int = 3) -> DynamixelBus:
    return DynamixelBus(ClockedPort(wires.serial, wires.world.clock, wires.serial.name), retries)


def open_servo(wires: Wires, **options: Any) -> DynamixelServo:
    servo = DynamixelServo(open_bus(wires), bus_id=1, model="xl430_w250", clock=wires.world.clock, **options)
    prepare_servo(servo, write=True)
    return servo


@contextmanager
def motion_bench(*settings: str, noise: NoiseModel | None = None, seed: int = 0) -> Iterator[tuple[Bench, Wires]]:
    """Yield a bench of servo and IMU, and its wires."""
    wires = servo_wires(noise, seed)
    with SimI2cBus(wires.world.clock) as i2c:
        i2c.attach(0x68, SimMpu6050(wires.world))
        servo = open_servo(wires)
        imu = Mpu6050(i2c.path, clock=wires.world.clock)
        config = load_config(overrides=settings)
        bench = Bench("test", config, wires.world.clock, servo, imu, camera=None)  # type: ignore[arg-type]
        bench.safety.connect()
        bench.safety.declare_turns(0)
        yield bench, wires
        imu.close()
