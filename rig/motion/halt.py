"""Stops a moving table along its ramp."""

from collections.abc import Callable
from dataclasses import dataclass
from math import copysign

from rig.core.clock import Clock, seconds_between
from rig.core.errors import DeviceSilent, RigError, TorqueStaysOn
from rig.devices.servo import Servo, ServoState
from rig.safety.angle_reference import OVERSHOOT_DEG
from rig.safety.motion_checks import implausible_readings

QUIET_COUNTS = 3
"""Encoder counts by which readings at rest may differ: one of quantisation, the others of noise."""
STILL_S = 0.01
"""Time between two readings that show whether the table moves at all."""
STALE_S = 0.05
"""Age at which a reading is too old for a goal: the computer paused after it."""
READINGS = 8
"""Number of readings that are taken to find two that agree."""
AGREEMENTS = 3
"""Number of successive readings that must agree if the table cannot have reached them since the last trusted one."""
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


def halt(
    servo: Servo, clock: Clock, set_goal: Callable[[float], None], path: MotionPath, ramp_dps2: float, poll_s: float
) -> bool:
    """Bring the table to a stop along its ramp; return False if the servo does not answer (its watchdog stops it).

    The goal is ahead of the table by its stopping distance, but never beyond the path of the motion. With its present
    position as the goal, the table would overshoot and come back. Without two readings that agree, the position is not
    known; then the torque goes off and the table stops by friction.
    """
    try:
        state = _agreed_reading(servo, clock, path)
        if state is None:
            servo.torque_off()
            if servo.read_condition().watchdog_armed:  # or the next program would find it armed
                servo.disarm_watchdog()
            return True
        ramp_deg = copysign(state.velocity_dps**2 / (2 * ramp_dps2), state.velocity_dps)
        bus_s = 2 * min(seconds_between(state.time_ns, clock.now_ns()), STALE_S)  # for the answer and the goal
        low_deg, high_deg = path.ends_deg
        set_goal(min(max(state.position_deg + ramp_deg + state.velocity_dps * bus_s, low_deg), high_deg))
        deadline_ns = clock.now_ns() + round((abs(state.velocity_dps) / ramp_dps2 + STOP_ALLOWANCE_S) * 1e9)
        while state.moving and clock.now_ns() < deadline_ns:
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
        noise_deg = QUIET_COUNTS * servo.resolution_deg
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
