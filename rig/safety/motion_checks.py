"""What a servo's readings say about a motion: judged in every round of the control loop, and before a fault is let go.

Each limit lies before the servo's own shutdown, so that the table is stopped in order, and the cause is told.
"""

from collections import deque

from rig.config import MAX_LIMIT_DEG, SafetyConfig
from rig.core.clock import seconds_between
from rig.core.errors import (
    DeviceFault,
    FollowingError,
    NoProgress,
    Overheated,
    Overloaded,
    RigError,
    RotationDisagreement,
    Stalled,
    SupplyOutOfRange,
)
from rig.devices.servo import ServoLimits, ServoState
from rig.safety.gyro_rotation import Rotation

STANDING_DPS = 3.0
"""A shaft slower than this stands: two units of the servo's own velocity reading."""
VOLTAGE_S = 0.1
"""How long a voltage must last: starting motors make it dip."""
COOLER_C = 5.0
"""How much cooler than its limit a servo must be before it may work again."""


def implausible_readings(state: ServoState) -> list[str]:
    """Return the readings that no servo can have; such a reading is no ground for any command."""
    ranges = {
        "position": (state.position_deg, "°", MAX_LIMIT_DEG),
        "speed": (state.velocity_dps, "°/s", 3000.0),
        "load": (state.load_percent, "%", 500.0),
        "supply": (state.voltage_v, "V", 60.0),
        "temperature": (state.temperature_c, "°C", 150.0),
    }
    return [f"{name} {value:.0f} {unit}" for name, (value, unit, most) in ranges.items() if abs(value) > most]


def find_servo_fault(
    state: ServoState, config: SafetyConfig, limits: ServoLimits, *, again: bool = False
) -> RigError | None:
    """Return why a servo must not work, whether it turns or not: hardware errors, heat, supply; None if it may.

    Parameters
    ----------
    again
        It was found find_servo_fault before: it must have cooled down, not just ceased to be too hot.
    """
    evidence = {
        "temperature_c": state.temperature_c,
        "temperature_limit_c": limits.temperature_c,
        "voltage_v": round(state.voltage_v, 1),
        "voltage_limits_v": [round(v, 1) for v in limits.voltage_v],
        "load_percent": round(state.load_percent, 1),
    }
    if nonsense := implausible_readings(state):
        return DeviceFault(
            f"The servo's readings cannot be true: {nonsense[0]}.",
            next_step="Check its cable, then `rig acknowledge --reboot`; a servo that goes on like this is broken.",
            evidence={"readings": nonsense},
        )
    if state.hardware_errors:
        return DeviceFault(
            f"The servo reports a hardware error: {', '.join(state.hardware_errors)}.",
            next_step="Remove the cause (jam, heat, supply), then `rig acknowledge --reboot`.",
            evidence={"hardware_errors": list(state.hardware_errors), **evidence},
        )
    hottest_c = limits.temperature_c - config.temperature_margin_c
    if state.temperature_c >= hottest_c - (COOLER_C if again else 0.0):
        return Overheated(
            f"The servo is too hot: {state.temperature_c:.0f} °C, its own limit is {limits.temperature_c:.0f} °C.",
            next_step=f"Let it cool down below {hottest_c - COOLER_C:.0f} °C; look for what makes it work so hard.",
            evidence=evidence,
        )
    low_v, high_v = (limits.voltage_v[0] + config.voltage_margin_v, limits.voltage_v[1] - config.voltage_margin_v)
    if not low_v <= state.voltage_v <= high_v:
        return SupplyOutOfRange(
            f"The servo's supply is {state.voltage_v:.1f} V; {low_v:.1f} V to {high_v:.1f} V are safe.",
            next_step="Check the supply, its plug and its cable.",
            evidence=evidence,
        )
    return None


class MotionMonitor:
    """Judges the readings of one motion, the latest after all others.

    Parameters
    ----------
    config
        The limits.
    limits
        The servo's own.
    start_deg, goal_deg
        Of the table: where the motion began and where it is to end.
    tolerance_deg
        So close to the goal it has arrived.
    cruise_dps
        How fast the table turns at most.
    """

    def __init__(
        self,
        config: SafetyConfig,
        limits: ServoLimits,
        *,
        start_deg: float,
        goal_deg: float,
        tolerance_deg: float,
        cruise_dps: float,
    ) -> None:
        self._config = config
        self._limits = limits
        self._way_deg = (min(start_deg, goal_deg), max(start_deg, goal_deg))
        self._goal_deg = goal_deg
        self._tolerance_deg = tolerance_deg
        self._standing_dps = min(STANDING_DPS, cruise_dps / 2)
        self._standing_deg = min(tolerance_deg, cruise_dps * config.no_progress_s) / 2
        self._since_ns: dict[str, int] = {}
        self._stood: deque[tuple[int, float]] = deque()

    def look(self, state: ServoState, angle_deg: float, lag_deg: float | None) -> None:
        """Judge one reading.

        Parameters
        ----------
        state
            The servo's.
        angle_deg
            Of the table, by it.
        lag_deg
            How far the table is behind the servo's profile; None where that is not known.

        Raises
        ------
        DeviceFault, Overheated, SupplyOutOfRange, Stalled, Overloaded, FollowingError, NoProgress
            The motion must be stopped.
        """
        config = self._config
        self._stay_fit(state)
        evidence = {
            "goal_deg": round(self._goal_deg, 2),
            "encoder_deg": round(angle_deg, 2),
            "lag_deg": None if lag_deg is None else round(lag_deg, 2),
            "load_percent": round(state.load_percent, 1),
            "velocity_dps": round(state.velocity_dps, 1),
            "temperature_c": state.temperature_c,
            "voltage_v": round(state.voltage_v, 1),
        }
        standing = abs(state.velocity_dps) < self._standing_dps
        pushing = abs(state.load_percent) >= config.max_load_percent
        if self._lasts("stall", pushing and standing, state.time_ns, config.stall_s):
            raise Stalled(
                f"The table is blocked at {angle_deg:.1f}°: the servo pushes and nothing turns.",
                next_step="Remove what blocks it; look at the cable, too.",
                evidence=evidence,
            )
        if self._lasts("overload", pushing, state.time_ns, config.overload_s):
            raise Overloaded(
                f"The table is hard to turn: {abs(state.load_percent):.0f} % of what the servo can.",
                next_step="Look for what rubs or pulls (the cable, the bearing) and for too heavy an object.",
                evidence=evidence,
            )
        lagging = lag_deg is not None and abs(lag_deg) > config.following_error_deg
        if self._lasts("lag", lagging, state.time_ns, config.overload_s / 2):
            raise FollowingError(
                f"The table is {abs(lag_deg or 0.0):.1f}° from where the servo's profile wants it.",
                next_step="Look for what slows the table down; a weak supply does, too.",
                evidence=evidence,
            )
        beyond_deg = max(self._way_deg[0] - angle_deg, angle_deg - self._way_deg[1])
        if beyond_deg > config.following_error_deg:
            raise FollowingError(
                f"The table is at {angle_deg:.1f}°, which is not on its way to {self._goal_deg:.1f}°.",
                next_step="Look for what turned it, and at the angle that `rig status` tells.",
                evidence=evidence,
            )
        if abs(angle_deg - self._goal_deg) > self._tolerance_deg and self._stands_still(state.time_ns, angle_deg):
            raise NoProgress(
                f"The table stands at {angle_deg:.1f}°, and was told to go to {self._goal_deg:.1f}°.",
                next_step="Look at the servo's cable and supply, and turn the table by hand: is it free?",
                evidence=evidence,
            )

    def _stay_fit(self, state: ServoState) -> None:
        cause = find_servo_fault(state, self._config, self._limits)
        dip = isinstance(cause, SupplyOutOfRange)
        if cause is not None and (not dip or self._lasts("supply", True, state.time_ns, VOLTAGE_S)):
            raise cause
        if not dip:
            self._lasts("supply", False, state.time_ns, VOLTAGE_S)

    def _lasts(self, name: str, true: bool, time_ns: int, seconds: float) -> bool:
        """Return whether something has been true in every reading for so long."""
        if not true:
            self._since_ns.pop(name, None)
            return False
        return seconds_between(self._since_ns.setdefault(name, time_ns), time_ns) >= seconds

    def _stands_still(self, time_ns: int, angle_deg: float) -> bool:
        """Return whether the angle has not changed by more than its noise for ``no_progress_s``."""
        stood = self._stood
        if stood and abs(angle_deg - stood[0][1]) > self._standing_deg:
            stood.clear()
        stood.append((time_ns, angle_deg))
        return seconds_between(stood[0][0], time_ns) >= self._config.no_progress_s


class SlipMonitor:
    """Compares the platter's rotation, by the gyro, with the shaft's, by the encoder, while the table turns.

    The gyro's samples come in lots and late; so its rotation is compared with the encoder's of the same moment.
    """

    def __init__(self, config: SafetyConfig, start_deg: float) -> None:
        self._config = config
        self._start_deg = start_deg
        self._readings: deque[tuple[int, float]] = deque(maxlen=100)

    def note(self, time_ns: int, angle_deg: float) -> None:
        """Take a reading of the encoder."""
        self._readings.append((time_ns, angle_deg))

    def encoder_deg(self, until_ns: int) -> tuple[int, float] | None:
        """Return time and rotation of the newest reading not later than ``until_ns``; None where there is none."""
        for time_ns, angle_deg in reversed(self._readings):
            if time_ns <= until_ns:
                return time_ns, angle_deg - self._start_deg
        return None

    def compare(self, encoder_deg: float, gyro: Rotation) -> None:
        """Raise `RotationDisagreement` where the two differ by more than a slip that can be lived with."""
        difference_deg = encoder_deg - gyro.angle_deg
        bound_deg = self._config.slip_deg + 4 * gyro.sigma_deg
        if gyro.valid and abs(difference_deg) > bound_deg:
            raise RotationDisagreement(
                f"The servo turned {encoder_deg:.1f}° so far, the platter {gyro.angle_deg:.1f}°.",
                next_step="Tighten the platter. If it is tight: check imu.axis, imu.sign and table.direction.",
                evidence={"difference_deg": round(difference_deg, 2), "bound_deg": round(bound_deg, 2)},
            )
