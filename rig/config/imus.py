"""The table of inertial sensors: one row for each. A supported sensor is its row and its driver.

`rig.config` takes the names and addresses from it, `rig.devices.imu` the driver, the search and the doctor the
identities, and the simulator the simulated sensor. A package adds rows by entry points of the group ``rig.imus``.

Decision: docs/decisions/0007.
"""

from dataclasses import dataclass
from typing import Final

from rig.core.plugins import plugins

GROUP = "rig.imus"


@dataclass(frozen=True, slots=True)
class ImuKind:
    """A row of the table."""

    key: str
    """Value of ``imu.model``."""
    name: str
    """Name in messages."""
    addresses: tuple[int, ...]
    """Possible I2C addresses, the default first."""
    register: int
    identities: tuple[int, ...]
    """The register that identifies the sensor, and its values."""
    driver: str = ""
    """``module:callable`` that opens the sensor and returns an `rig.devices.imu.Imu`; empty if there is no driver."""
    simulator: str = ""
    """``module:callable``, which takes the world and ``address``, and returns a `sim.imu.inertial.SimulatedImu`."""
    settings: tuple[str, ...] = ()
    """Keys of ``[imu]`` that the driver takes, apart from the address."""
    note: str = ""
    """Note on the sensor for the operator; reported when the bench is opened, and by ``rig doctor``."""


_AT: Final = (0x68, 0x69)  # AD0 low or high
_MPU: Final = ("range_dps", "rate_hz", "bandwidth_hz")
_CLONE: Final = (
    "a clone of the MPU-6050 without a datasheet: it passed a test of its samples and of gravity; "
    "its temperature may be wrong by 16 °C"
)
_BUILT_IN: Final = {
    row.key: row
    for row in (
        ImuKind(
            "mpu6050", "MPU-6050", _AT, 0x75, (0x68,), "rig.devices.mpu6050:Mpu6050", "sim.imu.mpu6050:SimMpu6050", _MPU
        ),
        ImuKind(
            "mpu6500", "MPU-6500", _AT, 0x75, (0x70,), "rig.devices.mpu6050:Mpu6500", "sim.imu.mpu6050:SimMpu6500", _MPU
        ),
        ImuKind(
            "mpu9250", "MPU-9250", _AT, 0x75, (0x71,), "rig.devices.mpu6050:Mpu9250", "sim.imu.mpu6050:SimMpu9250", _MPU
        ),
        ImuKind(
            "mpu6050_clone",
            "MPU-6050 clone",
            _AT,
            0x75,
            (0x72, 0x98),
            "rig.devices.mpu6050:Mpu6050Clone",
            "sim.imu.mpu6050:SimMpu6050Clone",
            _MPU,
            _CLONE,
        ),
        ImuKind(
            "bno055", "BNO055", (0x28, 0x29), 0x00, (0xA0,), "rig.devices.bno055:Bno055", "sim.imu.bno055:SimBno055"
        ),
        # Sensors that the search recognises, without a driver.
        ImuKind("mpu9255", "MPU-9255", _AT, 0x75, (0x73,)),
        ImuKind("icm20602", "ICM-20602", _AT, 0x75, (0x12,)),
        ImuKind("mpu6886", "MPU-6886", _AT, 0x75, (0x19,)),
        ImuKind("icm20948", "ICM-20948", _AT, 0x00, (0xEA,)),
        ImuKind("lsm6dsox", "LSM6DSOX", (0x6A, 0x6B), 0x0F, (0x6C,)),
    )
}
# What broken wires return: an undriven bus reads as all ones.
_NO_DEVICE: Final = {
    0x00: "no device: SDA is held low, or ground is missing",
    0xFF: "no device: SDA is not connected",
    0xFB: "a BNO055 whose registers are read at a wrong position: the bus loses clock pulses",
}

# Usual reasons for an answer from another chip.
_ALSO_AT: Final = {
    0x68: "the clocks DS1307 and DS3231 also have address 0x68",
    0x28: "a BNO080 or BNO085 uses another protocol at similar addresses",
}


def imu_kinds() -> dict[str, ImuKind]:
    """Return all rows by key; a row of another package replaces the row with the same key.

    Raises `ConfigError`: a package's row cannot be loaded.
    """
    return _BUILT_IN | {row.key: row for _, row in plugins(GROUP)}


def imu_kind(key: str) -> ImuKind:
    """Return the row of a sensor that has a driver.

    Raises `ValueError`: there is none. `ConfigError`: a package's row cannot be loaded.
    """
    row = _BUILT_IN.get(key)
    if row is None or not row.driver:
        row = imu_kinds().get(key)
    if row is None or not row.driver:
        supported = (other.key for other in imu_kinds().values() if other.driver)
        raise ValueError(f"use one of {', '.join(supported)}")
    return row


def recognised(address: int, register: int, value: int) -> ImuKind | None:
    """Return the sensor whose identity register has this value, None if the table has none."""
    rows = (row for row in imu_kinds().values() if address in row.addresses and row.register == register)
    return next((row for row in rows if value in row.identities), None)


def likely_device(wanted: ImuKind, address: int, value: int) -> str:
    """Describe what answers in place of the sensor ``wanted``, by the value of its identity register."""
    other = recognised(address, wanted.register, value)
    if other is not None:
        return other.name
    also = "".join(f"; {text}" for at, text in _ALSO_AT.items() if at in wanted.addresses)
    return _NO_DEVICE.get(value, f"another chip{also}")
