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
the same sum of all Δa, with exp(−s/τ) instead of E(s). Friction is not linear: it holds the shaft until its profile is
ahead by some angle. If the profile has to move by d for that, the shaft begins t₀ = √(2d/a) later, with the speed a·t₀.
Then 1·E(T) is replaced by (1 + λ·t₀)·E(T − t₀).

Singer and Seering, "Preshaping command inputs to reduce system vibration", 1990.
"""

from dataclasses import dataclass
from math import copysign, pi, sqrt
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
TAIL_SHARE: Final = 0.9
"""The same of a shaft that lags behind, whose speed decreases further while the table must be quiet."""
CRUISES, SLOWS, RAMPS = 12, 64, 4
"""Number of values of v, u and a that are compared."""
LEAST_RAMP: Final = 0.45
"""Smallest acceleration, as a share of the usual one."""


@dataclass(frozen=True, slots=True)
class ShapedMove:
    """A motion: its profile, that of its last part, when that is to begin, and how long the shaft moves.

    ``rings_s`` is how long the platter rings afterwards, by more than it may at rest.
    """

    cruise: MotionProfile
    slow: MotionProfile
    slow_s: float
    seconds: float
    rings_s: float


def shaped(
    distance_deg: float, usual: MotionProfile, units: MotionProfile, config: TableConfig, *, behind_deg: float = 0.0
) -> ShapedMove | None:
    """Return the motion over a distance that leads to rest first; None if the distance is too short for a profile.

    ``usual`` has the largest speed and acceleration, ``units`` the smallest steps of both. ``behind_deg`` is by
    how much the shaft is behind its profile before the motion, as an angle with the same sign as the distance.
    """
    distance, ringing_hz, damping = abs(distance_deg), config.ringing_hz, config.ringing_damping
    stays_deg = max(config.held_deg - copysign(1.0, distance_deg) * behind_deg, 0.0)
    ramp = _multiples(LEAST_RAMP * usual.acceleration_dps2, usual.acceleration_dps2, units.acceleration_dps2, RAMPS)
    fastest = min(usual.velocity_dps, sqrt(distance * usual.acceleration_dps2))
    a = ramp[:, None, None]
    v = _multiples(fastest / 2, fastest, units.velocity_dps, CRUISES)[None, :, None]
    u = _multiples(0.0, fastest, units.velocity_dps, SLOWS)[None, None, :]
    if not v.size or not u.size:
        return None
    first, last = (v - u) / a, u / a
    late_s = np.sqrt(2 * stays_deg / a)

    def pole(hz: float) -> complex:
        return 2 * pi * hz * complex(-damping, sqrt(1 - damping**2))

    def response(hz: float, seconds: Floats) -> NDArray[np.complex128]:
        return np.asarray(np.exp(pole(hz) * seconds))

    def motion_s(p: Floats) -> Floats:
        return distance / v + v / a + p * (1 - u / v)

    def left(hz: float, p: Floats) -> NDArray[np.complex128]:
        """Return S without its middle term."""
        start = (1 + pole(hz) * late_s) * response(hz, -late_s) - response(hz, -v / a)
        return response(hz, motion_s(p)) * start + 1 - response(hz, last)

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
    dying_s = np.log(np.maximum(rate / (QUIET_SHARE * config.quiet_dps), 1.0)) / (2 * pi * ringing_hz * damping)
    lag_s = max(config.lag_s, 1e-4)  # a shaft without a lag has no speed that is left
    slowed = np.exp(-(p + last) / lag_s) * (1 - np.exp(-np.maximum(first, 0) / lag_s))
    speed_dps = a * lag_s * (1 - np.exp(-last / lag_s) + slowed)
    tail_s = lag_s * np.log(np.maximum(speed_dps / (TAIL_SHARE * config.quiet_dps), 1.0))
    cruise_s = (distance - v * v / a - u * p) / v
    possible = (cruise_s >= 0) & (first >= 0) & (v >= a * late_s)
    rest_s = np.where(possible, motion_s(p) + tail_s + 2 * dying_s, np.inf)
    best = np.unravel_index(int(np.argmin(rest_s)), rest_s.shape)
    if not np.isfinite(rest_s[best]):
        return None
    acceleration, cruise, slow = float(ramp[best[0]]), float(v[0, best[1], 0]), float(u[0, 0, best[2]])
    return ShapedMove(
        MotionProfile(cruise, acceleration),
        MotionProfile(slow, acceleration),
        cruise / acceleration + float(cruise_s[best]),
        float((motion_s(p) + tail_s)[best]),
        float(dying_s[best]),
    )


def _multiples(low: float, high: float, unit: float, count: int) -> Floats:
    """Return up to ``count`` multiples of a unit between two values, without 0."""
    most = int(high / unit + 1e-6)
    return np.unique(np.linspace(max(low / unit, 1), max(most, 1), count).round())[: max(most, 0)] * unit
