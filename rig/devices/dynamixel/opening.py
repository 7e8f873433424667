"""Opens the configured servo on an open serial connection."""

from collections.abc import Callable

from rig.config import ServoConfig
from rig.core.clock import Clock
from rig.devices.dynamixel.ax12 import Ax12Servo
from rig.devices.dynamixel.bus import DynamixelBus
from rig.devices.dynamixel.guardian import Guardian
from rig.devices.dynamixel.port import ClockedPort, SerialConnection
from rig.devices.dynamixel.registers import DynamixelModel, protocol_of, servo_plugin
from rig.devices.dynamixel.servo import DynamixelServo
from rig.devices.dynamixel.settings import ServoMode
from rig.devices.servo import Servo


def open_servo(
    connection: SerialConnection,
    config: ServoConfig,
    clock: Clock,
    mode: str = "turntable",
    reopen: Callable[[], SerialConnection] | None = None,
    guardian: Guardian | None = None,
) -> Servo:
    """Return the configured servo on ``connection``, for ``mode`` (`table.mode`); write nothing.

    ``reopen`` opens the connection again after its adapter was unplugged. ``guardian`` switches the torque off if this
    program is killed.

    Raises
    ------
    ConfigError
        The model does not exist, or does not support the mode.
    DeviceNotFound, DeviceMismatch, DeviceSilent
        No servo answers, another model answers, or the servo stops answering.
    """
    driver = servo_plugin(config.model)
    if driver is not None and not isinstance(driver, DynamixelModel):
        opened: Servo = driver(connection, config, clock, mode=mode, reopen=reopen)
        return opened
    protocol = protocol_of(config.model)
    kind = Ax12Servo if protocol == 1 else DynamixelServo
    return kind(
        DynamixelBus(ClockedPort(connection, clock, config.port, reopen), config.retries, protocol),
        bus_id=config.id,
        model=config.model,
        clock=clock,
        mode=ServoMode(mode),
        gear_ratio=config.gear_ratio,
        guardian=guardian,
    )
