"""Converts the head's clock to the bench's clock: offset and drift from round trips, with their uncertainty.

A heartbeat leaves the computer at t0 and is received by the head at u1. The reply leaves the head at u2 and arrives at
t3. Both frames have the same length. If the delays are equal in both directions, the head's time u = (u1 + u2)/2 is the
bench's time t = (t0 + t3)/2. The error is at most half of the time by which the round trip d = (t3 − t0) − (u2 − u1)
exceeds the transmission time of the bytes. Delayed heartbeats have less weight. The drift of a ceramic resonator is up
to 0.5 %.

Decision: docs/decisions/0022.
"""

from collections import deque
from dataclasses import dataclass
from math import hypot, sqrt

import numpy as np
from numpy.typing import NDArray

DRIFT_SIGMA = 3e-3
"""Standard uncertainty of the drift before it is measured."""
STEP_SIGMA_NS = 4_000.0
"""Uncertainty of one heartbeat without delay: the head's clock has steps of 1 µs, on some boards 4 µs."""
MEMORY = 48
"""Heartbeats that the estimate uses: a few seconds, in which the temperature of a resonator is constant."""
BAUD_TOLERANCE = 0.95
"""The baud rates at the two ends of a working connection differ by up to 5 %."""
_WRAP = 1 << 32


@dataclass(frozen=True, slots=True)
class RoundTrip:
    """One round trip: its middle on both clocks, and its transmission time."""

    head_us: float
    host_ns: float
    delay_ns: float


class HeadClock:
    """Converts times of the head (µs, wrapping at 2³²) to times of the bench (ns).

    Parameters
    ----------
    transmission_ns
        Time that the two frames take at the baud rate; equal in both directions, so it adds no uncertainty.
    """

    def __init__(self, transmission_ns: float) -> None:
        self._transmission_ns = transmission_ns
        self.restart()

    def restart(self) -> None:
        """Drop all round trips: the head's clock started again."""
        self._round_trips: deque[RoundTrip] = deque(maxlen=MEMORY)
        self._newest_us: int | None = None
        self._origin_us = self._origin_ns = 0.0
        self._fit = np.zeros(2)
        self._covariance = np.diag([np.inf, DRIFT_SIGMA**2])
        self._asymmetry_ns = 0.0

    @property
    def known(self) -> bool:
        return bool(self._round_trips)

    @property
    def drift_ppm(self) -> float:
        """Relative error of the head's clock rate in parts per million; positive if it is too fast."""
        return float(1 / (1 + self._fit[1]) - 1) * 1e6

    @property
    def uncertainty_ns(self) -> float:
        """Standard uncertainty of a time at the newest heartbeat."""
        return self._sigma_ns(0.0)

    def unwrap(self, head_us: int) -> int:
        """Return a time of the head without wrapping, counted from the newest known time."""
        if self._newest_us is None:
            self._newest_us = head_us
            return head_us
        ahead = (head_us - self._newest_us + _WRAP // 2) % _WRAP - _WRAP // 2
        time_us = self._newest_us + ahead
        self._newest_us = max(self._newest_us, time_us)
        return time_us

    def add(self, sent_ns: int, received_us: int, answered_us: int, heard_ns: int) -> None:
        """Add one round trip; the head's times are unwrapped."""
        delay_ns = (heard_ns - sent_ns) - (answered_us - received_us) * 1000.0
        self._round_trips.append(
            RoundTrip((received_us + answered_us) / 2, (sent_ns + heard_ns) / 2, max(delay_ns, 0.0))
        )
        round_trips = self._round_trips
        self._origin_us, self._origin_ns = round_trips[-1].head_us, round_trips[-1].host_ns
        x = np.array([b.head_us - self._origin_us for b in round_trips]) * 1e3
        y = np.array([b.host_ns - self._origin_ns for b in round_trips]) - x
        delays = np.array([b.delay_ns for b in round_trips])
        # A connection that is faster than its baud rate does not transmit byte by byte (a pseudo-terminal): then the
        # transmission time in the shortest round trip is not known.
        shortest = float(delays.min())
        transmission_ns = self._transmission_ns if shortest >= BAUD_TOLERANCE * self._transmission_ns else 0.0
        delay_ns_beyond = np.maximum(delays - transmission_ns, 0.0)
        # The whole delay may be in one direction: the error is uniform within ± half of the delay.
        weight = 1 / (STEP_SIGMA_NS**2 + delay_ns_beyond**2 / 12)
        information = np.array([[weight.sum(), weight @ x], [weight @ x, weight @ x**2 + DRIFT_SIGMA**-2]])
        self._covariance = np.linalg.inv(information)
        self._fit = self._covariance @ np.array([weight @ y, weight @ (x * y)])
        self._asymmetry_ns = float(delay_ns_beyond.min()) / 2  # the delay of the best round trip may be in all of them

    def to_host(self, head_us: NDArray[np.int64]) -> tuple[NDArray[np.int64], float]:
        """Return the bench's times (ns) of unwrapped times of the head, and their largest standard uncertainty."""
        ahead_ns = (head_us - self._origin_us) * 1e3
        offset, drift = self._fit
        time_ns = round(self._origin_ns) + np.rint(ahead_ns * (1 + drift) + offset).astype(np.int64)
        return time_ns, self._sigma_ns(float(np.abs(ahead_ns).max(initial=0.0)))

    def _sigma_ns(self, ahead_ns: float) -> float:
        a = np.array([1.0, ahead_ns])
        return hypot(sqrt(float(a @ self._covariance @ a)), self._asymmetry_ns / sqrt(3))
