"""Finds why a motion failed: the servo's condition often shows the cause behind a symptom."""

from math import isfinite

from rig.config import SafetyConfig
from rig.core.errors import DeviceFault, MotionTimeout, RigError, SupplyLost, WatchdogTripped
from rig.core.phrases import angle_words
from rig.devices.servo import Servo, ServoState
from rig.safety.gyro_rotation import finite
from rig.safety.motion_checks import find_servo_fault


def find_cause(symptom: RigError, servo: Servo, config: SafetyConfig) -> RigError:
    """Return the cause of a failed motion if the servo's condition shows it, else ``symptom``."""
    try:
        condition = servo.read_condition()
        if condition.watchdog_tripped:
            return WatchdogTripped(
                "The servo received nothing from the computer for too long, and its watchdog stopped the table.",
                next_step="Check whether the computer slept or was too busy, then start again; continue an enrollment "
                "with --resume.",
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
    except RigError:
        return symptom
    return symptom


def explain_unsettled(
    goal_deg: float,
    angle_deg: float,
    allowed_s: float,
    state: ServoState,
    arrived: bool,
    peak_dps: float,
    cruise_dps: float,
) -> RigError:
    """Return why a table does not come to rest: it has not arrived, it shakes, or the gyro fails.

    Parameters
    ----------
    goal_deg, angle_deg
        The table's goal, and its angle by the encoder.
    allowed_s
        How long the table had time to come to rest.
    state
        The servo's last reading.
    arrived
        Whether the servo is in position.
    peak_dps
        Largest recent rate by the gyro; infinite if samples are missing.
    cruise_dps
        Highest speed of the table.
    """
    evidence = {
        "goal_deg": round(goal_deg, 2),
        "encoder_deg": round(angle_deg, 2),
        "in_position": state.in_position,
        "moving": state.moving,
        "peak_rate_dps": finite(peak_dps),
        "load_percent": round(state.load_percent, 1),
        "voltage_v": round(state.voltage_v, 1),
    }
    if not arrived:
        return MotionTimeout(
            f"The table did not arrive at {angle_words(goal_deg)} within {allowed_s:.1f} s.",
            next_step="Look for what slows the table down, and check that its cable is not taut.",
            evidence=evidence,
        )
    if not isfinite(peak_dps):
        return DeviceFault(
            f"The table arrived at {angle_words(goal_deg)}, but samples of the gyro are missing: "
            "its rest cannot be checked.",
            next_step="Check the IMU's cable and supply.",
            evidence=evidence,
        )
    if peak_dps > cruise_dps:
        return DeviceFault(
            f"The table arrived at {angle_words(goal_deg)}, but the gyro measures {peak_dps:.0f} °/s.",
            next_step="Check the IMU: a table at rest cannot rotate that fast.",
            evidence=evidence,
        )
    return MotionTimeout(
        f"The table arrived at {angle_words(goal_deg)} but did not come to rest within {allowed_s:.1f} s.",
        next_step="Look for what shakes the bench; table.quiet_dps is the limit.",
        evidence=evidence,
    )
