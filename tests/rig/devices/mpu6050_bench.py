"""A world with an MPU-6050 on a simulated I2C bus, and the driver once it is opened."""

from typing import Any

from rig.devices.mpu6050 import Mpu6050
from sim.i2c import SimI2cBus
from sim.imu.mpu6050 import SimMpu6050
from sim.motion import to_velocity
from sim.noise import NoiseModel
from sim.world import World

AT = 0x68


class Bench:
    """A world, the sensor in it, and the driver once it is opened."""

    def __init__(
        self,
        noise: NoiseModel | None = None,
        seed: int = 0,
        who_am_i: int | None = None,
        device: type[SimMpu6050] = SimMpu6050,
    ) -> None:
        self.world = World(noise=noise or NoiseModel.none(), seed=seed)
        self.clock = self.world.clock
        self.sensor = device(self.world, who_am_i=who_am_i)
        self.bus = SimI2cBus(self.clock)
        self.bus.attach(AT, self.sensor)
        self.imu: Mpu6050 | None = None

    def open(self, driver: type[Mpu6050] = Mpu6050, **settings: Any) -> Mpu6050:
        self.imu = driver(self.bus.path, clock=self.clock, **settings)
        return self.imu

    def __enter__(self) -> "Bench":
        return self

    def __exit__(self, *_: object) -> None:
        if self.imu:
            self.imu.close()
        self.bus.close()

    def rotate(self, dps: float) -> None:
        now_ns = self.clock.now_ns()
        self.world.drive(to_velocity(now_ns * 1e-9, self.world.table_deg(), dps, dps, 1.0))

    def write(self, *data: int) -> None:
        """Write a register as another program on the bus would, without the driver."""
        self.sensor.start(reading=False)
        self.sensor.write(bytes(data))
