"""The simulated servo that a configuration describes."""

from rig.config import ServoConfig
from rig.core.errors import ConfigError
from rig.devices.dynamixel.registers import protocol_of
from sim.servo.ax12 import AX_12A, Ax12Servo
from sim.servo.device import XSeriesServo
from sim.servo.models import servo_model
from sim.servo.shaft import Geared, Shaft
from sim.world import World

SimulatedServo = XSeriesServo | Ax12Servo


def simulated_servo(world: World, config: ServoConfig) -> SimulatedServo:
    """Return the servo that ``config`` describes, with factory settings, on the table's shaft or behind its gear.

    Raises `ConfigError` if there is no simulated servo of that model, or the model does not have the baud rate.
    """
    shaft: Shaft = world if config.gear_ratio == 1 else Geared(world, config.gear_ratio)
    try:
        if protocol_of(config.model) == 1:
            model = AX_12A if config.model == AX_12A.name else servo_model(config.model)
            return Ax12Servo(shaft, model, bus_id=config.id, baudrate=config.baud)
        return XSeriesServo(shaft, config.model, bus_id=config.id, baudrate=config.baud)
    except ValueError as error:
        raise ConfigError(
            "The simulated bench has no such servo.",
            next_step="Correct servo.model or servo.baud.",
            evidence={"reason": str(error)},
        ) from error
