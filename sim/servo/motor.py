"""The gear motor on the world's shaft: how it follows a commanded trajectory, what that costs, and what holds it up."""

from math import exp

from sim.motion import Trajectory, rest, to_position, to_velocity
from sim.servo.models import DEG_PER_COUNT, PWM_FULL, ServoModel
from sim.world import World

FRICTION_LOAD = 0.04
"""Part of the stall torque that the gears' friction takes while the shaft turns."""
PWM_PER_COUNT = 5.0
"""PWM that the position controller adds for each count of error: Position P Gain 640 / 128 (e-manual, XL430-W250)."""
SUPPLY_DROP_V = 0.4
"""Voltage lost in the supply's cable at stall."""

AMBIENT_C = 25.0
STANDBY_RISE_C = 8.0
"""Warming by the electronics alone."""
STALL_RISE_C = 90.0
"""Warming at stall torque in the long run; it goes with the square of the load."""
THERMAL_TIME_S = 400.0
"""Time constant of the case."""

OVERLOAD_LOAD = 0.99
OVERLOAD_S = 2.0
"""How long the motor may push with all it has before the servo calls it an overload; the e-manual gives no number."""


class Motor:
    """A position- or speed-controlled shaft in the world's degrees.

    The shaft follows what is commanded exactly, unless it is jammed: then it stands, the controller's error grows, and with it
    the load. `settle` takes heat and overload forward; whoever owns the motor calls it before each change and now and then
    while the load varies.
    """

    def __init__(self, world: World, model: ServoModel) -> None:
        self._world = world
        self._model = model
        self.supply_v = model.supply_v
        self._temperature_c = AMBIENT_C + STANDBY_RISE_C
        self._settled_s = self._now_s()
        self._overloaded_s = 0.0
        self._jammed = False
        self._driven = False
        self.commanded = rest(self._now_s(), self.angle()[0])

    # -- motion ---------------------------------------------------------------------------------------------------

    @property
    def fastest_dps(self) -> float:
        """Speed without load at the present supply."""
        return self._model.no_load_dps * max(self.supply_v, 0.1) / self._model.supply_v

    @property
    def steepest_dps2(self) -> float:
        return self._model.acceleration_dps2

    @property
    def jammed(self) -> bool:
        return self._jammed

    @property
    def busy(self) -> bool:
        """Whether the load varies: a motion is in progress, or the shaft is held up while driven."""
        return self._driven and (self._jammed or self.profile_ongoing or self.commanded.velocity_dps[-1] != 0)

    @property
    def profile_ongoing(self) -> bool:
        return self._driven and self._now_s() < self.commanded.end_s

    def angle(self) -> tuple[float, float]:
        """Return angle (°) and speed (°/s) of the shaft."""
        return self._world.shaft()

    def command(self) -> tuple[float, float]:
        """Return angle (°) and speed (°/s) that the shaft should have."""
        position, velocity = self.commanded.at(self._now_s())
        return float(position), float(velocity)

    def hold(self) -> None:
        """Drive the shaft, to stay where it is."""
        self.settle()
        self._driven = True
        self._follow(rest(self._now_s(), self.angle()[0]))

    def release(self) -> None:
        """Drive the shaft no longer; friction stops it."""
        self.settle()
        self._driven = False
        self._follow(to_velocity(self._now_s(), *self.angle(), 0.0, self.steepest_dps2))

    def brake(self) -> None:
        """Stop as fast as possible and hold."""
        self.settle()
        self._follow(to_velocity(self._now_s(), *self.angle(), 0.0, self.steepest_dps2))

    def go_to(self, angle_deg: float, velocity_dps: float, acceleration_dps2: float) -> None:
        self.settle()
        self._follow(to_position(self._now_s(), *self.command(), angle_deg, velocity_dps, acceleration_dps2))

    def turn_at(self, velocity_dps: float, acceleration_dps2: float) -> None:
        self.settle()
        self._follow(to_velocity(self._now_s(), *self.command(), velocity_dps, acceleration_dps2))

    def jam(self) -> None:
        """Hold the shaft where it is, against whatever drives it."""
        self.settle()
        self._jammed = True
        self._world.drive(rest(self._now_s(), self.angle()[0]))

    def free(self) -> None:
        """Let a jammed shaft go: it makes up for the error as fast as it can."""
        self.settle()
        self._jammed = False
        if not self._driven:
            return
        angle, goal, cruise = self.angle()[0], float(self.commanded.position_deg[-1]), self.commanded.velocity_dps[-1]
        if cruise:
            self._follow(to_velocity(self._now_s(), angle, 0.0, float(cruise), self.steepest_dps2))
        else:
            self._follow(to_position(self._now_s(), angle, 0.0, goal, self.fastest_dps, self.steepest_dps2))

    def push(self, path: Trajectory) -> None:
        """Let a hand turn the shaft along ``path``."""
        self.settle()
        self._follow(path)

    # -- effort ---------------------------------------------------------------------------------------------------

    def load(self) -> float:
        """Return the torque as a fraction of the stall torque, -1..1, positive counter-clockwise."""
        if not self._driven:
            return 0.0
        if self._jammed:
            error_counts = (self.command()[0] - self.angle()[0]) / DEG_PER_COUNT
            return _clamp(PWM_PER_COUNT * error_counts / PWM_FULL)
        speed = self.angle()[1]
        friction = FRICTION_LOAD * ((speed > 0) - (speed < 0))
        inertia = (1 - FRICTION_LOAD) * float(self.commanded.acceleration_at(self._now_s())) / self.steepest_dps2
        return _clamp(friction + inertia)

    def pwm(self) -> float:
        """Return the output as a fraction of the supply, -1..1: what the speed and the load take."""
        return _clamp(self.angle()[1] / self.fastest_dps + self.load()) if self._driven else 0.0

    def terminal_v(self) -> float:
        return self.supply_v - SUPPLY_DROP_V * abs(self.load())

    def temperature_c(self) -> float:
        """Return the temperature of the case, taking the present load for the time since `settle`."""
        target = AMBIENT_C + STANDBY_RISE_C + STALL_RISE_C * self.load() ** 2
        decay = exp(-(self._now_s() - self._settled_s) / THERMAL_TIME_S)
        return target + (self._temperature_c - target) * decay

    def set_temperature(self, temperature_c: float) -> None:
        self.settle()
        self._temperature_c = temperature_c

    @property
    def overloaded(self) -> bool:
        return self._overloaded_s >= OVERLOAD_S

    def settle(self) -> None:
        """Account for the time since the last call, with the present load."""
        now_s = self._now_s()
        self._temperature_c = self.temperature_c()
        pushing = abs(self.load()) >= OVERLOAD_LOAD and self._jammed
        self._overloaded_s = self._overloaded_s + now_s - self._settled_s if pushing else 0.0
        self._settled_s = now_s

    # -- inside ---------------------------------------------------------------------------------------------------

    def _follow(self, path: Trajectory) -> None:
        self.commanded = path
        if not self._jammed:
            self._world.drive(path)

    def _now_s(self) -> float:
        return self._world.clock.now_ns() * 1e-9


def _clamp(value: float) -> float:
    return min(max(value, -1.0), 1.0)
