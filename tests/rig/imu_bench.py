"""A world with an inertial sensor on a simulated I2C bus, and its driver once it is opened."""

from typing import Any

from rig.devices.mpu6050 import Mpu6050
from sim.i2c import SimI2cBus
from sim.imu.mpu6050 import SimMpu6050
from sim.motion import to_velocity
from sim.noise import NoiseModel
from sim.world import World

AT = 0x68


class ImuBench:
    """A world, the sensor in it, and the driver once it is opened; ``options`` are those of the simulated sensor."""

    def __init__(
        self,
        noise: NoiseModel | None = None,
        seed: int = 0,
        device: Any = SimMpu6050,
        driver: Any = Mpu6050,
        **options: Any,
    ) -> None:
        self.world = World(noise=noise or NoiseModel.none(), seed=seed)
        self.clock = self.world.clock
        self.sensor = device(self.world, **options)
        self.bus = SimI2cBus(self.clock)
        self.bus.attach(self.sensor.address, self.sensor)
        self.driver = driver
        self.imu: Any = None

    def open(self, driver: Any = None, **settings: Any) -> Any:
        self.imu = (driver or self.driver)(self.bus.path, clock=self.clock, **settings)
        return self.imu

    def __enter__(self) -> "ImuBench":
        return self

    def __exit__(self, *_: object) -> None:
        if self.imu:
            self.imu.close()
        self.bus.close()

    def rotate(self, dps: float) -> None:
        self.world.drive(to_velocity(self.clock.now_ns() * 1e-9, self.world.table_deg(), dps, dps, 1.0))

    def write(self, *data: int) -> None:
        """Write a register as another program on the bus would, without the driver."""
        self.sensor.start(reading=False)
        self.sensor.write(bytes(data))
