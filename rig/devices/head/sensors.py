"""Scales and settings of the sensors on a rig head."""

from collections.abc import Callable
from dataclasses import dataclass

from rig.config.imus import ImuKind
from rig.core.errors import ConfigError
from rig.devices import bno055, mpu6050
from rig.devices.head.protocol import Imu, ImuModel


@dataclass(frozen=True, slots=True)
class HeadSensor:
    """A sensor with its settings: its scales, and the request that sets it up.

    ``start_s`` is how long its start may take.
    """

    kind: ImuKind
    setup: Imu
    rate_hz: float
    range_dps: float
    noise_dps_rthz: float
    lsb_per_dps: float
    lsb_per_g: float
    temperature_c: Callable[[int], float]
    start_s: float


def head_sensor(kind: str, *, address: int, range_dps: int, rate_hz: float, bandwidth_hz: int) -> HeadSensor:
    """Return the sensor ``kind`` (``mpu6050`` or ``bno055``) with these settings; a BNO055 has its own rate and range.

    Raises
    ------
    ConfigError
        The sensor or the setting does not exist.
    """
    if kind == "bno055":
        return HeadSensor(
            kind=bno055.KIND,
            setup=Imu(ImuModel.BNO055, address, divider=0, filter=1, range=0),
            rate_hz=bno055.RATE_HZ,
            range_dps=bno055.RANGE_DPS,
            noise_dps_rthz=bno055.NOISE_DPS_RTHZ,
            lsb_per_dps=bno055.LSB_PER_DPS,
            lsb_per_g=1000.0,
            temperature_c=float,
            start_s=6.0,
        )
    if kind != "mpu6050":
        raise ConfigError(
            f"A rig head does not support the sensor {kind!r}.",
            next_step="Set imu.model to mpu6050 or bno055, or connect the sensor to the computer's own I2C bus.",
        )
    divider, dlpf, full_scale, _ = mpu6050.settings(range_dps, rate_hz, bandwidth_hz)[mpu6050.SMPLRT_DIV]
    return HeadSensor(
        kind=mpu6050.Mpu6050.KIND,
        setup=Imu(ImuModel.MPU6050, address, divider=divider, filter=dlpf, range=full_scale >> 3),
        rate_hz=1000.0 / (divider + 1),
        range_dps=32767 / mpu6050.LSB_PER_DPS[range_dps],
        noise_dps_rthz=mpu6050.NOISE_DPS_RTHZ,
        lsb_per_dps=mpu6050.LSB_PER_DPS[range_dps],
        lsb_per_g=mpu6050.LSB_PER_G,
        temperature_c=lambda raw: raw / 340 + 36.53,
        start_s=0.6,
    )
