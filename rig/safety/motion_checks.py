"""Checks of a servo's readings: in each round of the control loop, and before a fault is acknowledged.

Each limit is reached before the servo's own shutdown, so that the table stops in a controlled way and the cause is
reported.
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
from rig.core.next_steps import Do
from rig.core.phrases import angle_words
from rig.devices.servo import ServoLimits, ServoState
from rig.safety.gyro_rotation import Rotation

STANDING_DPS = 3.0
"""Speed below which the shaft counts as standing still: two units of the servo's velocity reading."""
HELD_DEG = 2.0
"""Distance from the goal up to which friction holds the table, because the servo's position controller is too weak."""
STALL_S = 0.25  # six readings; longer: what blocks the table, perhaps a hand, is pressed for longer
"""How long the servo may push without rotating."""
OVERLOAD_S = 0.8  # a start takes 0.4 s with the default profile
"""How long the servo may rotate with overload: longer than a start takes."""
LAG_S = OVERLOAD_S / 2
"""How long the shaft may lag behind the servo's profile."""
NO_PROGRESS_S = 1.0  # longer than stick-slip friction holds the table; shorter than an operator waits
"""How long the servo may stand still before its goal."""
VOLTAGE_S = 0.1
"""How long a bad voltage must last: starting motors make it dip."""
COOLER_C = 5.0  # smaller: a servo that has just cooled down is too hot again after a few moves
"""Difference between its limit and the temperature at which a servo may work again."""


def implausible_readings(state: ServoState) -> list[str]:
    """Return the readings that are impossible for any servo; no command may be based on them."""
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
    """Return the error that forbids a servo to work (hardware error, temperature, supply); None if it may work.

    ``again`` if the servo had a fault before: it must also have cooled down by `COOLER_C`.
    """
    evidence = {
        "temperature_c": state.temperature_c,
        "temperature_limit_c": limits.temperature_c,
        "voltage_v": round(state.voltage_v, 1),
        "voltage_limits_v": [round(v, 1) for v in limits.voltage_v],
        "load_percent": round(state.load_percent, 1),
    }
    # In the order of trust: impossible readings make all others doubtful.
    if nonsense := implausible_readings(state):
        return DeviceFault(
            f"The servo's readings are impossible: {nonsense[0]}.",
            next_step=("Check its cable. If this repeats, replace the servo.", Do.ACKNOWLEDGE(reboot=True)),
            evidence={"readings": nonsense},
        )
    if state.hardware_errors:
        return DeviceFault(
            f"The servo reports a hardware error: {', '.join(state.hardware_errors)}.",
            next_step=("Remove the cause (jam, heat, supply).", Do.ACKNOWLEDGE(reboot=True)),
            evidence={"hardware_errors": list(state.hardware_errors), **evidence},
        )
    # Before the servo's own shutdown, which would release a loaded table.
    hottest_c = limits.temperature_c - config.temperature_margin_c
    if state.temperature_c >= hottest_c - (COOLER_C if again else 0.0):
        return Overheated(
            f"The servo is too hot: {state.temperature_c:.0f} °C, its own limit is {limits.temperature_c:.0f} °C.",
            next_step=f"Let it cool down below {hottest_c - COOLER_C:.0f} °C; look for what overloads it.",
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
    """Checks the servo's readings during one motion between two table angles.

    ``limits`` are those at which the servo shuts down. ``tolerance_deg`` is the distance from the goal that counts as
    arrived, ``cruise_dps`` the highest speed of the table.
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
        self._path_deg = (min(start_deg, goal_deg), max(start_deg, goal_deg))
        self._goal_deg = goal_deg
        self._tolerance_deg = tolerance_deg
        self._standing_dps = min(STANDING_DPS, cruise_dps / 2)
        self._standing_deg = min(tolerance_deg, cruise_dps * NO_PROGRESS_S) / 2
        self._since_ns: dict[str, int] = {}
        self._stood: deque[tuple[int, float]] = deque()

    def check(self, state: ServoState, angle_deg: float, lag_deg: float | None) -> None:
        """Check one reading, by which the table is at ``angle_deg``.

        ``lag_deg`` is the angle by which the table is behind the servo's profile; None if that is not known.

        Raises `DeviceFault`, `Overheated`, `SupplyOutOfRange`, `Stalled`, `Overloaded`, `FollowingError`, `NoProgress`:
        the motion must be stopped.
        """
        config = self._config
        self._check_servo(state)
        evidence = {
            "goal_deg": round(self._goal_deg, 2),
            "encoder_deg": round(angle_deg, 2),
            "lag_deg": None if lag_deg is None else round(lag_deg, 2),
            "load_percent": round(state.load_percent, 1),
            "velocity_dps": round(state.velocity_dps, 1),
            "temperature_c": state.temperature_c,
            "voltage_v": round(state.voltage_v, 1),
        }
        # Load: a blocked table, then one that is hard to rotate.
        standing = abs(state.velocity_dps) < self._standing_dps
        pushing = abs(state.load_percent) >= config.max_load_percent
        if self._lasts("stall", pushing and standing, state.time_ns, STALL_S):
            raise Stalled(
                f"The table is blocked at {angle_words(angle_deg)}: the servo pushes, but the table does not rotate.",
                next_step="Remove what blocks the table; check the cable, too.",
                evidence=evidence,
            )
        if self._lasts("overload", pushing, state.time_ns, OVERLOAD_S):
            raise Overloaded(
                f"The table is hard to rotate: {abs(state.load_percent):.0f} % of the servo's torque.",
                next_step="Look for friction (cable, bearing) and for an object that is too heavy.",
                evidence=evidence,
            )
        # Position: behind the profile, then off the path.
        lagging = lag_deg is not None and abs(lag_deg) > config.following_error_deg
        if self._lasts("lag", lagging, state.time_ns, LAG_S):
            raise FollowingError(
                f"The table is {abs(lag_deg or 0.0):.1f}° away from the servo's motion profile.",
                next_step="Look for what slows the table down; a weak supply is a possible cause.",
                evidence=evidence,
            )
        beyond_deg = max(self._path_deg[0] - angle_deg, angle_deg - self._path_deg[1])
        if beyond_deg > config.following_error_deg:
            raise FollowingError(
                f"The table is at {angle_words(angle_deg)}, which is not on its path to {angle_words(self._goal_deg)}.",
                next_step=("Find out what rotated the table.", Do.STATUS()),
                evidence=evidence,
            )
        # Progress: at rest away from the goal.
        away_deg = abs(angle_deg - self._goal_deg)
        if away_deg > self._tolerance_deg and self._stands_still(state.time_ns, angle_deg):
            if not state.moving and away_deg <= HELD_DEG:
                raise NoProgress(
                    f"The table rests at {angle_words(angle_deg)}, {away_deg:.1f}° from its goal: "
                    "friction or a load holds it.",
                    next_step="Reduce the friction (bearing, cable), or balance the load. Or set table.tolerance_deg "
                    f"above {away_deg:.1f}: each view stores the measured angle.",
                    evidence=evidence,
                )
            raise NoProgress(
                f"The table stands still at {angle_words(angle_deg)} on its way to {angle_words(self._goal_deg)}.",
                next_step="Check the servo's cable and supply, and check that the table rotates freely by hand.",
                evidence=evidence,
            )

    def _check_servo(self, state: ServoState) -> None:
        cause = find_servo_fault(state, self._config, self._limits)
        # A dip of the supply must last, because starting motors cause short ones. All else stops the table at once.
        dip = isinstance(cause, SupplyOutOfRange)
        if cause is not None and (not dip or self._lasts("supply", True, state.time_ns, VOLTAGE_S)):
            raise cause
        if not dip:
            self._lasts("supply", False, state.time_ns, VOLTAGE_S)

    def _lasts(self, name: str, holds: bool, time_ns: int, seconds: float) -> bool:
        """Return whether a condition has been true in all readings for this time."""
        if not holds:
            self._since_ns.pop(name, None)
            return False
        return seconds_between(self._since_ns.setdefault(name, time_ns), time_ns) >= seconds

    def _stands_still(self, time_ns: int, angle_deg: float) -> bool:
        """Return whether the angle has not changed by more than its noise for `NO_PROGRESS_S`."""
        # The readings since the table came near its present angle; the first one says how long that is ago.
        stood = self._stood
        if stood and abs(angle_deg - stood[0][1]) > self._standing_deg:
            stood.clear()
        stood.append((time_ns, angle_deg))
        return seconds_between(stood[0][0], time_ns) >= NO_PROGRESS_S


class SlipMonitor:
    """Compares the platter's rotation (gyro) with the shaft's rotation (encoder) during a motion.

    The gyro's samples arrive late and in groups, so each is compared with the encoder reading of the same time.
    """

    def __init__(self, config: SafetyConfig, start_deg: float) -> None:
        self._config = config
        self._start_deg = start_deg
        self._readings: deque[tuple[int, float]] = deque(maxlen=100)

    def add_reading(self, time_ns: int, angle_deg: float) -> None:
        """Add a reading of the encoder."""
        self._readings.append((time_ns, angle_deg))

    def encoder_deg(self, until_ns: int) -> tuple[int, float] | None:
        """Return time and rotation of the newest reading not later than ``until_ns``; None if there is none."""
        for time_ns, angle_deg in reversed(self._readings):
            if time_ns <= until_ns:
                return time_ns, angle_deg - self._start_deg
        return None

    def compare(self, encoder_deg: float, gyro: Rotation) -> None:
        """Raise `RotationDisagreement` if the two differ by more than an acceptable slip."""
        difference_deg = encoder_deg - gyro.angle_deg
        bound_deg = self._config.slip_deg + 4 * gyro.sigma_deg
        if gyro.valid and abs(difference_deg) > bound_deg:
            raise RotationDisagreement(
                f"The servo rotated by {angle_words(encoder_deg)} so far, but the platter by "
                f"{angle_words(gyro.angle_deg)}.",
                next_step="Tighten the platter. If it is tight, check imu.axis, imu.sign and table.direction.",
                evidence={"difference_deg": round(difference_deg, 2), "bound_deg": round(bound_deg, 2)},
            )
