"""An AX-12A over Protocol 1.0: a pan servo of 300°, with no count of turns and no watchdog."""

from rig.core.errors import ConfigError, DeviceFault
from rig.devices.dynamixel.register_servo import RegisterServo, hardware_errors
from rig.devices.dynamixel.settings import ServoMode
from rig.devices.servo import MotionProfile, ServoCondition, ServoState

RANGE_DEG, MAX_COUNTS = 300.0, 1023
DPS_PER_UNIT = 0.111 * 6.0
_DIRECTION = 0x400  # bit 10 of speed and load: clockwise, falling
_STEEPEST_DPS2 = 2000.0
"""It ramps as steeply as it can, and says nowhere how steep that is: an estimate from its 354 °/s."""
_ARRIVED_COUNTS = 2
"""Nearest that the compliance margin (1 count either way) lets it come to a goal, and one of noise."""


class Ax12Servo(RegisterServo):
    """An AX-12A; see `RegisterServo` for the parameters.

    Raises
    ------
    ConfigError
        It is to be a turntable: beyond its 300° it knows no angle.
    """

    deg_per_count = RANGE_DEG / MAX_COUNTS

    def __init__(self, *arguments: object, **options: object) -> None:
        if options.get("mode", ServoMode.TURNTABLE) is not ServoMode.PAN:
            raise ConfigError(
                "An AX-12A cannot be a turntable: it measures its angle over 300° only, and counts no turns.",
                next_step='In [table] set mode = "pan", zero_deg = 150 and limits_deg = [-150, 150] (its 300°), '
                "or take a servo of the X series.",
            )
        super().__init__(*arguments, **options)  # type: ignore[arg-type]

    @property
    def reach_deg(self) -> tuple[float, float]:
        return (
            self._read("CW Angle Limit") * self.resolution_deg,
            self._read("CCW Angle Limit") * self.resolution_deg,
        )

    @property
    def remarks(self) -> tuple[str, ...]:
        return (
            "servo: an AX-12A has no watchdog: when the computer dies during a move, it goes on to that move's end",
            "servo: an AX-12A reaches 300°: an object is seen from a part of its sides only",
        )

    def read_state(self) -> ServoState:
        time_ns, values = self._read_registers("Torque Enable", "Moving")
        moving = bool(values["Moving"])
        away = abs(values["Present Position"] - values["Goal Position"])
        return ServoState(
            time_ns=time_ns,
            position_deg=values["Present Position"] * self.resolution_deg,
            velocity_dps=_signed(values["Present Speed"]) * self._dps_per_unit,
            load_percent=_signed(values["Present Load"]) * 0.1,
            voltage_v=values["Present Voltage"] * 0.1,
            temperature_c=float(values["Present Temperature"]),
            moving=moving,
            in_position=bool(values["Torque Enable"]) and not moving and away <= _ARRIVED_COUNTS,
            hardware_errors=hardware_errors(self._bus.alert(self._id)),
        )

    def read_condition(self) -> ServoCondition:
        _, values = self._read_registers("Torque Enable", "Moving")
        return ServoCondition(
            torque=bool(values["Torque Enable"]),
            watchdog_armed=False,
            watchdog_tripped=False,
            power_lost=values["Moving Speed"] == 0,  # power-up's speed; the rig's is never 0
            hardware_errors=hardware_errors(self._bus.alert(self._id)),
        )

    def set_profile(self, profile: MotionProfile) -> MotionProfile:
        velocity = min(max(round(profile.velocity_dps / self._dps_per_unit), 1), MAX_COUNTS)
        self._write("Moving Speed", velocity)
        return MotionProfile(velocity * self._dps_per_unit, _STEEPEST_DPS2 / self._gear_ratio)

    def torque_on(self) -> None:
        position = self._read("Present Position")
        if errors := hardware_errors(self._bus.alert(self._id)):
            raise DeviceFault(
                f"Servo {self._id} reports a hardware error: {', '.join(errors)}.",
                next_step="Remove the cause (jam, heat, supply), then power-cycle the servo.",
                evidence={"hardware_errors": list(errors)},
            )
        self._write("Goal Position", position)  # switches the torque on by itself
        self._write("Torque Enable", 1)

    def arm_watchdog(self, timeout_s: float) -> None:
        """Do nothing: it has none, see `remarks`."""

    def disarm_watchdog(self) -> None:
        """Do nothing: it has none."""

    # -- inside ---------------------------------------------------------------------------------------------------

    @property
    def _dps_per_unit(self) -> float:
        return DPS_PER_UNIT / self._gear_ratio


def _signed(value: int) -> int:
    magnitude = value & (_DIRECTION - 1)
    return -magnitude if value & _DIRECTION else magnitude
