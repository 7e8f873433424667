"""The table: goes to an angle, always from the same side, and knows when it is at rest and how far it really turned."""

from collections import deque
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass
from math import ceil, floor, isfinite, sqrt
from types import TracebackType
from typing import Self

from rig.bench import Bench
from rig.clock import seconds_between
from rig.devices.servo import MotionProfile, ServoState
from rig.errors import DeviceFault, LimitExceeded, MotionTimeout, NotReady, RigError
from rig.heading import Agreement, GyroHeading, Rotation, Stillness, compare, finite

QUIET_COUNTS = 3
"""Encoder counts that readings at rest may differ by: one of quantisation, the rest of its noise."""

FIRST_REST_S = 0.6
"""How long the gyro is averaged for its first bias."""

SETTLE_ALLOWANCE_S = 2.5
"""Time for ringing to die down and for a slow bus, on top of the motion's own."""


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

    @property
    def agrees(self) -> bool:
        """Whether encoder and gyro tell the same, or the gyro has nothing to tell."""
        return self.agreement is None or self.agreement.agrees

    @property
    def rotation_deg(self) -> float:
        """The rotation to believe: the encoder's, unless the gyro, which rides on the platter, contradicts it."""
        return self.rotation_encoder_deg if self.agrees else self.gyro.angle_deg

    @property
    def seconds(self) -> float:
        return seconds_between(self.started_ns, self.settled_ns)


def motion_seconds(distance_deg: float, profile: MotionProfile) -> float:
    """Return the duration of a trapezoid (or triangle) profile over ``distance_deg``."""
    distance, v, a = abs(distance_deg), profile.velocity_dps, profile.acceleration_dps2
    if distance < v * v / a:
        return 2 * sqrt(distance / a)
    return distance / v + v / a


class Turntable(AbstractContextManager["Turntable"]):
    """The table of an open bench, with torque on for the length of a ``with`` block.

    Entering moves nothing: the servo is told to hold where it is. Leaving, on whatever way, takes the torque off.
    """

    def __init__(self, bench: Bench) -> None:
        self._config = bench.config.table
        self._servo = bench.servo
        self._clock = bench.clock
        imu = bench.config.imu
        self._heading = GyroHeading(
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
        self._broken_off = False

    def __enter__(self) -> Self:
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
        self._broken_off = False
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._profile = None
        try:
            self._servo.torque_off()
        except RigError:
            if error is None:
                raise

    @property
    def rest_deg(self) -> float:
        """Angle by the encoder at the last rest."""
        return self._rest_deg

    def angle_deg(self) -> float:
        """Return the table's angle by the encoder, now."""
        return self._to_table(self._servo.read_state().position_deg)

    def check_target(self, target_deg: float) -> None:
        """Raise `LimitExceeded` where the cable does not reach."""
        low, high = self._config.limits_deg
        if not low <= target_deg <= high:
            raise LimitExceeded(
                f"The table cannot turn to {target_deg:.1f}°: its cable reaches from {low:g}° to {high:g}°.",
                next_step="Give an angle within the limits, or the same view a turn earlier (subtract or add 360).",
                evidence={"from_deg": round(self._rest_deg, 2), "to_deg": target_deg, "limits_deg": [low, high]},
            )

    def within_reach(self, target_deg: float) -> float:
        """Return the angle equivalent to ``target_deg`` (whole turns away) within the limits, nearest to where we are.

        ``target_deg`` itself where it is within the limits: the cable is unwound only when it must be.
        """
        low, high = self._config.limits_deg
        if low <= target_deg <= high:
            return target_deg
        turns = range(ceil((low - target_deg) / 360), floor((high - target_deg) / 360) + 1)
        return min((target_deg + 360 * k for k in turns), key=lambda angle: abs(angle - self._rest_deg))

    def hold(self) -> Move:
        """Stay, and return once the table is at rest: the move of no rotation before a first view."""
        return self._move(self._rest_deg, ())

    def goto(self, target_deg: float) -> Move:
        """Turn to ``target_deg`` (table, unwrapped) and return when the table is at rest there.

        Raises
        ------
        LimitExceeded
            Before anything moves.
        MotionTimeout
            The table did not arrive, or did not come to rest, within the computed time; it was stopped.
        DeviceFault, DeviceSilent
            The servo reported a hardware error or fell silent; its own watchdog stops it.
        """
        self.check_target(target_deg)
        return self._move(target_deg, self._waypoints(target_deg))

    def check_still(self, since_ns: int | None = None) -> Stillness:
        """Look again at encoder and gyro, for the evidence of a view taken since the table came to rest.

        The rate is looked at from ``since_ns`` on, but never for less than ``table.quiet_s``; the angles of shaft and
        platter are compared with those of the rest, however long ago.
        """
        change = abs(self.angle_deg() - self._rest_deg)
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

    def _to_table(self, servo_deg: float) -> float:
        return self._config.direction * (servo_deg - self._config.zero_deg)

    def _to_servo(self, table_deg: float) -> float:
        return self._config.direction * table_deg + self._config.zero_deg

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
        if self._broken_off:
            raise NotReady(
                "The last motion was broken off: where the table rests is in doubt.",
                next_step="Find the cause, then leave the with block and enter it anew.",
            )
        started_ns, start_deg = self._clock.now_ns(), self._rest_deg
        self._learn_bias(self._config.quiet_s)  # it wanders: each rest measures it anew
        self._heading.begin()
        try:
            for waypoint in waypoints:
                self._servo.arm_watchdog(self._config.watchdog_s)
                self._servo.move_to(self._to_servo(waypoint))
                allowed_s = 1.5 * motion_seconds(waypoint - self._rest_deg, self._profile) + SETTLE_ALLOWANCE_S
                # Only the last stop must be a rest; on the way it is enough to have arrived.
                quiet_s = self._config.quiet_s if waypoint is waypoints[-1] else 0.0
                self._wait_for_rest(waypoint, quiet_s, allowed_s)
            if not waypoints:
                self._wait_for_rest(target_deg, self._config.quiet_s, SETTLE_ALLOWANCE_S)
            self._servo.disarm_watchdog()
        except BaseException:
            self._broken_off = True
            self._stop()
            raise
        self._play_taken_up = self._play_taken_up or bool(waypoints)
        gyro = self._heading.end()
        rotation_deg = self._rest_deg - start_deg
        agreement = None
        if gyro.valid:
            agreement = compare(
                rotation_deg, gyro, encoder_sigma_deg=self._servo.resolution_deg, backlash_deg=self._config.backlash_deg
            )
        return Move(target_deg, self._rest_deg, rotation_deg, gyro, agreement, started_ns, self._clock.now_ns())

    def _wait_for_rest(self, goal_deg: float, quiet_s: float, allowed_s: float) -> None:
        """Poll until the servo is in position and encoder and gyro have been quiet for ``quiet_s``.

        The polling feeds the servo's watchdog.
        """
        config = self._config
        start_ns = self._clock.now_ns()
        readings: deque[tuple[int, float]] = deque()
        while True:
            self._clock.sleep(config.poll_s)
            state = self._servo.read_state()
            self._heading.update()
            self._refuse_faults(state)
            angle_deg = self._to_table(state.position_deg)
            arrived = state.in_position and not state.moving and abs(angle_deg - goal_deg) <= config.tolerance_deg
            if not arrived:
                readings.clear()
            readings.append((state.time_ns, angle_deg))
            if arrived and self._quiet(readings, quiet_s):
                self._rest_deg = sum(angle for _, angle in readings) / len(readings)
                return
            elapsed_s = seconds_between(start_ns, self._clock.now_ns())
            if elapsed_s > allowed_s:
                raise MotionTimeout(
                    f"The table did not come to rest at {goal_deg:.1f}° within {allowed_s:.1f} s.",
                    next_step="Look for what blocks or shakes the table, and for a cable at its end; then start again.",
                    evidence={
                        "goal_deg": round(goal_deg, 2),
                        "encoder_deg": round(angle_deg, 2),
                        "in_position": state.in_position,
                        "moving": state.moving,
                        "peak_rate_dps": finite(self._heading.peak_dps(config.quiet_s)),
                        "load_percent": round(state.load_percent, 1),
                        "voltage_v": round(state.voltage_v, 1),
                    },
                )

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

    def _refuse_faults(self, state: ServoState) -> None:
        if state.hardware_errors:
            raise DeviceFault(
                f"The servo stopped with a hardware error: {', '.join(state.hardware_errors)}.",
                next_step="Remove the cause (jam, heat, supply), then power-cycle the servo.",
                evidence={"temperature_c": state.temperature_c, "voltage_v": round(state.voltage_v, 1)},
            )

    def _stop(self) -> None:
        """Bring the table to a stop where it is; a servo that does not hear this is stopped by its watchdog."""
        with suppress(RigError, OSError):
            self._servo.move_to(self._servo.read_state().position_deg)
            self._servo.disarm_watchdog()
