"""The end of a motion: whether the table has arrived, why a motion failed, and how a moving table stops.

Decision: docs/decisions/0005.
"""

from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from math import copysign, isfinite

from rig.config import SafetyConfig, TableConfig
from rig.core.clock import Clock, seconds_between
from rig.core.errors import (
    DeviceFault,
    DeviceSilent,
    FollowingError,
    MotionTimeout,
    NoProgress,
    RequestRejected,
    RigError,
    SupplyLost,
    TorqueStaysOn,
    WatchdogTripped,
)
from rig.core.next_steps import START_AGAIN
from rig.core.phrases import angle_words
from rig.devices.servo import Servo, ServoState
from rig.safety.angle_reference import OVERSHOOT_DEG
from rig.safety.gyro_rotation import GyroRotationMeter, finite
from rig.safety.motion_checks import find_servo_fault, implausible_readings

QUIET_COUNTS = 3
"""Encoder counts by which readings at rest may differ: one of quantisation, the others of noise."""
QUIET_DEG = 0.01  # less: a fine encoder shows the bench's own vibration; a view needs a tenth of a degree
"""The same angle for a fine encoder, such as that of a P-series servo with 0.0004° for each count."""
STILL_S = 0.01  # shorter: a slow table seems to rest; longer: each start waits
"""Time between two readings that show whether the table moves at all."""
STALE_S = 0.05  # just more than a period of the control loop, 0.04 s
"""Age at which a reading is too old for a goal: the computer paused after it."""
READINGS = 8  # more: a bad bus is tolerated for longer; each takes a transaction
"""Number of readings that are taken to find two that agree."""
AGREEMENTS = 3
"""Number of successive readings that must agree if the table cannot have reached them since the last trusted one."""
# longer: a table that does not obey rotates on; shorter: a stop of a heavy table ends with its torque off
STOP_ALLOWANCE_S = 0.5
"""Time for a stop in addition to its ramp; then the torque goes off in any case."""


@dataclass(slots=True)
class MotionPath:
    """The range of the servo's positions in a motion, the highest speed, and the last trusted reading."""

    ends_deg: tuple[float, float]
    cruise_dps: float
    trusted: ServoState | None = None

    def reaches(self, state: ServoState) -> bool:
        """Return whether the table can have rotated from the last trusted reading to this one."""
        if self.trusted is None:
            return True
        passed_s = seconds_between(self.trusted.time_ns, state.time_ns)
        return abs(state.position_deg - self.trusted.position_deg) <= 1.5 * self.cruise_dps * passed_s + OVERSHOOT_DEG

    def add(self, state: ServoState) -> None:
        """Trust a reading if the table can have rotated there."""
        if self.reaches(state):
            self.trusted = state


def quiet_deg(servo: Servo) -> float:
    """Return the angle by which the servo's readings at rest may differ."""
    return max(QUIET_COUNTS * servo.resolution_deg, QUIET_DEG)


def stopping_deg(state: ServoState, ramp_dps2: float, later_s: float, trusted_lag_deg: float) -> float:
    """Return the servo's position at which a motion ends that brakes ``later_s`` after a reading.

    It is the servo's profile that brakes, and the shaft follows it with a lag. To a goal computed from the shaft, the
    profile could not brake in time: the table would overshoot and come back. The shaft counts if the servo does not
    report its profile, or one that is farther away than it can be from a table that follows it. Then a goal from the
    profile would rotate the table on, against what blocks it, or to where a false reading says.
    """
    angle_deg, rate_dps = state.position_deg, state.velocity_dps
    if state.trajectory_deg is not None and abs(state.trajectory_deg - angle_deg) <= trusted_lag_deg:
        angle_deg = state.trajectory_deg
        rate_dps = rate_dps if state.trajectory_dps is None else state.trajectory_dps
    return angle_deg + copysign(rate_dps**2 / (2 * ramp_dps2), rate_dps) + rate_dps * later_s


def halt(
    servo: Servo,
    clock: Clock,
    set_goal: Callable[[float], None],
    path: MotionPath,
    ramp_dps2: float,
    trusted_lag_deg: float,
    poll_s: float,
) -> bool:
    """Bring the table to a stop along its ramp; return False if the servo does not answer (its watchdog stops it).

    The goal is that of `stopping_deg`, but never beyond the path of the motion. Without two readings that agree, the
    position is not known; then the torque goes off and the table stops by friction.
    """
    try:
        state = _agreed_reading(servo, clock, path)
        if state is None:
            servo.torque_off()
            if servo.read_condition().watchdog_armed:  # or the next program would find it armed
                servo.disarm_watchdog()
            return True
        bus_s = 2 * min(seconds_between(state.time_ns, clock.now_ns()), STALE_S)  # for the answer and the goal
        low_deg, high_deg = path.ends_deg
        set_goal(min(max(stopping_deg(state, ramp_dps2, bus_s, trusted_lag_deg), low_deg), high_deg))
        fastest_dps = max(abs(state.velocity_dps), abs(state.trajectory_dps or 0.0))
        deadline_ns = clock.now_ns() + round((fastest_dps / ramp_dps2 + STOP_ALLOWANCE_S) * 1e9)
        while (state.moving or state.velocity_dps) and clock.now_ns() < deadline_ns:
            clock.sleep(poll_s)
            state = servo.read_state()
        servo.disarm_watchdog()
    except DeviceSilent:
        return False
    except TorqueStaysOn:
        raise
    except RigError:  # the servo rejects the goal: its watchdog stopped it already, or its torque is off
        return True
    return True


def _agreed_reading(servo: Servo, clock: Clock, path: MotionPath) -> ServoState | None:
    """Return a fresh reading of a moving table that agrees with the one before it; None if there is none.

    The two agree if the angle between them is the speed times the time between them. If the table cannot have reached
    this angle (a false reading, or the encoder slipped), more readings must agree. Readings of a table that stands
    still do not count: if the readings are stuck, a goal from them would rotate the table.
    """
    low_deg, high_deg = path.ends_deg
    earlier, agreeing = servo.read_state(), 0
    for _ in range(READINGS):
        clock.sleep(STILL_S)
        later = servo.read_state()
        passed_s = seconds_between(earlier.time_ns, later.time_ns)
        moved_deg = later.position_deg - earlier.position_deg
        expected_deg = passed_s * (earlier.velocity_dps + later.velocity_dps) / 2
        noise_deg = quiet_deg(servo)
        plausible = (
            not implausible_readings(later)
            and low_deg - OVERSHOOT_DEG <= later.position_deg <= high_deg + OVERSHOOT_DEG
            and abs(moved_deg - expected_deg) <= noise_deg + abs(expected_deg) / 2
        )
        if plausible and abs(moved_deg) < noise_deg:
            return None  # it stands still
        agreeing = agreeing + 1 if plausible else 0
        needed = 1 if path.reaches(later) else AGREEMENTS
        if agreeing >= needed and seconds_between(later.time_ns, clock.now_ns()) <= STALE_S:
            return later
        earlier = later
    return None


@dataclass(slots=True)
class Arrival:
    """Decides from readings whether the table has arrived at a goal and is at rest there.

    Encoder and gyro must be quiet for ``quiet_s``; with 0 it is enough to arrive. All this may take ``allowed_s``.
    """

    servo: Servo
    gyro: GyroRotationMeter
    clock: Clock
    config: TableConfig
    goal_deg: float
    quiet_s: float
    allowed_s: float
    has_arrived: bool = field(default=False, init=False)
    """Whether the last reading was at the goal, perhaps not at rest yet."""
    _begun_ns: int = field(init=False)
    _readings: deque[tuple[int, float]] = field(default_factory=deque)

    def __post_init__(self) -> None:
        self._begun_ns = self.clock.now_ns()

    def rest_deg(self, state: ServoState, angle_deg: float) -> float | None:
        """Return the table's angle at rest; None if it is not at rest yet, by this reading of the servo.

        Raises `MotionTimeout`, `DeviceFault`: the time is over: the table has not arrived, it shakes, or the gyro
        fails.
        """
        readings = self._readings
        arrived = not state.moving and abs(angle_deg - self.goal_deg) <= self.config.tolerance_deg
        self.has_arrived = arrived
        if not arrived:
            readings.clear()
        # Besides the newest, a reading for each period counts: of more, the noise would spread further.
        if len(readings) > 1 and seconds_between(readings[-2][0], readings[-1][0]) < self.config.poll_s:
            readings.pop()
        readings.append((state.time_ns, angle_deg))
        if arrived and self._is_quiet() and (state.in_position or self._holds()):
            return sum(angle for _, angle in readings) / len(readings)
        if seconds_between(self._begun_ns, self.clock.now_ns()) > self.allowed_s:
            raise self._late(state, angle_deg, arrived=arrived)
        return None

    def _is_quiet(self) -> bool:
        """Return whether the readings span the time without a motion; drop older readings."""
        readings, quiet_s = self._readings, self.quiet_s
        while len(readings) > 1 and seconds_between(readings[1][0], readings[-1][0]) >= quiet_s:
            readings.popleft()
        if seconds_between(readings[0][0], readings[-1][0]) < quiet_s:
            return False
        angles = [angle for _, angle in readings]
        if max(angles) - min(angles) > quiet_deg(self.servo):
            return False
        if quiet_s == 0 or self.gyro.bias is None:
            return True
        return self.gyro.peak_dps(quiet_s) <= self.config.quiet_dps

    def _holds(self) -> bool:
        """Return whether the servo's torque is on; without torque there is no motion profile."""
        condition = self.servo.read_condition()
        return condition.torque and not condition.power_lost

    def _late(self, state: ServoState, angle_deg: float, *, arrived: bool) -> RigError:
        goal, peak_dps = angle_words(self.goal_deg), self.gyro.peak_dps(self.config.quiet_s)
        evidence = {
            "goal_deg": round(self.goal_deg, 2),
            "encoder_deg": round(angle_deg, 2),
            "in_position": state.in_position,
            "moving": state.moving,
            "peak_rate_dps": finite(peak_dps),
            "load_percent": round(state.load_percent, 1),
            "voltage_v": round(state.voltage_v, 1),
        }
        if not arrived:
            return MotionTimeout(
                f"The table did not arrive at {goal} within {self.allowed_s:.1f} s.",
                next_step="Look for what slows the table down, and check that its cable is not taut.",
                evidence=evidence,
            )
        if not isfinite(peak_dps):
            return DeviceFault(
                f"The table arrived at {goal}, but samples of the gyro are missing: its rest cannot be checked.",
                next_step="Check the IMU's cable and supply.",
                evidence=evidence,
            )
        if peak_dps > self.config.velocity_dps:
            return DeviceFault(
                f"The table arrived at {goal}, but the gyro measures {peak_dps:.0f} °/s.",
                next_step="Check the IMU: a table at rest cannot rotate that fast.",
                evidence=evidence,
            )
        return MotionTimeout(
            f"The table arrived at {goal} but did not come to rest within {self.allowed_s:.1f} s.",
            next_step="Look for what shakes the bench; table.quiet_dps is the limit.",
            evidence=evidence,
        )


@contextmanager
def causes_found(servo: Servo, config: SafetyConfig) -> Iterator[None]:
    """Replace the error of a failed motion by its cause, if the servo's condition shows the cause."""
    try:
        yield
    except (RequestRejected, FollowingError, MotionTimeout, NoProgress) as symptom:
        raise _find_cause(symptom, servo, config) from None


def _find_cause(symptom: RigError, servo: Servo, config: SafetyConfig) -> RigError:
    with suppress(RigError):
        condition = servo.read_condition()
        # The end of a motion disarms the watchdog. Then volatile registers show the trip; the torque is still on.
        if condition.watchdog_tripped or (condition.power_lost and condition.torque):
            return WatchdogTripped(
                "The servo received nothing from the computer for too long, and its watchdog stopped the table.",
                next_step=("Check whether the computer slept or was too busy.", *START_AGAIN),
                evidence=symptom.evidence,
            )
        if condition.power_lost:
            return SupplyLost(
                "The servo lost its supply for a moment: its torque is off, and its count of revolutions is lost.",
                next_step="Check the supply, its plug and its cable.",
                evidence=symptom.evidence,
            )
        if condition.hardware_errors:
            return find_servo_fault(servo.read_state(), config, servo.limits) or symptom
    return symptom
