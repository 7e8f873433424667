"""Decides when a motion of the table has ended, and finds why one failed.

Decision: docs/decisions/0044.
"""

from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from math import isfinite

from rig.config import SafetyConfig, TableConfig
from rig.core.clock import Clock, seconds_between
from rig.core.errors import (
    DeviceFault,
    FollowingError,
    MotionTimeout,
    NoProgress,
    RequestRejected,
    RigError,
    SupplyLost,
    WatchdogTripped,
)
from rig.core.next_steps import START_AGAIN
from rig.core.phrases import angle_words
from rig.devices.servo import Servo, ServoState
from rig.motion.halt import QUIET_COUNTS
from rig.safety.gyro_rotation import GyroRotationMeter, finite
from rig.safety.motion_checks import find_servo_fault


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
    _begun_ns: int = field(init=False)
    _readings: deque[tuple[int, float]] = field(default_factory=deque)

    def __post_init__(self) -> None:
        self._begun_ns = self.clock.now_ns()

    def rest_deg(self, state: ServoState, angle_deg: float) -> float | None:
        """Return the table's angle at rest; None if it is not at rest yet, by this reading of the servo.

        Raises
        ------
        MotionTimeout, DeviceFault
            The time is over: the table has not arrived, it shakes, or the gyro fails.
        """
        readings = self._readings
        arrived = not state.moving and abs(angle_deg - self.goal_deg) <= self.config.tolerance_deg
        if not arrived:
            readings.clear()
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
        if max(angles) - min(angles) > QUIET_COUNTS * self.servo.resolution_deg:
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
        if condition.watchdog_tripped:
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
