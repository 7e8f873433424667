"""Opens the configured inertial sensor on an I2C bus."""

from pkgutil import resolve_name

from rig.config import ImuConfig
from rig.config.imus import imu_kind
from rig.core.clock import Clock
from rig.core.errors import ConfigError
from rig.devices.imu import Imu, ImuDriver


def open_imu(config: ImuConfig, bus: int | str, clock: Clock) -> Imu:
    """Open the sensor at ``config.address`` of ``bus`` (a number, or the path of a device file).

    Raises
    ------
    ConfigError, DeviceNotFound, DeviceMismatch, DeviceFault, DeviceSilent
        The driver of a plug-in cannot be loaded; otherwise see the driver of the model.
    """
    kind = imu_kind(config.model)
    try:
        driver: ImuDriver = resolve_name(kind.driver)
    except (ImportError, AttributeError, ValueError) as error:
        raise ConfigError(
            f"The driver {kind.driver} of the {kind.name} cannot be loaded.",
            next_step="Fix or uninstall the package that provides it, or set imu.model to another sensor.",
            evidence={"reason": str(error)},
        ) from error
    settings = {name: getattr(config, name) for name in kind.settings}
    return driver(bus, clock=clock, address=config.address, **settings)
