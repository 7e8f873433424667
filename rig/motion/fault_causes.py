"""Why a motion did not come to its end: the servo, asked for its condition, often knows better than its symptoms."""

from math import isfinite

from rig.config import SafetyConfig
from rig.core.errors import DeviceFault, MotionTimeout, RigError, SupplyLost, WatchdogTripped
from rig.devices.servo import Servo, ServoState
from rig.safety.gyro_rotation import finite
from rig.safety.motion_checks import find_servo_fault


def find_cause(symptom: RigError, servo: Servo, config: SafetyConfig) -> RigError:
    """Return why the servo does not do what it was told, where it knows; else ``symptom`` itself."""
    try:
        condition = servo.read_condition()
        if condition.watchdog_tripped:
            return WatchdogTripped(
                "The servo heard nothing from the computer for too long, and stopped the table by itself.",
                next_step="Was the computer asleep, or too busy? Start again; an enrollment goes on with --resume.",
                evidence=symptom.evidence,
            )
        if condition.power_lost:
            return SupplyLost(
                "The servo was without supply for a moment: its torque is off, and it forgot its turns.",
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
    """Return why a table does not come to rest: it has not arrived, it shakes, or the gyro does not tell.

    Parameters
    ----------
    goal_deg, angle_deg
        Of the table: where it should be, and where it is by the encoder.
    allowed_s
        How long that has been waited for.
    state
        The servo's last.
    arrived
        Whether the servo is in position.
    peak_dps
        Largest rate by the gyro of late; infinite where its samples are not complete.
    cruise_dps
        The table's fastest.
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
            f"The table did not arrive at {goal_deg:.1f}° within {allowed_s:.1f} s.",
            next_step="Look for what slows the table down, and for a cable at its end.",
            evidence=evidence,
        )
    if not isfinite(peak_dps):
        return DeviceFault(
            f"The table has arrived at {goal_deg:.1f}°, but samples of the gyro are missing: is it at rest?",
            next_step="Check the IMU's cable and supply.",
            evidence=evidence,
        )
    if peak_dps > cruise_dps:
        return DeviceFault(
            f"The table has arrived at {goal_deg:.1f}°, but the gyro tells of {peak_dps:.0f} °/s.",
            next_step="Check the IMU: no table that stands turns like that.",
            evidence=evidence,
        )
    return MotionTimeout(
        f"The table has arrived at {goal_deg:.1f}° but does not come to rest within {allowed_s:.1f} s.",
        next_step="Look for what shakes the bench; table.quiet_dps says how much is too much.",
        evidence=evidence,
    )
