"""Opens the configured inertial sensor on an I2C bus."""

from rig.config import ImuConfig
from rig.core.clock import Clock
from rig.devices.bno055 import Bno055
from rig.devices.imu import Imu
from rig.devices.mpu6050 import Mpu6050


def open_imu(config: ImuConfig, bus: int | str, clock: Clock) -> Imu:
    """Open the sensor at ``config.address`` of ``bus`` (a number, or the path of a device file).

    Raises
    ------
    ConfigError, DeviceNotFound, DeviceMismatch, DeviceFault, DeviceSilent
        See the driver of the model.
    """
    if config.model == "bno055":
        return Bno055(bus, clock=clock, address=config.address)
    return Mpu6050(
        bus,
        clock=clock,
        address=config.address,
        range_dps=config.range_dps,
        rate_hz=config.rate_hz,
        bandwidth_hz=config.bandwidth_hz,
    )
