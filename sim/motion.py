"""Trajectories of the servo's shaft and the resulting motion of the platter, in closed form.

All functions take arrays of times, including past ones. So the gyro's FIFO and a frame's exposure get the angle at
their own time, without an integration in steps.
"""

from dataclasses import dataclass
from math import copysign, inf, sqrt

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class PiecewiseMotion:
    """Motion with piecewise constant acceleration."""

    start_s: Floats
    """float64 (k,): times at which the pieces begin, rising; the last piece has no end."""
    position_deg: Floats
    velocity_dps: Floats
    acceleration_dps2: Floats
    """float64 (k,): state at the beginning of each piece, and its acceleration."""

    @property
    def end_s(self) -> float:
        """Time at which the last change of acceleration happens."""
        return float(self.start_s[-1])

    def at(self, time_s: ArrayLike) -> tuple[Floats, Floats]:
        """Return position and velocity at ``time_s``; before the first piece, its beginning."""
        return self.within(*self.pieces(np.asarray(time_s, dtype=np.float64)))

    def pieces(self, time_s: Floats) -> tuple[NDArray[np.intp], Floats]:
        """Return the number of the piece at each time, and the time since its beginning."""
        piece = np.maximum(self.start_s.searchsorted(time_s, side="right") - 1, 0)
        return piece, np.maximum(time_s - self.start_s[piece], 0.0)

    def within(self, piece: NDArray[np.intp], since_s: Floats) -> tuple[Floats, Floats]:
        """Return position and velocity at times since the beginning of pieces."""
        v, a = self.velocity_dps[piece], self.acceleration_dps2[piece]
        return self.position_deg[piece] + v * since_s + 0.5 * a * since_s**2, v + a * since_s

    def state_at(self, time_s: float) -> tuple[float, float, float]:
        """Return position, velocity and acceleration at one time: as `at`, which takes ten times as long for it."""
        i = max(int(self.start_s.searchsorted(time_s, side="right")) - 1, 0)
        tau = max(time_s - self.start_s.item(i), 0.0)
        x, v, a = self.position_deg.item(i), self.velocity_dps.item(i), self.acceleration_dps2.item(i)
        return x + v * tau + 0.5 * a * (tau * tau), v + a * tau, a


def _from_pieces(
    start_s: float, position: float, velocity: float, pieces: list[tuple[float, float]]
) -> PiecewiseMotion:
    """Chain (duration, acceleration) pieces; one that reverses is cut at its standstill, so that each is monotone."""
    rows: list[tuple[float, float, float, float]] = []
    t, x, v = start_s, position, velocity
    for duration, a in pieces:
        if duration <= 0:
            continue
        rotation = -v / a if a and v else 0.0
        if 0 < rotation < duration:
            rows.append((t, x, v, a))
            t, x, v = t + rotation, x + 0.5 * v * rotation, 0.0  # not a rounded speed in the former direction
            duration -= rotation
        rows.append((t, x, v, a))
        t, x, v = t + duration, x + v * duration + 0.5 * a * duration * duration, v + a * duration
    rows.append((t, x, v, 0.0))
    columns = np.array(rows, dtype=np.float64).T
    return PiecewiseMotion(*(np.ascontiguousarray(c) for c in columns))


def rest(start_s: float, position_deg: float) -> PiecewiseMotion:
    """Return a standstill."""
    return _from_pieces(start_s, position_deg, 0.0, [])


def to_position(
    start_s: float, position_deg: float, velocity_dps: float, goal_deg: float, v_max: float, a_max: float
) -> PiecewiseMotion:
    """Return the trapezoid (or triangle) profile from a moving start to a standstill at ``goal_deg``.

    ``v_max`` in °/s and ``a_max`` in °/s², both positive. A start that is too fast to stop in time overshoots and
    returns.
    """
    v0 = velocity_dps
    stop_at = position_deg + copysign(v0 * v0 / (2 * a_max), v0) if v0 else position_deg
    direction = copysign(1.0, goal_deg - stop_at)
    u0 = v0 * direction  # speed towards the goal
    braking: list[tuple[float, float]] = []
    if u0 > v_max:
        braking = [((u0 - v_max) / a_max, -direction * a_max)]
    x1 = position_deg + sum(v0 * d + 0.5 * a * d * d for d, a in braking)
    u1 = min(u0, v_max)
    distance = (goal_deg - x1) * direction  # negative if the shaft runs away from the goal and has to come back
    u_peak = min(v_max, sqrt(max(distance * a_max + 0.5 * u1 * u1, 0.0)))
    ramps = (2 * u_peak**2 - u1 * u1) / (2 * a_max)
    cruise = max(distance - ramps, 0.0) / u_peak if u_peak > 0 else 0.0
    pieces = [*braking, ((u_peak - u1) / a_max, direction * a_max), (cruise, 0.0), (u_peak / a_max, -direction * a_max)]
    path = _from_pieces(start_s, position_deg, v0, pieces)
    path.position_deg[-1], path.velocity_dps[-1] = goal_deg, 0.0  # the last knot carries no rounding
    return path


def to_velocity(
    start_s: float, position_deg: float, velocity_dps: float, goal_dps: float, a_max: float
) -> PiecewiseMotion:
    """Return a ramp from ``velocity_dps`` to ``goal_dps``, followed by that speed without end."""
    change = goal_dps - velocity_dps
    path = _from_pieces(
        start_s, position_deg, velocity_dps, [(abs(change) / a_max, copysign(a_max, change))] if change else []
    )
    path.velocity_dps[-1] = goal_dps
    return path


@dataclass(frozen=True, slots=True)
class Response:
    """How a position controller without an integral part moves its shaft along a commanded path.

    It asks for a speed in proportion to the error, so the shaft is behind a steady motion by ``lag_s`` of it. Friction
    holds the shaft within ``half_deg`` of the path, and a steady load shifts it by ``offset_deg``. The shaft takes
    ``inertia_s`` to reach the speed asked for: with more than a quarter of ``lag_s`` it overshoots.
    """

    lag_s: float
    inertia_s: float
    half_deg: float
    offset_deg: float
    fastest_dps: float

    def follow(self, path: PiecewiseMotion, angle_deg: float, speed_dps: float) -> PiecewiseMotion:
        """Return the motion of a shaft with this angle and speed at the beginning of ``path``."""
        # The law is solved in steps that are short beside the lag, each a piece of constant acceleration.
        step_s = max(self.lag_s / 5, 0.004)
        lag_s = max(self.lag_s, step_s / 2)  # below it the steps would oscillate
        rows: list[tuple[float, float, float, float]] = []
        columns = path.start_s, path.position_deg, path.velocity_dps, path.acceleration_dps2
        pieces = list(zip(*(column.tolist() for column in columns), strict=True))
        x, v = angle_deg, speed_dps
        for (t, p, p_dps, p_dps2), end_s in zip(pieces, [*(piece[0] for piece in pieces[1:]), inf], strict=True):
            begun = t
            while end_s - t > 1e-9:
                h = min(step_s, end_s - t)
                since = t + h - begun
                error = p + p_dps * since + 0.5 * p_dps2 * since * since + self.offset_deg - x - v * h / 2
                sign = copysign(1.0, v or error)
                # Friction holds a shaft at rest, and takes its part of the error from a moving one.
                if not v and abs(error) <= self.half_deg:
                    w = 0.0
                else:
                    w = self._speed(v, error - sign * self.half_deg, lag_s, h)
                    w = 0.0 if w * sign < 0 and self.half_deg else w
                # Below the least of these, rounding keeps a shaft from ever being close enough.
                close_dps = min(_STEADY_DPS, max(abs(p_dps) / 10, 1e-9)) if p_dps else _STEADY_DPS
                # A shaft that follows steadily does so until the path's next piece: one step for all that time.
                steady = not p_dps2 and max(abs(w - p_dps), abs(v - p_dps)) < close_dps
                if steady and (p_dps or abs(error) - self.half_deg < _STEADY_DPS * lag_s + abs(v) * h):
                    h, v, w = end_s - t, p_dps, p_dps
                rows.append((t, x, v, (w - v) / h))
                t, x, v = t + h, x + (v + w) / 2 * h if h < inf else x, w
        return PiecewiseMotion(*(np.ascontiguousarray(c) for c in np.array(rows, dtype=np.float64).T))

    def _speed(self, speed_dps: float, error_deg: float, lag_s: float, step_s: float) -> float:
        """Return the speed after a step, by the trapezoidal rule; ``error_deg`` lacks the second half of the step."""
        inertia = self.inertia_s / step_s
        speed = (inertia * speed_dps + error_deg / lag_s) / (inertia + 1 + step_s / 2 / lag_s)
        asked = (error_deg - speed * step_s / 2) / lag_s
        if abs(asked) > self.fastest_dps:
            speed = (inertia * speed_dps + copysign(self.fastest_dps, asked)) / (inertia + 1)
        return speed


_STEADY_DPS = 0.02
"""Difference of speed at which a shaft counts as following steadily."""


_RIPPLE_DEG = 15.0  # chosen, not measured: 24 waves in each revolution
_RIPPLE_FADES_DPS = 10.0


def ripple_deg(share: float, angle_deg: ArrayLike, speed_dps: ArrayLike) -> Floats | np.float64:
    """Return the deviations of a shaft's angles by the ripple of its speed, ``share`` of the speed.

    It is a fixed wave over the shaft's angle, with a period of `_RIPPLE_DEG`. Its amplitude falls to 0 with the speed.
    """
    if not share:
        return np.float64(0.0)
    fade = np.minimum(np.abs(speed_dps) / _RIPPLE_FADES_DPS, 1.0)
    wave = np.sin(np.asarray(angle_deg) * (2 * np.pi / _RIPPLE_DEG))
    return np.multiply(share * _RIPPLE_DEG / (2 * np.pi) * fade, wave)


class Platter:
    """The platter on the shaft: backlash, a damped structural vibration, and the ripple of the shaft's speed.

    The backlash operator keeps the platter within ±backlash/2 of the shaft; otherwise friction holds the platter. The
    vibration is x'' + 2ζω x' + ω² x = −a(t), solved exactly for each piece of constant shaft acceleration a.
    """

    def __init__(self, play_deg: float, structure_hz: float, damping: float, ripple: float = 0.0) -> None:
        self._half_play = play_deg / 2
        self._omega = 2 * np.pi * structure_hz
        self._zeta = damping
        self._ripple = ripple
        self.shaft = rest(0.0, 0.0)
        self._platter = np.zeros(1)
        self._shake = np.zeros((1, 2))  # deflection and its rate at each knot

    def follow(self, path: PiecewiseMotion, previous: "Platter | None") -> None:
        """Use ``path`` as the shaft's motion; at its start the platter is where ``previous`` leaves it."""
        if previous is None:
            platter, shake = float(path.position_deg[0]), (0.0, 0.0)
        else:
            piece, since_s = previous.shaft.pieces(path.start_s[:1])
            platter = float(previous._rigid(piece, previous.shaft.within(piece, since_s)[0])[0])
            deflection, rate = previous._vibration(piece, since_s)
            shake = float(deflection[0]), float(rate[0])
        self.shaft = path
        self._platter = np.empty(len(path.start_s))
        self._shake = np.empty((len(path.start_s), 2))
        for k, x in enumerate(path.position_deg):
            platter = min(max(platter, x - self._half_play), x + self._half_play)
            self._platter[k] = platter
            if k:
                shake = self._swing(shake, float(path.acceleration_dps2[k - 1]), path.start_s[k] - path.start_s[k - 1])
            self._shake[k] = shake

    def at(self, time_s: ArrayLike) -> Floats:
        """Return the platter's angle (°) at times within this path."""
        piece, since_s = self.shaft.pieces(np.asarray(time_s, dtype=np.float64))
        shaft_deg, speed_dps = self.shaft.within(piece, since_s)
        angle = self._rigid(piece, shaft_deg) + self._vibration(piece, since_s)[0]
        return angle + ripple_deg(self._ripple, shaft_deg, speed_dps)

    def _rigid(self, piece: NDArray[np.intp], shaft_deg: Floats) -> Floats:
        """Return the angle of a platter that does not vibrate."""
        held = self._platter[piece]
        return np.minimum(np.maximum(held, shaft_deg - self._half_play), shaft_deg + self._half_play)

    def _vibration(self, piece: NDArray[np.intp], since_s: Floats) -> tuple[Floats, Floats]:
        """Return deflection and its rate."""
        if self._omega == 0:
            return np.zeros_like(since_s), np.zeros_like(since_s)
        shake = self._shake[piece]
        return self._response(shake[..., 0], shake[..., 1], self.shaft.acceleration_dps2[piece], since_s)

    def _swing(self, state: tuple[float, float], acceleration: float, tau: float) -> tuple[float, float]:
        if self._omega == 0:
            return 0.0, 0.0
        x, v = self._response(*(np.float64(s) for s in (*state, acceleration, tau)))
        return float(x), float(v)

    def _response(
        self, x0: Floats | np.float64, v0: Floats | np.float64, a: Floats | np.float64, tau: Floats | np.float64
    ) -> tuple[Floats, Floats]:
        w, z = self._omega, self._zeta
        wd = w * sqrt(1 - z * z)
        offset = -a / (w * w)
        c = x0 - offset
        d = (v0 + z * w * c) / wd
        decay, cos, sin = np.exp(-z * w * tau), np.cos(wd * tau), np.sin(wd * tau)
        x = offset + decay * (c * cos + d * sin)
        v = decay * ((d * wd - z * w * c) * cos - (c * wd + z * w * d) * sin)
        return np.asarray(x), np.asarray(v)
