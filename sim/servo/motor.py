"""The gear motor on the table's shaft: trajectory, load, temperature and jams."""

from dataclasses import dataclass, replace
from math import copysign, exp

from sim.motion import PiecewiseMotion, Response, rest, to_position, to_velocity
from sim.servo.models import ServoModel
from sim.world import World

FRICTION_LOAD = 0.04  # friction of the gears while the shaft rotates, as a part of the stall torque
SUPPLY_DROP_V = 0.4  # voltage lost in the supply's cable at stall

AMBIENT_C = 25.0  # a laboratory
STANDBY_RISE_C = 8.0  # rise of the temperature by the electronics alone
STALL_RISE_C = 90.0  # final rise at stall torque; proportional to the square of the load
THERMAL_TIME_S = 400.0  # time constant of the case

HAND_DPS = 90.0  # speed of a rotation by hand

OVERLOAD = 0.99  # just below 1, because the load is a rounded number
OVERLOAD_S = 2.0
"""Time at full torque after which the servo reports an overload; the e-manual states no value."""


@dataclass(frozen=True, slots=True)
class MotorState:
    """True and commanded state of the shaft and the load; positive counter-clockwise.

    ``load`` is a fraction of the stall torque, ``pwm`` of the supply, both -1..1.
    """

    angle_deg: float
    speed_dps: float
    target_deg: float
    target_dps: float
    load: float
    pwm: float


class Motor:
    """A position- or speed-controlled shaft in its own degrees: ``gear_ratio`` revolutions for one of the table.

    The shaft follows the commanded trajectory by its `Response`, without noise exactly. If it is jammed it does not
    move, and the controller's error and the load grow. `settle` updates heat and overload with the present
    load; the owner of the motor calls it repeatedly while the motor is `busy`.
    """

    def __init__(self, world: World, model: ServoModel, gear_ratio: float = 1.0) -> None:
        self.supply_v = model.supply_v
        self._world = world
        self._gear_ratio = gear_ratio
        self.commanded = rest(self._now_s(), self.shaft()[0])
        self._model = model
        self.driven = False
        self._jammed = False
        noise = world.noise
        self._lag_s = noise.servo_lag * model.stall_error_deg / model.no_load_dps
        spread = noise.servo_friction_spread * float(world.rng("servo-friction").standard_normal())
        self._own_friction = self._friction = noise.servo_friction * exp(spread)
        self._steady_load = 0.0
        self._still_s = 0.0
        self._temperature_c = AMBIENT_C + STANDBY_RISE_C
        self._overloaded_s = 0.0
        self._settled_s = self._now_s()

    # -- state ----------------------------------------------------------------------------------------------------

    @property
    def fastest_dps(self) -> float:
        """Speed without load at the present supply."""
        return self._model.no_load_dps * max(self.supply_v, 0.1) / self._model.supply_v

    @property
    def steepest_dps2(self) -> float:
        inert = self._lag_s and self._model.inertia_s  # then its response limits the acceleration, not its profile
        return self._model.acceleration_dps2 * (10 if inert else 1)

    @property
    def profile_ongoing(self) -> bool:
        """Whether the commanded trajectory has not ended."""
        return self.driven and self._now_s() < self.commanded.end_s

    @property
    def busy(self) -> bool:
        """Whether the load varies: the shaft rotates, or is blocked while driven."""
        moves = max(self.commanded.end_s, self._still_s) > self._now_s() or bool(self.commanded.velocity_dps[-1])
        return self.driven and (self._jammed or moves)

    @property
    def held_deg(self) -> float:
        """Distance from its goal at which friction holds the shaft."""
        return self._model.stall_error_deg * self._friction

    @property
    def overloaded(self) -> bool:
        return self._overloaded_s >= OVERLOAD_S

    def shaft(self) -> tuple[float, float]:
        """Return angle (°) and speed (°/s) of the shaft, without ripple."""
        angle, speed = self._world.shaft()
        return angle * self._gear_ratio, speed * self._gear_ratio

    def rippled_deg(self) -> float:
        """Return the angle of the shaft with the ripple of its speed, as the encoder sees it."""
        return self._world.rippled_deg() * self._gear_ratio

    def state(self) -> MotorState:
        now_s = self._now_s()
        angle, speed = self.shaft()
        target, target_dps, acceleration = self.commanded.state_at(now_s)
        load = pwm = 0.0
        if self.driven:
            if speed:
                friction = copysign(max(FRICTION_LOAD, self._friction), speed)
                load = _clamp(friction + (1 - FRICTION_LOAD) * acceleration / self.steepest_dps2)
            else:
                load = _clamp((target - angle) / self._model.stall_error_deg)
            pwm = _clamp(speed / self.fastest_dps + load)
        return MotorState(angle, speed, target, target_dps, load, pwm)

    def terminal_v(self, load: float) -> float:
        return self.supply_v - SUPPLY_DROP_V * abs(load)

    def temperature_c(self, load: float) -> float:
        """Return the temperature of the case, with ``load`` since the last `settle`."""
        target = AMBIENT_C + STANDBY_RISE_C + STALL_RISE_C * load**2
        return target + (self._temperature_c - target) * exp((self._settled_s - self._now_s()) / THERMAL_TIME_S)

    def set_temperature(self, temperature_c: float) -> None:
        self.settle()
        self._temperature_c = temperature_c

    def settle(self) -> None:
        """Account for heat and overload since the last call."""
        load, now_s = self.state().load, self._now_s()
        self._temperature_c = self.temperature_c(load)
        self._overloaded_s = self._overloaded_s + now_s - self._settled_s if abs(load) >= OVERLOAD else 0.0
        self._settled_s = now_s

    # -- commands of the controller -------------------------------------------------------------------------------

    def hold(self) -> None:
        """Hold the shaft at its angle."""
        self._follow(rest(self._now_s(), self.shaft()[0]), driven=True)

    def release(self) -> None:
        """Stop driving the shaft; friction stops it."""
        self._follow(self._stop(), driven=False)

    def brake(self) -> None:
        """Stop as fast as possible and hold."""
        state = self.state()
        if self._jammed:
            self._follow(self._stop())
        else:
            self._follow(to_velocity(self._now_s(), state.target_deg, state.target_dps, 0.0, self.steepest_dps2))

    def go_to(self, angle_deg: float, v_max: float, a_max: float) -> None:
        state = self.state()
        self._follow(to_position(self._now_s(), state.target_deg, state.target_dps, angle_deg, v_max, a_max))

    def rotate_at(self, speed_dps: float, a_max: float) -> None:
        state = self.state()
        self._follow(to_velocity(self._now_s(), state.target_deg, state.target_dps, speed_dps, a_max))

    # -- for tests and faults -------------------------------------------------------------------------------------

    def jam(self) -> None:
        """Block the shaft at its angle."""
        self.settle()
        self._jammed = True
        self._drive(rest(self._now_s(), self.shaft()[0]))

    def free(self) -> None:
        """Release a jammed shaft; it moves at maximum speed to its commanded angle, or at its commanded speed."""
        self.settle()
        self._jammed = False
        if not self.driven:
            return
        angle_deg, goal = self.shaft()[0], float(self.commanded.position_deg[-1])
        if cruise := float(self.commanded.velocity_dps[-1]):
            self._follow(to_velocity(self._now_s(), angle_deg, 0.0, cruise, self.steepest_dps2))
        else:
            self._follow(to_position(self._now_s(), angle_deg, 0.0, goal, self.fastest_dps, self.steepest_dps2))

    def set_friction(self, friction: float | None = None, steady_load: float = 0.0) -> None:
        """Set the friction at rest, and a steady load that pushes clockwise, as shares of the stall torque.

        Without a number the friction is that of the part. A load above the friction would rotate a released shaft, so
        it counts only up to the friction. A driven shaft moves as close to its commanded angle as the friction permits.
        """
        self.settle()
        self._friction = self._own_friction if friction is None else friction
        self._steady_load = min(max(steady_load, -self._friction), self._friction)
        if self.driven and not self._jammed and not self.commanded.velocity_dps[-1] and not self.profile_ongoing:
            goal = float(self.commanded.position_deg[-1])
            self._follow(
                to_position(self._now_s(), *self.shaft(), goal, self.fastest_dps, self.steepest_dps2),
            )

    def push(self, angle_deg: float) -> float:
        """Rotate the released shaft by hand by ``angle_deg``; return the time of the motion in seconds.

        Raises `ValueError` if the shaft is driven or jammed.
        """
        if self.driven or self._jammed:
            raise ValueError("A held shaft cannot be rotated: switch the servo's torque off and free it first.")
        angle, speed = self.shaft()
        self._follow(to_position(self._now_s(), angle, speed, angle + angle_deg, HAND_DPS, 4 * HAND_DPS))
        return self.commanded.end_s - self._now_s()

    def _stop(self) -> PiecewiseMotion:
        return to_velocity(self._now_s(), *self.shaft(), 0.0, self.steepest_dps2)

    def _follow(self, path: PiecewiseMotion, driven: bool | None = None) -> None:
        self.settle()
        self.commanded = path
        if driven is not None:
            self.driven = driven
        if self._jammed:
            return
        if self.driven and (self._lag_s or self._friction):
            offset_deg = -self._model.stall_error_deg * self._steady_load
            response = Response(self._lag_s, self._model.inertia_s, self.held_deg, offset_deg, self.fastest_dps)
            path = response.follow(path, *self.shaft())
        self._still_s = path.end_s
        self._drive(path)

    def _drive(self, path: PiecewiseMotion) -> None:
        ratio = self._gear_ratio
        self._world.drive(
            replace(
                path,
                position_deg=path.position_deg / ratio,
                velocity_dps=path.velocity_dps / ratio,
                acceleration_dps2=path.acceleration_dps2 / ratio,
            )
        )

    def _now_s(self) -> float:
        return self._world.clock.now_ns() * 1e-9


def _clamp(value: float) -> float:
    return min(max(value, -1.0), 1.0)
