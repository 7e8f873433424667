"""The AX-12A with Protocol 1.0: a pan servo with a range of 300°, without count of revolutions and without watchdog.

Decision: docs/decisions/0011.
"""

from rig.core.errors import ConfigError
from rig.devices.dynamixel.register_servo import RegisterServo, hardware_errors
from rig.devices.dynamixel.settings import ServoMode
from rig.devices.servo import MotionProfile, ServoCondition, ServoState

RANGE_DEG, MAX_COUNTS = 300.0, 1023
DPS_PER_UNIT = 0.111 * 6.0
_DIRECTION = 0x400  # bit 10 of speed and load: clockwise, the position falls
_STEEPEST_DPS2 = 2000.0  # its fastest acceleration, estimated from its 354 °/s, because no document states it
_ARRIVED_COUNTS = 2  # largest distance from the goal at rest: the compliance margin of 1 count, and 1 count of noise


class Ax12Servo(RegisterServo):
    """An AX-12A; see `RegisterServo` for the parameters.

    Raises
    ------
    ConfigError
        The mode is turntable, but the servo measures only 300°.
    """

    deg_per_count = RANGE_DEG / MAX_COUNTS

    def __init__(self, *arguments: object, **options: object) -> None:
        if options.get("mode", ServoMode.TURNTABLE) is not ServoMode.PAN:
            raise ConfigError(
                "An AX-12A cannot be a turntable: it measures only 300° and does not count revolutions.",
                next_step='In [table] set mode = "pan", zero_deg = 150 and limits_deg = [-150, 150] (its 300°), '
                "or use a servo of the X series.",
            )
        super().__init__(*arguments, **options)  # type: ignore[arg-type]

    @property
    def reach_deg(self) -> tuple[float, float]:
        return (self._read("CW Angle Limit") * self.resolution_deg, self._read("CCW Angle Limit") * self.resolution_deg)

    @property
    def remarks(self) -> tuple[str, ...]:
        return (
            "an AX-12A has no watchdog: if the computer fails, it completes its present move",
            "an AX-12A reaches only 300°: some azimuths of an object are not visible",
        )

    def read_state(self) -> ServoState:
        time_ns, values = self._read_registers("Torque Enable", "Moving")
        moving = bool(values["Moving"])
        away = abs(values["Present Position"] - values["Goal Position"])
        return ServoState(
            time_ns=time_ns,
            sampled_ns=self.bus.sampled_ns,
            position_deg=values["Present Position"] * self.resolution_deg,
            velocity_dps=_signed(values["Present Speed"]) * self._dps_per_unit,
            load_percent=_signed(values["Present Load"]) * 0.1,
            voltage_v=values["Present Voltage"] * 0.1,
            temperature_c=float(values["Present Temperature"]),
            moving=moving,
            in_position=bool(values["Torque Enable"]) and not moving and away <= _ARRIVED_COUNTS,
            hardware_errors=hardware_errors(self.bus.alert(self._id)),
        )

    def read_condition(self) -> ServoCondition:
        _, values = self._read_registers("Torque Enable", "Moving")
        return ServoCondition(
            torque=bool(values["Torque Enable"]),
            watchdog_armed=False,
            watchdog_tripped=False,
            power_lost=values["Moving Speed"] == 0,  # 0 after power-up; the rig never sets 0
            hardware_errors=hardware_errors(self.bus.alert(self._id)),
        )

    def set_profile(self, profile: MotionProfile) -> MotionProfile:
        velocity = min(max(round(profile.velocity_dps / self._dps_per_unit), 1), MAX_COUNTS)
        self._write("Moving Speed", velocity)
        return MotionProfile(velocity * self._dps_per_unit, _STEEPEST_DPS2 / self._gear_ratio)

    def _switch_torque_on(self) -> None:
        position = self._read("Present Position")
        self._reject_errors(hardware_errors(self.bus.alert(self._id)))
        self._write("Goal Position", position)  # this also switches the torque on
        self._write("Torque Enable", 1)

    def arm_watchdog(self, timeout_s: float) -> None:
        """Do nothing: the servo has no watchdog, see `remarks`."""

    def disarm_watchdog(self) -> None:
        """Do nothing: the servo has no watchdog."""

    @property
    def _dps_per_unit(self) -> float:
        return DPS_PER_UNIT / self._gear_ratio


def _signed(value: int) -> int:
    magnitude = value & (_DIRECTION - 1)
    return -magnitude if value & _DIRECTION else magnitude
