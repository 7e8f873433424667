"""A servo as the configuration describes it, on an open wire."""

from collections.abc import Callable

from rig.config import ServoConfig
from rig.core.clock import Clock
from rig.devices.dynamixel.ax12 import Ax12Servo
from rig.devices.dynamixel.bus import DynamixelBus
from rig.devices.dynamixel.port import ClockedPort, SerialConnection
from rig.devices.dynamixel.register_servo import RegisterServo
from rig.devices.dynamixel.registers import protocol_of
from rig.devices.dynamixel.servo import DynamixelServo
from rig.devices.dynamixel.settings import ServoMode


def open_servo(
    wire: SerialConnection,
    config: ServoConfig,
    clock: Clock,
    mode: str = "turntable",
    reopen: Callable[[], SerialConnection] | None = None,
) -> RegisterServo:
    """Find the configured servo on ``wire``, to be used as ``mode`` (`table.mode`) says; writes nothing.

    ``reopen`` opens the wire anew after its adapter was unplugged.

    Raises
    ------
    ConfigError
        There is no such model, or it cannot be what it is to be used for.
    DeviceNotFound, DeviceMismatch, DeviceSilent
        Nobody answers, another model does, or it stops answering.
    """
    protocol = protocol_of(config.model)
    kind = Ax12Servo if protocol == 1 else DynamixelServo
    return kind(
        DynamixelBus(ClockedPort(wire, clock, config.port, reopen), config.retries, protocol),
        bus_id=config.id,
        model=config.model,
        clock=clock,
        mode=ServoMode(mode),
        gear_ratio=config.gear_ratio,
    )
