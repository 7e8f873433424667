"""The table: goes to an angle, always from the same side, and knows when it is at rest and how far it really turned."""

from collections import deque
from contextlib import AbstractContextManager
from dataclasses import dataclass
from math import ceil, copysign, floor, isfinite, remainder, sqrt
from types import TracebackType
from typing import Self

from rig.bench import Bench
from rig.core.clock import seconds_between
from rig.core.errors import (
    DeviceSilent,
    FollowingError,
    LimitExceeded,
    MotionTimeout,
    NoProgress,
    NotReady,
    RequestRejected,
    RigError,
    RotationDisagreement,
)
from rig.devices.servo import MotionProfile
from rig.motion.fault_causes import explain_unsettled, find_cause
from rig.safety.gyro_rotation import Agreement, GyroRotationMeter, Rotation, Stillness, compare
from rig.safety.motion_checks import MotionMonitor, SlipMonitor, implausible_readings

QUIET_COUNTS = 3
"""Encoder counts that readings at rest may differ by: one of quantisation, the rest of its noise."""

FIRST_REST_S = 0.6
"""How long the gyro is averaged for its first bias."""

SETTLE_ALLOWANCE_S = 2.5
"""Time for ringing to die down and for a slow bus, on top of the motion's own."""

STANDS_S = 0.01
"""Between two looks at a table that is to be stopped: does it turn at all?"""

STOP_ALLOWANCE_S = 0.5
"""Time for a stop on top of its ramp; then the torque goes off anyhow."""


@dataclass(frozen=True, slots=True)
class Move:
    """A finished motion between two rests; angles of the table in degrees, unwrapped."""

    commanded_deg: float
    encoder_deg: float
    rotation_encoder_deg: float
    gyro: Rotation
    agreement: Agreement | None
    started_ns: int
    settled_ns: int
    by_gyro: bool = False

    @property
    def agrees(self) -> bool:
        """Whether encoder and gyro tell the same, or the gyro has nothing to tell."""
        return self.agreement is None or self.agreement.agrees

    @property
    def rotation_deg(self) -> float:
        """The rotation to believe: the encoder's, unless the gyro, which rides on the platter, contradicts it.

        The gyro's in any case where ``table.orientation`` says so.
        """
        return self.gyro.angle_deg if self.by_gyro or not self.agrees else self.rotation_encoder_deg

    @property
    def seconds(self) -> float:
        return seconds_between(self.started_ns, self.settled_ns)


def motion_seconds(distance_deg: float, profile: MotionProfile) -> float:
    """Return the duration of a trapezoid (or triangle) profile over ``distance_deg``."""
    distance, v, a = abs(distance_deg), profile.velocity_dps, profile.acceleration_dps2
    if distance < v * v / a:
        return 2 * sqrt(distance / a)
    return distance / v + v / a


def equivalent_within(target_deg: float, rest_deg: float, limits_deg: tuple[float, float]) -> float | None:
    """Return the angle that shows the same as ``target_deg`` within the cable's limits; None where none is.

    ``target_deg`` itself where it is within them, else the one, whole turns away, that is nearest to ``rest_deg``.
    """
    low, high = limits_deg
    if low <= target_deg <= high:
        return target_deg
    turns = range(ceil((low - target_deg) / 360), floor((high - target_deg) / 360) + 1)
    return min((target_deg + 360 * k for k in turns), key=lambda angle: abs(angle - rest_deg), default=None)


class Turntable(AbstractContextManager["Turntable"]):
    """The table of an open bench, with torque on for the length of a ``with`` block.

    Entering moves nothing: `rig.safety.supervisor` decides whether the table may move, then the servo holds its present
    position. Leaving always switches the torque off.

    Parameters
    ----------
    bench
        An open one.
    trust_gyro
        Whether a motion is broken off when the gyro contradicts the encoder; a calibration of the gyro does not.
    """

    def __init__(self, bench: Bench, *, trust_gyro: bool = True) -> None:
        self._config = bench.config.table
        self._limits = bench.config.safety
        self._servo = bench.servo
        self._clock = bench.clock
        self._safety = bench.safety
        self._trust_gyro = trust_gyro
        imu = bench.config.imu
        self._heading = GyroRotationMeter(
            bench.imu,
            bench.clock,
            axis=imu.axis,
            sign=imu.sign,
            scale=imu.scale,
            scale_sigma=imu.scale_uncertainty,
        )
        self._profile: MotionProfile | None = None
        self._rest_deg = 0.0
        self._play_taken_up = False

    def __enter__(self) -> Self:
        self._safety.prepare()
        try:
            self._servo.torque_on()
            # After torque on, which clears the watchdog: one that trips sets the profile back to unlimited.
            self._profile = self._servo.set_profile(
                MotionProfile(self._config.velocity_dps, self._config.acceleration_dps2)
            )
            self._wait_for_rest(self.angle_deg(), self._config.quiet_s, SETTLE_ALLOWANCE_S)
            self._learn_bias(FIRST_REST_S)
        except BaseException:
            self.__exit__(None, None, None)
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._profile = None
        try:
            self._servo.torque_off()
            self._safety.released()
        except RigError:
            if error is None:
                raise

    @property
    def rest_deg(self) -> float:
        """Angle by the encoder at the last rest."""
        return self._rest_deg

    @property
    def limits_deg(self) -> tuple[float, float]:
        """How far the cable reaches."""
        return self._config.limits_deg

    def angle_deg(self) -> float:
        """Return the table's angle by the encoder, now."""
        return self._safety.angle_reference.to_table(self._servo.read_state().position_deg)

    def check_target(self, target_deg: float) -> None:
        """Raise `LimitExceeded` where the cable does not reach."""
        low, high = self._config.limits_deg
        if not low <= target_deg <= high:
            raise LimitExceeded(
                f"The table cannot turn from {self._rest_deg:.1f}° to {target_deg:.1f}°: "
                f"its cable reaches from {low:g}° to {high:g}° ({low / 360:+.2f} to {high / 360:+.2f} turns).",
                next_step="Give an angle within the limits, or the same view a turn earlier (subtract or add 360).",
                evidence={"from_deg": round(self._rest_deg, 2), "to_deg": target_deg, "limits_deg": [low, high]},
            )

    def within_reach(self, target_deg: float) -> float:
        """Return the angle equivalent to ``target_deg`` (whole turns away) within the limits, nearest to where we are.

        ``target_deg`` itself where it is within the limits: the cable is unwound only when it must be. Of a servo that
        pans over less than a turn, the limit that comes nearest to an angle which it does not reach.
        """
        low, high = limits_deg = self._config.limits_deg
        reached_deg = equivalent_within(target_deg, self._rest_deg, limits_deg)
        if reached_deg is None:
            return min((low, high), key=lambda limit: abs(remainder(limit - target_deg, 360.0)))
        return reached_deg

    def unwound_revolutions(self, target_deg: float) -> int:
        """Return by how many whole turns the cable is unwound on the way to ``target_deg``, which could be shorter."""
        if abs(target_deg) >= abs(self._rest_deg):
            return 0
        return abs(round((target_deg - self._rest_deg) / 360.0))

    def unwound_deg(self) -> float:
        """Return the angle equivalent to the present rest that leaves the cable wound up the least."""
        low, high = self._config.limits_deg
        angle = self._rest_deg - 360.0 * round(self._rest_deg / 360.0)
        return angle if low <= angle <= high else self._rest_deg

    def hold(self) -> Move:
        """Stay, and return once the table is at rest: the move of no rotation before a first view."""
        return self._move(self._rest_deg, ())

    def goto(self, target_deg: float) -> Move:
        """Turn to ``target_deg`` (table, unwrapped) and return when the table is at rest there.

        Raises
        ------
        LimitExceeded
            Before anything moves.
        Stalled, Overloaded, FollowingError, NoProgress, Overheated, SupplyOutOfRange, RotationDisagreement
            See `rig.safety.motion_checks`; the table was stopped, and the fault is latched.
        MotionTimeout, DeviceFault
            It did not come to rest within the computed time, or the servo reported a hardware error; latched as well.
        WatchdogTripped, SupplyLost, DeviceSilent
            The computer was too slow, or the servo lost its supply or its cable; its own watchdog stops it.
        MotionStopped
            Somebody asked for a stop.
        FaultLatched, NotReady
            An earlier motion was broken off.
        """
        self.check_target(target_deg)
        return self._move(target_deg, self._waypoints(target_deg))

    def attend(self) -> None:
        """Collect what the gyro has measured: its buffer does not last as long as a slow camera may take."""
        self._heading.update()

    def check_still(self, since_ns: int | None = None) -> Stillness:
        """Look again at encoder and gyro, for the evidence of a view taken since the table came to rest.

        The rate is looked at from ``since_ns`` on, but never for less than ``table.quiet_s``; the angles of shaft and
        platter are compared with those of the rest, however long ago.
        """
        self._safety.check_stop_request()
        state = self._servo.read_state()
        self._safety.check_servo(state)
        change = abs(self._safety.angle_reference.to_table(state.position_deg) - self._rest_deg)
        now_ns = self._clock.now_ns()
        window_s = max(self._config.quiet_s, seconds_between(now_ns if since_ns is None else since_ns, now_ns))
        peak = self._heading.peak_dps(window_s)
        if not isfinite(peak):
            self._clock.sleep(self._config.quiet_s)  # somebody paused the plan for longer than the gyro remembers
        turned = self._heading.since_rest()
        slipped = abs(turned.angle_deg) > 4 * turned.sigma_deg + self._config.backlash_deg
        still = peak <= self._config.quiet_dps and change <= QUIET_COUNTS * self._servo.resolution_deg and not slipped
        return Stillness(peak, change, turned.angle_deg, still)

    # -- inside ---------------------------------------------------------------------------------------------------

    def _waypoints(self, target_deg: float) -> tuple[float, ...]:
        """Return the stops on the way: a motion that would end downwards first goes below the target."""
        start = max(target_deg - self._config.approach_deg, self._config.limits_deg[0])
        upwards = target_deg >= self._rest_deg
        if upwards and (self._play_taken_up or self._rest_deg <= start):
            return (target_deg,)
        return (start, target_deg)

    def _learn_bias(self, duration_s: float) -> None:
        """Measure the gyro's bias; somebody who walks past costs a moment, a bench that goes on shaking the move."""
        give_up_ns = self._clock.now_ns() + round(SETTLE_ALLOWANCE_S * 1e9)
        while True:
            try:
                self._heading.rest(duration_s)
            except NotReady:
                if self._clock.now_ns() >= give_up_ns:
                    raise
            else:
                return

    def _move(self, target_deg: float, waypoints: tuple[float, ...]) -> Move:
        if self._profile is None:
            raise NotReady(
                "The table has no torque.", next_step="Use it in a with block: `with Turntable(bench) as table:`."
            )
        self._safety.require_ready()
        started_ns, start_deg = self._clock.now_ns(), self._rest_deg
        self._learn_bias(self._config.quiet_s)  # it wanders: each rest measures it anew
        self._heading.begin()
        if not waypoints:
            self._wait_for_rest(target_deg, self._config.quiet_s, SETTLE_ALLOWANCE_S)
        else:
            with self._safety.motion((start_deg, *waypoints), self._stop) as motion:
                slip = SlipMonitor(self._limits, start_deg) if self._trust_gyro else None
                for waypoint in waypoints:
                    # Only the last stop must be a rest; on the way it is enough to have arrived.
                    self._approach(waypoint, self._config.quiet_s if waypoint is waypoints[-1] else 0.0, slip)
                self._servo.disarm_watchdog()
                motion.arrived(self._safety.angle_reference.to_servo(self._rest_deg))
        self._play_taken_up = self._play_taken_up or bool(waypoints)
        gyro = self._heading.end()
        rotation_deg = self._rest_deg - start_deg
        agreement = None
        if gyro.valid:
            agreement = compare(
                rotation_deg, gyro, encoder_sigma_deg=self._servo.resolution_deg, backlash_deg=self._config.backlash_deg
            )
        by_gyro = self._config.orientation == "imu"
        if by_gyro and not gyro.valid:
            raise RotationDisagreement(
                f"How far the platter turned is unknown: {gyro.reason}. By table.orientation the gyro alone tells.",
                next_step="Check the IMU's cable and range, then start again; an enrollment goes on with --resume.",
                evidence={"table_deg": round(self._rest_deg, 2)},
            )
        return Move(
            target_deg, self._rest_deg, rotation_deg, gyro, agreement, started_ns, self._clock.now_ns(), by_gyro
        )

    def _approach(self, goal_deg: float, quiet_s: float, slip: SlipMonitor | None) -> None:
        """Go to ``goal_deg`` under watch, and return when the table has arrived there and been quiet for so long."""
        assert self._profile is not None
        watch = MotionMonitor(
            self._limits,
            self._servo.limits,
            start_deg=self._rest_deg,
            goal_deg=goal_deg,
            tolerance_deg=self._config.tolerance_deg,
            cruise_dps=self._profile.velocity_dps,
        )
        allowed_s = 1.5 * motion_seconds(goal_deg - self._rest_deg, self._profile) + SETTLE_ALLOWANCE_S
        try:
            self._servo.arm_watchdog(self._config.watchdog_s)
            self._servo.move_to(self._safety.angle_reference.to_servo(goal_deg))
            self._wait_for_rest(goal_deg, quiet_s, allowed_s, watch, slip)
        except (RequestRejected, FollowingError, MotionTimeout, NoProgress) as symptom:
            raise find_cause(symptom, self._servo, self._limits) from None

    def _wait_for_rest(
        self,
        goal_deg: float,
        quiet_s: float,
        allowed_s: float,
        watch: MotionMonitor | None = None,
        slip: SlipMonitor | None = None,
    ) -> None:
        """Poll until the servo is in position and encoder and gyro have been quiet for ``quiet_s``.

        The polling feeds the servo's watchdog.
        """
        config, to_table = self._config, self._safety.angle_reference.to_table
        start_ns = self._clock.now_ns()
        readings: deque[tuple[int, float]] = deque()
        while True:
            self._clock.sleep(config.poll_s)
            self._safety.check_stop_request()
            state = self._servo.read_state()
            self._heading.update()
            angle_deg = to_table(state.position_deg)
            if watch:
                lag_deg = None if state.trajectory_deg is None else state.trajectory_deg - state.position_deg
                watch.look(state, angle_deg, lag_deg)
            else:
                self._safety.check_servo(state)
            if slip:
                self._look_for_slip(slip, state.time_ns, angle_deg)
            arrived = state.in_position and not state.moving and abs(angle_deg - goal_deg) <= config.tolerance_deg
            if not arrived:
                readings.clear()
            readings.append((state.time_ns, angle_deg))
            if arrived and self._quiet(readings, quiet_s):
                self._rest_deg = sum(angle for _, angle in readings) / len(readings)
                return
            elapsed_s = seconds_between(start_ns, self._clock.now_ns())
            if elapsed_s > allowed_s:
                peak_dps = self._heading.peak_dps(config.quiet_s)
                raise explain_unsettled(goal_deg, angle_deg, allowed_s, state, arrived, peak_dps, config.velocity_dps)

    def _look_for_slip(self, slip: SlipMonitor, time_ns: int, angle_deg: float) -> None:
        slip.note(time_ns, angle_deg)
        if encoder := slip.encoder_deg(self._heading.newest_ns):
            at_ns, rotation_deg = encoder
            slip.compare(rotation_deg, self._heading.since_rest(at_ns))

    def _quiet(self, readings: deque[tuple[int, float]], quiet_s: float) -> bool:
        """Return whether the readings span ``quiet_s`` without a motion; drops those older than needed."""
        while len(readings) > 1 and seconds_between(readings[1][0], readings[-1][0]) >= quiet_s:
            readings.popleft()
        if seconds_between(readings[0][0], readings[-1][0]) < quiet_s:
            return False
        angles = [angle for _, angle in readings]
        if max(angles) - min(angles) > QUIET_COUNTS * self._servo.resolution_deg:
            return False
        if quiet_s == 0 or self._heading.bias is None:
            return True
        return self._heading.peak_dps(quiet_s) <= self._config.quiet_dps

    def _stop(self) -> bool:
        """Bring the table to a stop along its ramp; return False where the servo hears nothing: its watchdog stops it.

        A goal where the table is now would be behind it before it could stop, and it would come back.
        """
        try:
            state = self._servo.read_state()
            if implausible_readings(state):  # where the table is, nobody knows: it runs out
                self._servo.torque_off()
                return True
            self._clock.sleep(STANDS_S)
            later = self._servo.read_state()
            passed_s = seconds_between(state.time_ns, later.time_ns)
            went_deg = abs(later.position_deg - state.position_deg)
            if went_deg < max(abs(state.velocity_dps) * passed_s / 4, QUIET_COUNTS * self._servo.resolution_deg):
                self._servo.torque_off()  # it stands; or its readings do, and a goal by them would turn the table
                return True
            state = later
            ramp_dps2 = self._profile.acceleration_dps2 if self._profile else self._config.acceleration_dps2
            ramp_deg = copysign(state.velocity_dps**2 / (2 * ramp_dps2), state.velocity_dps)
            on_the_bus_s = 2 * seconds_between(state.time_ns, self._clock.now_ns())  # the answer's way, and the goal's
            self._servo.move_to(state.position_deg + ramp_deg + state.velocity_dps * on_the_bus_s)
            give_up_ns = self._clock.now_ns() + round((abs(state.velocity_dps) / ramp_dps2 + STOP_ALLOWANCE_S) * 1e9)
            while state.moving and self._clock.now_ns() < give_up_ns:
                self._clock.sleep(self._config.poll_s)
                state = self._servo.read_state()
            self._servo.disarm_watchdog()
        except DeviceSilent:
            return False
        except RigError:  # it refuses: the watchdog has stopped it already, or its torque is off
            return True
        return True
