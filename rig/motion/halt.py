"""Stops a moving table along its ramp."""

from math import copysign

from rig.core.clock import Clock, seconds_between
from rig.core.errors import DeviceSilent, RigError
from rig.devices.servo import Servo
from rig.safety.motion_checks import implausible_readings

QUIET_COUNTS = 3
"""Encoder counts by which readings at rest may differ: one of quantisation, the others of noise."""
STILL_S = 0.01
"""Time between two readings that show whether the table moves at all."""
STOP_ALLOWANCE_S = 0.5
"""Time for a stop in addition to its ramp; then the torque goes off in any case."""


def halt(servo: Servo, clock: Clock, ramp_dps2: float, poll_s: float) -> bool:
    """Bring the table to a stop along its ramp; return False if the servo does not answer (its watchdog stops it).

    The goal is ahead of the table by its stopping distance. With its present position as the goal, the table would
    overshoot and come back.
    """
    try:
        state = servo.read_state()
        if implausible_readings(state):  # the position is not known: let the table run out
            servo.torque_off()
            return True
        clock.sleep(STILL_S)
        later = servo.read_state()
        passed_s = seconds_between(state.time_ns, later.time_ns)
        moved_deg = abs(later.position_deg - state.position_deg)
        if moved_deg < max(abs(state.velocity_dps) * passed_s / 4, QUIET_COUNTS * servo.resolution_deg):
            servo.torque_off()  # it stands still, or its readings hang: then a goal from them would rotate the table
            return True
        state = later
        ramp_deg = copysign(state.velocity_dps**2 / (2 * ramp_dps2), state.velocity_dps)
        bus_s = 2 * seconds_between(state.time_ns, clock.now_ns())  # for the answer and for the goal
        servo.move_to(state.position_deg + ramp_deg + state.velocity_dps * bus_s)
        give_up_ns = clock.now_ns() + round((abs(state.velocity_dps) / ramp_dps2 + STOP_ALLOWANCE_S) * 1e9)
        while state.moving and clock.now_ns() < give_up_ns:
            clock.sleep(poll_s)
            state = servo.read_state()
        servo.disarm_watchdog()
    except DeviceSilent:
        return False
    except RigError:  # the servo rejects the goal: its watchdog stopped it already, or its torque is off
        return True
    return True
