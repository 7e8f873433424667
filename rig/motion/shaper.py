"""Profiles that do not leave the platter ringing.

A platter of the natural frequency ω and the damping ratio ζ rings after each change of its acceleration. If the
acceleration changes by Δa at the time s before the end of a motion, the part Δa·E(s) of the ringing is left at the end,
with E(s) = exp(λs) and λ = −ζω + iω√(1 − ζ²). Its rate is |Σ Δa·E(s)| / (ω√(1 − ζ²)), and the motion does not ring if
the sum is 0.

A trapezoid alone cannot do that for each distance and damping. So the servo brakes twice: from its cruise speed v to a
lower speed u, and after the time p at u to rest. With its acceleration a, the sum is

    S = E(T)·(1 − E(−v/a)) + E(p + u/a)·(1 − E((v − u)/a)) + 1 − E(u/a)

where T is the duration of the whole motion. For each v, u and a that the servo can have, p follows from the phases; of
these motions, the one that leads to rest first is chosen. For the second braking the servo gets its goal again, with
the lower speed. If that is late, the table still stops at the goal, but rings.

The shaft follows this profile with the lag τ of its controller. That is linear: the ringing ends with the profile,
and its rate is smaller by |1 + λτ|. But the shaft still moves then, with a speed that falls by exp(−t/τ): it is τ times
the same sum of all Δa, with exp(−s/τ) instead of E(s).

Friction is not linear. After a motion in the other direction, it holds the shaft until its profile has moved by twice
the angle at which it held it. The shaft then breaks away with the speed w of its profile, a push that leaves the rate
w/|1 + λτ|. With full acceleration no other part of a motion of 3° can cancel it. So the profile creeps while the shaft
breaks away, and accelerates from w afterwards. In S, 1 − E(−v/a) becomes 1 − E((w − v)/a), and the push at the time t
before the acceleration adds λw/a·E(T + t).

Singer and Seering, "Preshaping command inputs to reduce system vibration", 1990.
"""

from dataclasses import dataclass
from math import ceil, copysign, pi, sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rig.config import TableConfig
from rig.devices.servo import MotionProfile

Floats = NDArray[np.float64]

SPREAD: Final = 0.005  # larger: tables with little damping move slowly; smaller: they ring if the object is heavier
"""Relative error of the frequency at which a motion must still end at rest."""
LATE_S: Final = 0.0005
"""How late the second braking may be given."""
OFF_DEG: Final = 0.01  # an eighth of the count of an encoder
"""By how much the distance may be longer, which changes the time at the lower speed."""
QUIET_SHARE: Final = 0.35  # the gyro's noise needs the rest
"""Share of `table.quiet_dps` that the ringing may have at the end."""
LASTING: Final = 0.2
LASTING_SHARE: Final = 0.25
"""The same of a ringing that falls by less than the first number while the table must be quiet: it meets more noise."""
TAIL_SHARE: Final = 0.9
"""The same of a shaft that lags behind, whose speed decreases further while the table must be quiet."""
CREEP_DPS: Final = 1.0  # larger: the platter gets a push at an uncertain time; smaller: a reversal takes longer
"""Least speed of the profile while the shaft breaks away."""
SLACK_DEG: Final = 0.1  # an encoder's count, and a tenth of a usual friction
"""How well the angle is known at which the shaft breaks away."""
CRUISES, SLOWS, RAMPS = 12, 64, 4
"""Number of values of v, u and a that are compared."""
LEAST_RAMP: Final = 0.45
"""Smallest acceleration, as a share of the usual one."""


@dataclass(frozen=True, slots=True)
class ShapedMove:
    """A motion: its profiles, each with the time at which it begins, and how long the shaft moves.

    ``rings_s`` is how long the platter rings afterwards, by more than it may at rest.
    """

    parts: tuple[tuple[float, MotionProfile], ...]
    seconds: float
    rings_s: float

    @property
    def cruise(self) -> MotionProfile:
        """The fastest of its profiles."""
        return max((profile for _, profile in self.parts), key=lambda profile: profile.velocity_dps)


@dataclass(frozen=True, slots=True)
class _Start:
    """The beginning of a motion, until the shaft has broken away from its friction: profiles, duration, angle, speed.

    The shaft breaks away ``pushed_s`` before its end.
    """

    parts: tuple[tuple[float, MotionProfile], ...] = ()
    seconds: float = 0.0
    moved_deg: float = 0.0
    dps: float = 0.0
    pushed_s: float = 0.0

    @classmethod
    def from_friction(cls, stays_deg: float, usual: MotionProfile, units: MotionProfile) -> "_Start":
        """Return the beginning for a shaft that stays until its profile has moved by ``stays_deg``."""
        unit_dps, a = units.velocity_dps, usual.acceleration_dps2
        creep_dps, quick_deg = ceil(CREEP_DPS / unit_dps) * unit_dps, stays_deg - SLACK_DEG
        if quick_deg <= 0:
            return cls()
        creeps_s = 2 * SLACK_DEG / creep_dps
        quick_dps = min(usual.velocity_dps, sqrt(quick_deg * a)) // unit_dps * unit_dps
        if quick_dps <= creep_dps:
            quick_dps, brakes_s, quick_s = creep_dps, 0.0, quick_deg / creep_dps + creep_dps / a / 2
        else:
            brakes_s = quick_deg / quick_dps + creep_dps**2 / (2 * a * quick_dps)
            quick_s = brakes_s + (quick_dps - creep_dps) / a
        parts = [(0.0, MotionProfile(quick_dps, a))]
        if brakes_s:
            parts.append((brakes_s, MotionProfile(creep_dps, a)))
        return cls(tuple(parts), quick_s + creeps_s, stays_deg + SLACK_DEG, creep_dps, creeps_s / 2)


def shaped(
    distance_deg: float, usual: MotionProfile, units: MotionProfile, config: TableConfig, *, behind_deg: float = 0.0
) -> ShapedMove | None:
    """Return the motion over a distance that leads to rest first; None if the distance is too short for a profile.

    ``usual`` has the largest speed and acceleration, ``units`` the smallest steps of both. ``behind_deg`` is by
    how much the shaft is behind its profile before the motion, as an angle with the same sign as the distance.
    """
    ringing_hz, damping = config.ringing_hz, config.ringing_damping
    stays_deg = config.held_deg - copysign(1.0, distance_deg) * behind_deg
    if abs(stays_deg - 2 * config.held_deg) < SLACK_DEG:  # the calibration knows it better than a reading does
        stays_deg = 2 * config.held_deg
    start = _Start.from_friction(stays_deg, usual, units)
    distance, w = abs(distance_deg) - start.moved_deg, start.dps
    if distance <= 0:
        return None
    ramp = _multiples(LEAST_RAMP * usual.acceleration_dps2, usual.acceleration_dps2, units.acceleration_dps2, RAMPS)
    fastest = min(usual.velocity_dps, sqrt(distance * usual.acceleration_dps2 + w * w / 2))
    a = ramp[:, None, None]
    v = _multiples(max(fastest / 2, w), fastest, units.velocity_dps, CRUISES)[None, :, None]
    u = _multiples(0.0, fastest, units.velocity_dps, SLOWS)[None, None, :]
    if not v.size or not u.size:
        return None
    first, last = (v - u) / a, u / a

    def pole(hz: float) -> complex:
        return 2 * pi * hz * complex(-damping, sqrt(1 - damping**2))

    def response(hz: float, seconds: Floats) -> NDArray[np.complex128]:
        return np.asarray(np.exp(pole(hz) * seconds))

    def cruise_s(p: Floats) -> Floats:
        return (distance - (v * v - w * w / 2) / a - u * p) / v

    def motion_s(p: Floats) -> Floats:
        return (2 * v - w) / a + cruise_s(p) + p

    def left(hz: float, p: Floats) -> NDArray[np.complex128]:
        """Return S without its middle term."""
        begun = 1 - response(hz, (w - v) / a) + pole(hz) * w / a * response(hz, np.array(start.pushed_s))
        return response(hz, motion_s(p)) * begun + 1 - response(hz, last)

    # The time p with which the middle term has the opposite phase; it changes the duration, so this is repeated.
    middle = response(ringing_hz, last) * (1 - response(ringing_hz, first))
    p = np.zeros(np.broadcast_shapes(a.shape, v.shape, u.shape))
    for _ in range(4):
        phase = np.angle(-left(ringing_hz, p) * middle.conj())
        p = np.where(first > 0, (phase % (2 * pi)) / (2 * pi * ringing_hz * sqrt(1 - damping**2)), 0.0)
    rate = np.zeros_like(p)
    errors = (ringing_hz * (1 - SPREAD), 0.0), (ringing_hz * (1 + SPREAD), 0.0), (ringing_hz, LATE_S + OFF_DEG / u)
    for hz, error_s in errors:
        total = left(hz, p) + response(hz, p + last - error_s) * (1 - response(hz, first))
        followed = abs(1 + pole(hz) * config.lag_s)  # the lag is a low-pass filter
        rate = np.maximum(rate, np.abs(total) * a / (2 * pi * hz * sqrt(1 - damping**2)) / followed)
    # Ringing that is left needs time to die down. That counts twice, because a motion is known better.
    falls = 2 * pi * ringing_hz * damping
    share = LASTING_SHARE if falls * config.quiet_s < LASTING else QUIET_SHARE
    dying_s = np.log(np.maximum(rate / (share * config.quiet_dps), 1.0)) / falls
    lag_s = max(config.lag_s, 1e-4)  # a shaft without a lag has no speed that is left
    slowed = np.exp(-(p + last) / lag_s) * (1 - np.exp(-np.maximum(first, 0) / lag_s))
    speed_dps = a * lag_s * (1 - np.exp(-last / lag_s) + slowed)
    tail_s = lag_s * np.log(np.maximum(speed_dps / (TAIL_SHARE * config.quiet_dps), 1.0))
    rest_s = np.where((cruise_s(p) >= 0) & (first >= 0), motion_s(p) + tail_s + 2 * dying_s, np.inf)
    best = np.unravel_index(int(np.argmin(rest_s)), rest_s.shape)
    if not np.isfinite(rest_s[best]):
        return None
    acceleration, cruise, slow = float(ramp[best[0]]), float(v[0, best[1], 0]), float(u[0, 0, best[2]])
    parts = [*start.parts, (start.seconds, MotionProfile(cruise, acceleration))]
    if slow != cruise:
        brakes_s = (cruise - w) / acceleration + float(cruise_s(p)[best])
        parts.append((start.seconds + brakes_s, MotionProfile(slow, acceleration)))
    return ShapedMove(tuple(parts), start.seconds + float((motion_s(p) + tail_s)[best]), float(dying_s[best]))


def _multiples(low: float, high: float, unit: float, count: int) -> Floats:
    """Return up to ``count`` multiples of a unit between two values, without 0."""
    most = int(high / unit + 1e-6)
    return np.unique(np.linspace(max(low / unit, 1), max(most, 1), count).round())[: max(most, 0)] * unit
