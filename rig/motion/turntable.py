"""The table: rotates to an angle, always from the same side, waits for rest, and measures the rotation.

Decision: docs/decisions/0004.
"""

from collections import deque
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from math import copysign, isfinite, remainder
from typing import Self

from rig.bench import Bench
from rig.core.clock import seconds_between
from rig.core.errors import (
    FollowingError,
    LimitExceeded,
    MotionTimeout,
    NoProgress,
    NotReady,
    RequestRejected,
    RigError,
    RotationDisagreement,
    TorqueStaysOn,
    UsageError,
)
from rig.core.phrases import angle_words, budget_words
from rig.core.signals import uninterrupted
from rig.devices.servo import MotionProfile, ServoState
from rig.motion.fault_causes import explain_unsettled, find_cause
from rig.motion.halt import QUIET_COUNTS, MotionPath, halt, reachable
from rig.motion.move import Move, equivalent_within, motion_seconds
from rig.motion.trajectory import TrajectoryRecorder
from rig.safety.gyro_rotation import GyroRotationMeter, Stillness, compare
from rig.safety.motion_checks import MotionMonitor, SlipMonitor
from rig.safety.supervisor import TableState

FIRST_REST_S = 0.6
"""Time over which the gyro is averaged for its first bias."""
SETTLE_ALLOWANCE_S = 2.5
"""Time for ringing to die down and for a slow bus, in addition to the motion."""


@dataclass(frozen=True, slots=True)
class Flight:
    """The observation and the control of a motion while the table rotates.

    Attributes
    ----------
    each
        Called in each round of the control loop, instead of a pause: it waits for the next frame, for example. It
        returns a new goal, or None to continue to the last one.
    reach_deg
        Lowest and highest goal that ``each`` may return.
    recorder
        Receives the readings of the encoder and the samples of the gyro.
    velocity_dps
        Cruise speed.
    quiet
        Whether the motion ends with a rest, as before a view; otherwise it is enough to arrive.
    """

    each: Callable[[], float | None]
    reach_deg: tuple[float, float]
    recorder: TrajectoryRecorder
    velocity_dps: float
    quiet: bool = True


class Turntable(AbstractContextManager["Turntable"]):
    """The table of an open bench, with torque on for the duration of a ``with`` block.

    Entering moves nothing: `rig.safety.supervisor` decides whether the table may move, then the servo holds its present
    position. Leaving always switches the torque off.

    Parameters
    ----------
    bench
        An open bench.
    trust_gyro
        Whether a motion is stopped if the gyro contradicts the encoder. Calibrations of the gyro set it to False.
    first_rest_s
        How long the gyro is averaged for its first bias.
    """

    def __init__(self, bench: Bench, *, trust_gyro: bool = True, first_rest_s: float = FIRST_REST_S) -> None:
        self._config = bench.config.table
        self._limits = bench.config.safety
        self._servo = bench.servo
        self._clock = bench.clock
        self._safety = bench.safety
        self._trust_gyro = trust_gyro
        self._first_rest_s = first_rest_s
        imu = self._imu_config = bench.config.imu
        self._gyro = GyroRotationMeter(
            bench.imu, bench.clock, axis=imu.axis, sign=imu.sign, scale=imu.scale, scale_sigma=imu.scale_uncertainty
        )
        self._profile: MotionProfile | None = None
        self._rest_deg = 0.0
        self._path_deg = (0.0, 0.0)
        self._trusted: ServoState | None = None
        self._backlash_taken_up = False

    def __enter__(self) -> Self:
        self._safety.prepare()
        try:
            self._servo.torque_on()
            # After torque on, which clears the watchdog: a watchdog that trips resets the profile to unlimited.
            self._profile = self._servo.set_profile(
                MotionProfile(self._config.velocity_dps, self._config.acceleration_dps2)
            )
            self._wait_for_rest(self.angle_deg(), self._config.quiet_s, SETTLE_ALLOWANCE_S)
            self._learn_bias(self._first_rest_s)
        except BaseException:
            self.__exit__(None, None, None)
            raise
        return self

    def __exit__(self, _kind: object, error: BaseException | None, _trace: object) -> None:
        with uninterrupted():
            self._profile = None
            try:
                self._servo.torque_off()
                self._safety.released()
            except TorqueStaysOn as stays_on:
                self._safety.latch(stays_on)
                raise
            except RigError:
                if error is None or isinstance(error, KeyboardInterrupt | SystemExit):  # the first error is reported
                    raise

    @property
    def rest_deg(self) -> float:
        """Table angle by the encoder at the last rest."""
        return self._rest_deg

    @property
    def limits_deg(self) -> tuple[float, float]:
        """The cable budget: lowest and highest table angle."""
        return self._config.limits_deg

    def angle_deg(self) -> float:
        """Return the table's present angle by the encoder."""
        return self._safety.angle_reference.to_table(self._servo.read_state().position_deg)

    def check_target(self, target_deg: float) -> None:
        """Raise `LimitExceeded` if the target is outside the cable budget, `UsageError` if it is not a number."""
        if not isfinite(target_deg):
            raise UsageError(f"{target_deg} is not an angle.", next_step="Give an angle in degrees.")
        low, high = self._config.limits_deg
        if not low <= target_deg <= high:
            raise LimitExceeded(
                f"The table cannot rotate from {angle_words(self._rest_deg)} to {angle_words(target_deg)}: its cable "
                f"budget is {budget_words((low, high))}.",
                next_step="Give an angle within these limits: add or subtract 360° for the same view.",
                evidence={"from_deg": round(self._rest_deg, 2), "to_deg": target_deg, "limits_deg": [low, high]},
            )

    def within_reach(self, target_deg: float) -> float:
        """Return the angle within the limits that is equivalent to ``target_deg`` and nearest to the present angle.

        ``target_deg`` itself if it is within the limits: the cable is unwound only if necessary. For a servo that pans
        over less than a revolution, and an angle out of its reach: the limit that is nearest to that angle.
        """
        low, high = limits_deg = self._config.limits_deg
        reached_deg = equivalent_within(target_deg, self._rest_deg, limits_deg)
        if reached_deg is None:
            return min((low, high), key=lambda limit: abs(remainder(limit - target_deg, 360.0)))
        return reached_deg

    def unwound_revolutions(self, target_deg: float) -> int:
        """Return by how many revolutions the rotation to ``target_deg`` unwinds the cable."""
        if abs(target_deg) >= abs(self._rest_deg):
            return 0
        return abs(round((target_deg - self._rest_deg) / 360.0))

    def unwound_deg(self) -> float:
        """Return the angle that is equivalent to the present one and leaves the cable wound up the least."""
        low, high = self._config.limits_deg
        angle = self._rest_deg - 360.0 * round(self._rest_deg / 360.0)
        return angle if low <= angle <= high else self._rest_deg

    def hold(self) -> Move:
        """Stay, and return when the table is at rest: a move without rotation, before a first view."""
        return self._move(self._rest_deg, ())

    def goto(self, target_deg: float) -> Move:
        """Rotate to ``target_deg`` (table, unwrapped) and return when the table is at rest there.

        Raises
        ------
        LimitExceeded
            The target is outside the cable budget; nothing moved.
        Stalled, Overloaded, FollowingError, NoProgress, Overheated, SupplyOutOfRange, RotationDisagreement
            See `rig.safety.motion_checks`; the table was stopped, and the fault is latched.
        MotionTimeout, DeviceFault
            It did not come to rest within the computed time, or the servo reported a hardware error; latched as well.
        WatchdogTripped, SupplyLost, DeviceSilent
            The computer was too slow, or the servo lost its supply or its cable; its own watchdog stops it.
        MotionStopped
            The operator requested a stop.
        FaultLatched, NotReady
            An earlier motion was interrupted.
        """
        self.check_target(target_deg)
        return self._move(target_deg, self._waypoints(target_deg))

    def recorder(self) -> TrajectoryRecorder:
        """Return a recorder for the next motions, with what is known about the gyro now."""
        bias_dps, sigma_dps = self._gyro.bias_of_table
        return TrajectoryRecorder(
            self._servo.resolution_deg,
            self._config.backlash_deg,
            self._imu_config.scale_uncertainty,
            self._gyro.arw,
            bias_dps,
            sigma_dps,
        )

    def fly(self, target_deg: float, flight: Flight) -> Move:
        """Rotate to ``target_deg`` without a stop, watched and steered by a `Flight`; return when the table is there.

        The table does not approach the target from below. Raises what `goto` raises.
        """
        low_deg, high_deg = flight.reach_deg
        for end_deg in (target_deg, low_deg, high_deg):
            self.check_target(end_deg)
        assert self._profile is not None
        usual = self._profile
        if abs(flight.velocity_dps - usual.velocity_dps) > 1e-3:
            self._profile = self._servo.set_profile(MotionProfile(flight.velocity_dps, usual.acceleration_dps2))
        self._gyro.taps.append(flight.recorder.add_samples)
        try:
            return self._move(target_deg, (target_deg,), flight)
        finally:
            self._gyro.taps.remove(flight.recorder.add_samples)
            if self._profile is not None and self._profile != usual:
                with uninterrupted():
                    self._profile = usual
                    self._restore_profile(usual)

    def _restore_profile(self, profile: MotionProfile) -> None:
        """Set the usual speed again; after a fault the servo may not answer, and the next program sets it."""
        if self._safety.state is TableState.READY:
            self._servo.set_profile(profile)

    def stopping_deg(self, state: ServoState) -> float:
        """Return where the table stops if it brakes now, as a table angle within the limits."""
        assert self._profile is not None
        rate_dps = self._config.direction * state.velocity_dps
        age_s = seconds_between(state.time_ns, self._clock.now_ns()) + self._config.poll_s / 2
        ramp_deg = copysign(rate_dps**2 / (2 * self._profile.acceleration_dps2), rate_dps) + rate_dps * age_s
        low_deg, high_deg = self._config.limits_deg
        here_deg = self._safety.angle_reference.to_table(state.position_deg)
        return min(max(here_deg + ramp_deg, low_deg), high_deg)

    def collect_gyro(self) -> None:
        """Collect the gyro's samples: its buffer is shorter than the time that a slow camera may take."""
        self._gyro.update()

    def check_still(self, since_ns: int | None = None) -> Stillness:
        """Check encoder and gyro again, as evidence of a view that was taken since the table came to rest.

        The rate is checked from ``since_ns`` on, but at least for ``table.quiet_s``. The angles of shaft and platter
        are compared with those at the beginning of the rest.
        """
        self._safety.check_stop_request()
        state = self._servo.read_state()
        self._safety.check_servo(state)
        change = abs(self._safety.angle_reference.to_table(state.position_deg) - self._rest_deg)
        now_ns = self._clock.now_ns()
        window_s = max(self._config.quiet_s, seconds_between(now_ns if since_ns is None else since_ns, now_ns))
        peak = self._gyro.peak_dps(window_s)
        if not isfinite(peak):
            self._clock.sleep(self._config.quiet_s)  # the plan paused for longer than the gyro's memory
        moved_by = self._gyro.since_rest()
        slipped = abs(moved_by.angle_deg) > 4 * moved_by.sigma_deg + self._config.backlash_deg
        still = peak <= self._config.quiet_dps and change <= QUIET_COUNTS * self._servo.resolution_deg and not slipped
        return Stillness(peak, change, moved_by.angle_deg, still)

    def _waypoints(self, target_deg: float) -> tuple[float, ...]:
        """Return the stops of a motion: if it would end downwards, it first goes below the target."""
        start = max(target_deg - self._config.approach_deg, self._config.limits_deg[0])
        upwards = target_deg >= self._rest_deg
        if upwards and (self._backlash_taken_up or self._rest_deg <= start):
            return (target_deg,)
        return (start, target_deg)

    def _learn_bias(self, duration_s: float) -> None:
        """Measure the gyro's bias; try again after a short disturbance, and fail if the bench keeps shaking."""
        deadline_ns = self._clock.now_ns() + round(SETTLE_ALLOWANCE_S * 1e9)
        while True:
            try:
                self._gyro.rest(duration_s)
            except NotReady:
                if self._clock.now_ns() >= deadline_ns:
                    raise
            else:
                return

    def _move(self, target_deg: float, waypoints: tuple[float, ...], flight: Flight | None = None) -> Move:
        if self._profile is None:
            raise NotReady(
                "The table has no torque.", next_step="Use it in a with block: `with Turntable(bench) as table:`."
            )
        self._safety.require_ready()
        started_ns, start_deg = self._clock.now_ns(), self._rest_deg
        self._learn_bias(self._config.quiet_s)  # the bias drifts, so each rest measures it again
        self._gyro.begin()
        if not waypoints:
            self._wait_for_rest(target_deg, self._config.quiet_s, SETTLE_ALLOWANCE_S)
        else:
            ends_deg = [self._safety.angle_reference.to_servo(angle) for angle in (start_deg, *waypoints)]
            steered_deg = () if flight is None else flight.reach_deg
            ends_deg += [self._safety.angle_reference.to_servo(angle) for angle in steered_deg]
            self._path_deg, self._trusted = (min(ends_deg), max(ends_deg)), None
            with self._safety.motion((start_deg, *waypoints, *steered_deg), self._stop) as motion:
                slip = SlipMonitor(self._limits, start_deg) if self._trust_gyro else None
                for waypoint in waypoints:
                    # The table must rest only at the last stop; at the others it is enough to arrive.
                    last = waypoint is waypoints[-1] and (flight is None or flight.quiet)
                    target_deg = self._approach(waypoint, self._config.quiet_s if last else 0.0, slip, flight)
                self._servo.disarm_watchdog()
                motion.arrived(self._safety.angle_reference.to_servo(self._rest_deg))
        self._backlash_taken_up = self._backlash_taken_up or bool(waypoints)
        gyro = self._gyro.end()
        rotation_deg = self._rest_deg - start_deg
        agreement = None
        if gyro.valid:
            agreement = compare(
                rotation_deg, gyro, encoder_sigma_deg=self._servo.resolution_deg, backlash_deg=self._config.backlash_deg
            )
        by_gyro = self._config.orientation == "imu"
        if by_gyro and not gyro.valid:
            raise RotationDisagreement(
                f"The platter's rotation is unknown: {gyro.reason}. By table.orientation, only the gyro measures it.",
                next_step="Check the IMU's cable and range, then start again; continue an enrollment with --resume.",
                evidence={"table_deg": round(self._rest_deg, 2)},
            )
        return Move(
            target_deg, self._rest_deg, rotation_deg, gyro, agreement, started_ns, self._clock.now_ns(), by_gyro
        )

    def _monitor(self, start_deg: float, goal_deg: float) -> MotionMonitor:
        assert self._profile is not None
        return MotionMonitor(
            self._limits,
            self._servo.limits,
            start_deg=start_deg,
            goal_deg=goal_deg,
            tolerance_deg=self._config.tolerance_deg,
            cruise_dps=self._profile.velocity_dps,
        )

    def _approach(
        self, goal_deg: float, quiet_s: float, slip: SlipMonitor | None, flight: Flight | None = None
    ) -> float:
        """Rotate to ``goal_deg`` under supervision; return the last goal when the table has been quiet there."""
        assert self._profile is not None
        monitor = self._monitor(self._rest_deg, goal_deg)
        allowed_s = self._allowed_s(goal_deg - self._rest_deg)
        try:
            self._servo.arm_watchdog(self._config.watchdog_s)
            self._safety.set_goal(self._safety.angle_reference.to_servo(goal_deg))
            return self._wait_for_rest(goal_deg, quiet_s, allowed_s, monitor, slip, flight)
        except (RequestRejected, FollowingError, MotionTimeout, NoProgress) as symptom:
            raise find_cause(symptom, self._servo, self._limits) from None

    def _allowed_s(self, distance_deg: float) -> float:
        assert self._profile is not None
        return 1.5 * motion_seconds(distance_deg, self._profile) + SETTLE_ALLOWANCE_S

    def _steer(self, state: ServoState, goal_deg: float) -> MotionMonitor:
        """Give the moving servo another goal; return the monitor of the motion from here on."""
        self._safety.set_goal(self._safety.angle_reference.to_servo(goal_deg))
        here_deg = self._safety.angle_reference.to_table(state.position_deg)
        # If the goal is behind the table, it overshoots before it comes back.
        start_deg = max(here_deg, self.stopping_deg(state), key=lambda angle: abs(angle - goal_deg))
        return self._monitor(start_deg, goal_deg)

    def _wait_for_rest(
        self,
        goal_deg: float,
        quiet_s: float,
        allowed_s: float,
        monitor: MotionMonitor | None = None,
        slip: SlipMonitor | None = None,
        flight: Flight | None = None,
    ) -> float:
        """Poll until the profile has ended near the goal and all is quiet for ``quiet_s``; return the goal.

        The polling also feeds the servo's watchdog. Decision: docs/decisions/0044.
        """
        config, to_table = self._config, self._safety.angle_reference.to_table
        start_ns = self._clock.now_ns()
        readings: deque[tuple[int, float]] = deque()
        while True:
            steer_deg = None
            if flight is None:
                self._clock.sleep(config.poll_s)
            else:
                steer_deg = flight.each()
            # Read the devices.
            self._safety.check_stop_request()
            state = self._servo.read_state()
            for observer in self._safety.observers:
                observer(state)
            if self._trusted is None or reachable(self._trusted, state, config.velocity_dps):
                self._trusted = state
            self._gyro.update(now=flight is not None)
            angle_deg = to_table(state.position_deg)
            if flight is not None:
                flight.recorder.add_reading(state.sampled_ns or state.time_ns, angle_deg)
            # Steer to another goal.
            if flight is not None and steer_deg is not None and abs(steer_deg - goal_deg) > config.tolerance_deg / 2:
                goal_deg = min(max(steer_deg, flight.reach_deg[0]), flight.reach_deg[1])
                monitor = self._steer(state, goal_deg)
                allowed_s = seconds_between(start_ns, self._clock.now_ns()) + self._allowed_s(goal_deg - angle_deg)
            # Check the motion, then whether the table has arrived and is quiet.
            if monitor:
                lag_deg = None if state.trajectory_deg is None else state.trajectory_deg - state.position_deg
                monitor.check(state, angle_deg, lag_deg)
            else:
                self._safety.check_servo(state)
            if slip:
                self._check_slip(slip, state.time_ns, angle_deg)
            arrived = not state.moving and abs(angle_deg - goal_deg) <= config.tolerance_deg
            if not arrived:
                readings.clear()
            readings.append((state.time_ns, angle_deg))
            if arrived and self._quiet(readings, quiet_s) and (state.in_position or self._holds()):
                self._rest_deg = sum(angle for _, angle in readings) / len(readings)
                return goal_deg
            elapsed_s = seconds_between(start_ns, self._clock.now_ns())
            if elapsed_s > allowed_s:
                peak_dps = self._gyro.peak_dps(config.quiet_s)
                raise explain_unsettled(goal_deg, angle_deg, allowed_s, state, arrived, peak_dps, config.velocity_dps)

    def _holds(self) -> bool:
        """Return whether the servo's torque is on; without torque there is no motion profile."""
        condition = self._servo.read_condition()
        return condition.torque and not condition.power_lost

    def _check_slip(self, slip: SlipMonitor, time_ns: int, angle_deg: float) -> None:
        slip.add_reading(time_ns, angle_deg)
        if encoder := slip.encoder_deg(self._gyro.newest_ns):
            at_ns, rotation_deg = encoder
            slip.compare(rotation_deg, self._gyro.since_rest(at_ns))

    def _quiet(self, readings: deque[tuple[int, float]], quiet_s: float) -> bool:
        """Return whether the readings span ``quiet_s`` without a motion; drop older readings."""
        while len(readings) > 1 and seconds_between(readings[1][0], readings[-1][0]) >= quiet_s:
            readings.popleft()
        if seconds_between(readings[0][0], readings[-1][0]) < quiet_s:
            return False
        angles = [angle for _, angle in readings]
        if max(angles) - min(angles) > QUIET_COUNTS * self._servo.resolution_deg:
            return False
        if quiet_s == 0 or self._gyro.bias is None:
            return True
        return self._gyro.peak_dps(quiet_s) <= self._config.quiet_dps

    def _stop(self) -> bool:
        ramp_dps2 = self._profile.acceleration_dps2 if self._profile else self._config.acceleration_dps2
        path = MotionPath(self._path_deg, self._config.velocity_dps, self._trusted)
        return halt(self._servo, self._clock, self._safety.set_goal, path, ramp_dps2, self._config.poll_s)
