"""The table: rotates to an angle, always from the same side, waits for rest, and measures the rotation.

Decision: docs/decisions/0005.
"""

from collections import deque
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from functools import partial
from math import isfinite, log, pi, remainder
from typing import Self

import numpy as np
from numpy.typing import NDArray

from rig.bench import Bench
from rig.core.clock import seconds_between
from rig.core.errors import LimitExceeded, NotReady, RigError, RotationDisagreement, TorqueStaysOn, UsageError
from rig.core.next_steps import START_AGAIN
from rig.core.phrases import angle_words, budget_words
from rig.core.signals import uninterrupted
from rig.devices.servo import MotionProfile, ServoState
from rig.motion.arrival import Arrival, MotionPath, causes_found, halt, quiet_deg, stopping_deg
from rig.motion.move import FIRST_REST_S, Move, equivalent_within, motion_seconds
from rig.motion.shaper import shaped
from rig.motion.traces import KEPT, MoveTrace, store
from rig.motion.trajectory import TrajectoryRecorder
from rig.safety.gyro_rotation import GyroRotationMeter, Stillness, compare
from rig.safety.motion_checks import MotionMonitor, SlipMonitor
from rig.safety.supervisor import Motion, TableState

SETTLE_ALLOWANCE_S = 2.5  # larger: a table that shakes is reported late; smaller: a heavy object never rests in time
"""Time for ringing to die down and for a slow bus, in addition to the motion."""
RINGING_DPS = 10.0
"""Largest rate of a ringing whose frequency and damping are known, after the shaft broke away from its friction."""
AT_GOAL = 4  # more: the bus has no time for others; fewer: a table at rest is waited for, 0.02 s on average with 1
"""How many times as often the table is read at its goal, until it rests there."""
ROUND_S = 0.03  # longer: a shaped motion is watched less closely; shorter: its parts begin late
"""Longest time that a round of the control loop takes besides its pause."""
GYRO_LAG_S = 0.012
"""Time after a stop until the low-pass filter of a gyro (42 Hz) shows it."""


@dataclass(frozen=True, slots=True)
class Flight:
    """The observation and the control of a motion while the table rotates."""

    each: Callable[[], float | None]
    """Called in each round of the control loop, instead of a pause: it waits for the next frame, for example. It
    returns a new goal, or None to continue to the last one."""
    reach_deg: tuple[float, float]
    """Lowest and highest goal that ``each`` may return."""
    recorder: TrajectoryRecorder
    """Receives the readings of the encoder and the samples of the gyro."""
    velocity_dps: float
    """Cruise speed."""
    quiet: bool = True
    """Whether the motion ends with a rest, as before a view; otherwise it is enough to arrive."""


@dataclass(slots=True)
class _Rotation:
    """The beginning of a rotation, and what checks it; the table stays if there is no ``monitor``.

    ``due`` are times at which the control loop must read, and what it does before.
    """

    started_ns: int
    start_deg: float
    slip: SlipMonitor | None = None
    monitor: MotionMonitor | None = None
    due: deque[tuple[int, Callable[[], object]]] = field(default_factory=deque)


def check_angle(target_deg: float, limits_deg: tuple[float, float], from_deg: float | None = None) -> None:
    """Raise `LimitExceeded` if the target is outside the cable budget, `UsageError` if it is not a number."""
    if not isfinite(target_deg):
        raise UsageError(f"{target_deg} is not an angle.", next_step="Give an angle in degrees.")
    low, high = limits_deg
    if not low <= target_deg <= high:
        start = {} if from_deg is None else {"from_deg": round(from_deg, 2)}
        raise LimitExceeded(
            f"The table cannot rotate{'' if from_deg is None else f' from {angle_words(from_deg)}'} to "
            f"{angle_words(target_deg)}: its cable budget is {budget_words(limits_deg)}.",
            next_step="Give an angle within these limits: add or subtract 360° for the same view.",
            evidence={**start, "to_deg": target_deg, "limits_deg": [low, high]},
        )


class Turntable(AbstractContextManager["Turntable"]):
    """The table of an open bench, with torque on for the duration of a ``with`` block.

    Entering moves nothing: `rig.safety.supervisor` decides whether the table may move, then the servo holds its present
    position. Leaving always switches the torque off.

    With ``trust_gyro`` a motion is stopped if the gyro contradicts the encoder; calibrations of the gyro do without it.
    For its first bias, the gyro is averaged over ``first_rest_s``. Calibrations give ``changes``: settings of the
    section ``table`` that differ from those of the bench. ``moves`` are the traces of the last moves.
    """

    def __init__(
        self, bench: Bench, *, trust_gyro: bool = True, first_rest_s: float = FIRST_REST_S, **changes: float
    ) -> None:
        self._config = bench.config.table.model_copy(update=changes)
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
        self._usual = MotionProfile(self._config.velocity_dps, self._config.acceleration_dps2)
        self._rest_deg = self._profile_deg = self._behind_deg = 0.0
        self._path = MotionPath((0.0, 0.0), self._config.velocity_dps)
        self._arrival_at = partial(Arrival, self._servo, self._gyro, self._clock, self._config)
        self._settle_s = SETTLE_ALLOWANCE_S
        if self._config.ringing_hz:
            fades_s = 1 / (2 * pi * self._config.ringing_hz * self._config.ringing_damping)
            self._settle_s += fades_s * log(RINGING_DPS / self._config.quiet_dps)
        self._backlash_taken_up = False
        self._state = bench.state
        self.moves: deque[MoveTrace] = deque(maxlen=KEPT)
        self._gyro.taps.append(self._trace_samples)

    def __enter__(self) -> Self:
        self._safety.prepare()
        try:
            self._servo.torque_on()
            # After torque on, which clears the watchdog: a watchdog that trips resets the profile to unlimited.
            self._profile = self._usual = self._servo.set_profile(self._usual)
            self._wait_for_rest(self.angle_deg(), self._config.quiet_s, self._settle_s)
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
            finally:
                if self.moves:
                    store(self._state, self.moves)

    @property
    def rest_deg(self) -> float:
        """Table angle by the encoder at the last rest."""
        return self._rest_deg

    @property
    def return_deg(self) -> float:
        """Target to come back to the last rest: friction may hold the table a bit beyond a limit of the cable."""
        low_deg, high_deg = self.limits_deg
        return min(max(self._rest_deg, low_deg), high_deg)

    @property
    def limits_deg(self) -> tuple[float, float]:
        """The cable budget: lowest and highest table angle."""
        return self._config.limits_deg

    def angle_deg(self) -> float:
        """Return the table's present angle by the encoder."""
        return self._safety.angle_reference.to_table(self._servo.read_state().position_deg)

    def check_target(self, target_deg: float) -> None:
        """Raise `LimitExceeded` if the target is outside the cable budget, `UsageError` if it is not a number."""
        check_angle(target_deg, self._config.limits_deg, self._rest_deg)

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
        rotation = self._begin()
        self._wait_for_rest(self._rest_deg, self._config.quiet_s, self._settle_s)
        return self._end(rotation, rotation.start_deg)

    def goto(self, target_deg: float) -> Move:
        """Rotate to ``target_deg`` (table, unwrapped) and return when the table is at rest there.

        Raises `LimitExceeded`: the target is outside the cable budget; nothing moved. `Stalled`, `Overloaded`,
        `FollowingError`, `NoProgress`, `Overheated`, `SupplyOutOfRange`, `RotationDisagreement`: see
        `rig.safety.motion_checks`; the table was stopped, and the fault is latched. `MotionTimeout`, `DeviceFault`: it
        did not come to rest within the computed time, or the servo reported a hardware error; latched as well.
        `WatchdogTripped`, `SupplyLost`, `DeviceSilent`: the computer was too slow, or the servo lost its supply or its
        cable; its own watchdog stops it. `MotionStopped`: the operator requested a stop. `FaultLatched`, `NotReady`: an
        earlier motion was interrupted.
        """
        # All stops are known before anything moves, so that the whole path can be stored and monitored.
        self.check_target(target_deg)
        waypoints = self._waypoints(target_deg)
        rotation = self._begin(*waypoints)
        with self._safety.motion((rotation.start_deg, *waypoints), self._stop) as motion:
            with causes_found(self._servo, self._limits):
                for goal_deg in waypoints:
                    # The table must rest only at the last stop; at the others it is enough to arrive.
                    quiet_s = self._config.quiet_s if goal_deg is waypoints[-1] else 0.0
                    cruise = self._start(goal_deg, quiet_s, rotation)
                    allowed_s = self._allowed_s(goal_deg - self._rest_deg, cruise)
                    self._wait_for_rest(goal_deg, quiet_s, allowed_s, rotation)
            self._arrive(motion)
        return self._end(rotation, target_deg)

    def approach(self, measured_deg: float) -> Move:
        """Rotate by what is missing to a measured angle, after `goto` it; raises what `goto` raises.

        Friction holds the table short of each goal. Whoever returns to where the table was, with one goal, leaves it a
        little lower each time.
        """
        low_deg, high_deg = self.limits_deg
        return self.goto(min(max(2 * measured_deg - self._rest_deg, low_deg), high_deg))

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
        ends_deg = target_deg, *flight.reach_deg
        for end_deg in ends_deg:
            self.check_target(end_deg)
        with self._recorded(flight):
            rotation = self._begin(*ends_deg)
            with self._safety.motion((rotation.start_deg, *ends_deg), self._stop) as motion:
                with causes_found(self._servo, self._limits):
                    rotation.monitor = self._monitor(self._rest_deg, target_deg, self._torque_profile())
                    self._servo.arm_watchdog(self._config.watchdog_s)
                    self._set_goal(target_deg)
                    target_deg = self._wait_in_flight(target_deg, flight, rotation)
                self._arrive(motion)
            return self._end(rotation, target_deg)

    def stopping_deg(self, state: ServoState) -> float:
        """Return where the table stops if it brakes now, as a table angle within the limits."""
        age_s = seconds_between(state.time_ns, self._clock.now_ns()) + self._config.poll_s / 2
        ramp_dps2 = self._torque_profile().acceleration_dps2
        servo_deg = stopping_deg(state, ramp_dps2, age_s, self._limits.following_error_deg)
        low_deg, high_deg = self._config.limits_deg
        return min(max(self._safety.angle_reference.to_table(servo_deg), low_deg), high_deg)

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
        still = peak <= self._config.quiet_dps and change <= quiet_deg(self._servo) and not slipped
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
        deadline_ns = self._clock.now_ns() + round(self._settle_s * 1e9)
        while True:
            try:
                self._gyro.rest(duration_s, self._safety.check_stop_request)
            except NotReady:
                if self._clock.now_ns() >= deadline_ns:
                    raise
            else:
                return

    def _torque_profile(self) -> MotionProfile:
        """Return the profile that the servo follows; raise `NotReady` if the table has no torque."""
        if self._profile is None:
            raise NotReady(
                "The table has no torque.", next_step="Use it in a with block: `with Turntable(bench) as table:`."
            )
        return self._profile

    @contextmanager
    def _recorded(self, flight: Flight) -> Iterator[None]:
        """Set the speed of a flight and give its recorder the gyro's samples; afterwards set the usual speed again."""
        usual = self._usual
        self._use(MotionProfile(flight.velocity_dps, usual.acceleration_dps2))
        self._gyro.taps.append(flight.recorder.add_samples)
        try:
            yield
        finally:
            self._gyro.taps.remove(flight.recorder.add_samples)
            if self._profile != usual:
                with uninterrupted():
                    self._profile = usual
                    if self._safety.state is TableState.READY:  # after a fault the servo may not answer
                        self._servo.set_profile(usual)

    def _begin(self, *ends_deg: float) -> _Rotation:
        """Begin to measure a rotation that stays between the present angle and these; none if the table stays."""
        self._torque_profile()
        self._safety.require_ready()
        rotation = _Rotation(self._clock.now_ns(), self._rest_deg)
        self._learn_bias(self._config.quiet_s)  # the bias drifts, so each rest measures it again
        self._gyro.begin()
        if ends_deg:
            bias_dps, _ = self._gyro.bias_of_table
            utc = self._clock.utc().isoformat(timespec="seconds")
            self.moves.append(MoveTrace(utc, rotation.started_ns, self._rest_deg, bias_dps))
            path_deg = [self._safety.angle_reference.to_servo(angle) for angle in (self._rest_deg, *ends_deg)]
            self._path = MotionPath((min(path_deg), max(path_deg)), self._config.velocity_dps)
            rotation.slip = SlipMonitor(self._limits, self._rest_deg) if self._trust_gyro else None
        return rotation

    def _start(self, goal_deg: float, quiet_s: float, rotation: _Rotation) -> MotionProfile:
        """Start a motion; if the platter's ringing is known, one that does not excite it. Return its cruise."""
        config, clock = self._config, self._clock
        plan, rotation.due = None, deque()
        if config.ringing_hz:
            step_deg = self._servo.resolution_deg  # the servo rounds its goal; a hundredth of a degree matters
            shaft_deg = round(self._safety.angle_reference.to_servo(goal_deg) / step_deg) * step_deg
            distance_deg, units = shaft_deg - self._profile_deg, self._servo.profile_units
            plan = shaped(distance_deg, self._usual, units, config, behind_deg=self._behind_deg)
        asked_ns = clock.now_ns()
        if plan is None:
            self._use(self._usual)
        else:
            self._profile = self._servo.set_profile(plan.parts[0][1])
        asking_s = seconds_between(asked_ns, clock.now_ns())
        cruise = self._usual if plan is None else plan.cruise
        rotation.monitor = self._monitor(self._rest_deg, goal_deg, cruise)
        self._servo.arm_watchdog(config.watchdog_s)
        begun_ns = clock.now_ns()
        self._set_goal(goal_deg)
        if plan is None:
            return cruise

        def change_to(profile: MotionProfile, at_s: float) -> None:
            self._use(profile)
            clock.sleep(at_s - seconds_between(begun_ns, clock.now_ns()))
            self._set_goal(goal_deg)

        # The readings at the end follow the motion closely, so that a table at rest is not waited for.
        ends_s = plan.seconds + GYRO_LAG_S
        rests_s = ends_s + quiet_s + GYRO_LAG_S / 4
        times_s = (ends_s, rests_s, rests_s + plan.rings_s) if quiet_s else (ends_s,)
        for at_s, profile in plan.parts[1:]:
            change = partial(change_to, profile, at_s)
            rotation.due.append((begun_ns + round((at_s - asking_s) * 1e9), change))
        rotation.due.extend((begun_ns + round(after_s * 1e9), lambda: None) for after_s in times_s)
        return cruise

    def _pause(self, rotation: _Rotation | None, longest_s: float) -> None:
        """Wait until the next reading, or act when it is due."""
        clock = self._clock
        if rotation is not None and rotation.due:
            at_ns, act = rotation.due[0]
            left_s = seconds_between(clock.now_ns(), at_ns)
            if left_s < longest_s + ROUND_S:
                rotation.due.popleft()
                clock.sleep(left_s)
                act()
                return
        clock.sleep(longest_s)

    def _use(self, profile: MotionProfile) -> None:
        """Set the servo's profile, unless it has this one."""
        now = self._torque_profile()
        if (
            max(abs(profile.velocity_dps - now.velocity_dps), abs(profile.acceleration_dps2 - now.acceleration_dps2))
            > 1e-3
        ):
            self._profile = self._servo.set_profile(profile)

    def _set_goal(self, goal_deg: float) -> None:
        self._safety.set_goal(self._safety.angle_reference.to_servo(goal_deg))
        self.moves[-1].goals.append((self._clock.now_ns(), goal_deg, self._torque_profile()))

    def _trace_samples(self, time_ns: NDArray[np.int64], rate_dps: NDArray[np.float64]) -> None:
        if self.moves:
            self.moves[-1].add_samples(time_ns, rate_dps)

    def _arrive(self, motion: Motion) -> None:
        self._servo.disarm_watchdog()
        self.moves[-1].settled_ns = self._clock.now_ns()
        motion.arrived(self._safety.angle_reference.to_servo(self._rest_deg))
        self._backlash_taken_up = True

    def _end(self, rotation: _Rotation, commanded_deg: float) -> Move:
        gyro = self._gyro.end()
        rotation_deg = self._rest_deg - rotation.start_deg
        agreement = None
        if gyro.valid:
            agreement = compare(
                rotation_deg, gyro, encoder_sigma_deg=self._servo.resolution_deg, backlash_deg=self._config.backlash_deg
            )
        by_gyro = self._config.orientation == "imu"
        if by_gyro and not gyro.valid:
            raise RotationDisagreement(
                f"The platter's rotation is unknown: {gyro.reason}. By table.orientation, only the gyro measures it.",
                next_step=("Check the IMU's cable and range.", *START_AGAIN),
                evidence={"table_deg": round(self._rest_deg, 2)},
            )
        return Move(
            commanded_deg,
            self._rest_deg,
            rotation_deg,
            gyro,
            agreement,
            rotation.started_ns,
            self._clock.now_ns(),
            by_gyro,
        )

    def _monitor(self, start_deg: float, goal_deg: float, cruise: MotionProfile) -> MotionMonitor:
        return MotionMonitor(
            self._limits,
            self._servo.limits,
            start_deg=start_deg,
            goal_deg=goal_deg,
            tolerance_deg=self._config.tolerance_deg,
            cruise_dps=cruise.velocity_dps,
        )

    def _allowed_s(self, distance_deg: float, cruise: MotionProfile) -> float:
        return 1.5 * motion_seconds(distance_deg, cruise) + self._settle_s

    def _wait_for_rest(
        self, goal_deg: float, quiet_s: float, allowed_s: float, rotation: _Rotation | None = None
    ) -> None:
        """Poll until the table has arrived at the goal and has been quiet for ``quiet_s``.

        The polling also feeds the servo's watchdog.
        """
        arrival, rest_deg = self._arrival_at(goal_deg, quiet_s, allowed_s), None
        # A shaped motion that another one follows must end: the shaft still moves when its profile has ended.
        while rest_deg is None or (rotation is not None and rotation.due and not quiet_s):
            self._pause(rotation, self._config.poll_s / (AT_GOAL if arrival.has_arrived else 1))
            state, angle_deg = self._read()
            self._check(state, angle_deg, rotation)
            rest_deg = arrival.rest_deg(state, angle_deg)
        self._rest_deg = rest_deg

    def _wait_in_flight(self, goal_deg: float, flight: Flight, rotation: _Rotation) -> float:
        """Record and steer until the table has arrived; return the last goal."""
        low_deg, high_deg = flight.reach_deg
        quiet_s = self._config.quiet_s if flight.quiet else 0.0
        cruise = self._torque_profile()
        arrival = self._arrival_at(goal_deg, quiet_s, self._allowed_s(goal_deg - self._rest_deg, cruise))
        rest_deg = None
        while rest_deg is None:
            # The next frame may change the goal.
            asked_deg = flight.each()
            next_deg = goal_deg if asked_deg is None else min(max(asked_deg, low_deg), high_deg)
            state, angle_deg = self._read(gyro_now=True)
            flight.recorder.add_reading(state.sampled_ns or state.time_ns, angle_deg)
            if abs(next_deg - goal_deg) > self._config.tolerance_deg / 2:
                goal_deg = next_deg
                self._set_goal(goal_deg)
                # If the goal is behind the table, it overshoots before it comes back.
                stop_deg = self.stopping_deg(state)
                farthest_deg = stop_deg if abs(stop_deg - goal_deg) > abs(angle_deg - goal_deg) else angle_deg
                rotation.monitor = self._monitor(farthest_deg, goal_deg, cruise)
                arrival = self._arrival_at(goal_deg, quiet_s, self._allowed_s(goal_deg - angle_deg, cruise))
            self._check(state, angle_deg, rotation)
            rest_deg = arrival.rest_deg(state, angle_deg)
        self._rest_deg = rest_deg
        return goal_deg

    def _read(self, *, gyro_now: bool = False) -> tuple[ServoState, float]:
        """Look for a request to stop, then read servo and gyro; return the servo's state and the table's angle."""
        self._safety.check_stop_request()
        state = self._servo.read_state()
        for observer in self._safety.observers:
            observer(state)
        self._path.add(state)
        self._profile_deg = state.position_deg if state.trajectory_deg is None else state.trajectory_deg
        self._behind_deg = self._profile_deg - state.position_deg
        self._gyro.update(now=gyro_now)
        to_table = self._safety.angle_reference.to_table
        angle_deg = to_table(state.position_deg)
        if self.moves and self.moves[-1].settled_ns is None:
            profile_deg = None if state.trajectory_deg is None else to_table(state.trajectory_deg)
            self.moves[-1].add_reading(state, angle_deg, profile_deg)
        return state, angle_deg

    def _check(self, state: ServoState, angle_deg: float, rotation: _Rotation | None) -> None:
        if rotation is None or rotation.monitor is None:
            self._safety.check_servo(state)
        else:
            lag_deg = None if state.trajectory_deg is None else state.trajectory_deg - state.position_deg
            rotation.monitor.check(state, angle_deg, lag_deg)
        if rotation is not None and (slip := rotation.slip):
            slip.add_reading(state.time_ns, angle_deg)
            if encoder := slip.encoder_deg(self._gyro.newest_ns):
                at_ns, rotation_deg = encoder
                slip.compare(rotation_deg, self._gyro.since_rest(at_ns))

    def _stop(self) -> bool:
        ramp_dps2, lag_deg = (self._profile or self._config).acceleration_dps2, self._limits.following_error_deg
        return halt(
            self._servo, self._clock, self._safety.set_goal, self._path, ramp_dps2, lag_deg, self._config.poll_s
        )
