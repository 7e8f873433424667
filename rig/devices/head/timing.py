"""The head's clock on the bench's clock: offset and drift from round trips, with an honest uncertainty.

A beat leaves the host at t0, is received by the head at u1, its answer leaves the head at u2 and is here at t3. Both
frames are equally long, so that on an even line the head's u = (u1 + u2)/2 is the bench's t = (t0 + t3)/2, off by at
most half of what the round trip d = (t3 − t0) − (u2 − u1) took beyond the time of the bytes on the line. Beats that
were held up count less. The drift of a ceramic resonator is up to 0.5 %.
"""

from collections import deque
from dataclasses import dataclass
from math import hypot, sqrt

import numpy as np
from numpy.typing import NDArray

DRIFT_SIGMA = 3e-3
"""What is known of the drift before it is measured."""
STEP_SIGMA_NS = 4_000.0
"""Of one beat that was not held up: the head's clock ticks in whole microseconds, in steps of 4 on some boards."""
MEMORY = 48
"""Beats that the estimate looks back on: a few seconds, in which a resonator does not warm up."""
LINE_TOLERANCE = 0.95
"""Baud rates differ by up to 5 % between the two ends of a line that works."""
_WRAP = 1 << 32


@dataclass(frozen=True, slots=True)
class RoundTrip:
    """One round trip: the middle of it on both clocks, and what the line took."""

    head_us: float
    host_ns: float
    delay_ns: float


class HeadClock:
    """Turns times of the head (µs, wrapping at 2³²) into the bench's (ns).

    Parameters
    ----------
    line_ns
        What the two frames take on the line at its baud rate; the same both ways, so it adds no uncertainty.
    """

    def __init__(self, line_ns: float) -> None:
        self._line_ns = line_ns
        self.restart()

    def restart(self) -> None:
        """Forget everything: the head's clock began anew."""
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
        """How much too fast the head's clock runs, in parts per million."""
        return float(1 / (1 + self._fit[1]) - 1) * 1e6

    @property
    def uncertainty_ns(self) -> float:
        """Standard uncertainty of a time at the newest beat."""
        return self._sigma_ns(0.0)

    def unwrap(self, head_us: int) -> int:
        """Return a time of the head without its wrap, counted on from the newest that was seen."""
        if self._newest_us is None:
            self._newest_us = head_us
            return head_us
        ahead = (head_us - self._newest_us + _WRAP // 2) % _WRAP - _WRAP // 2
        time_us = self._newest_us + ahead
        self._newest_us = max(self._newest_us, time_us)
        return time_us

    def add(self, sent_ns: int, received_us: int, answered_us: int, heard_ns: int) -> None:
        """Learn from one round trip; the head's times are unwrapped."""
        delay_ns = (heard_ns - sent_ns) - (answered_us - received_us) * 1000.0
        self._round_trips.append(
            RoundTrip((received_us + answered_us) / 2, (sent_ns + heard_ns) / 2, max(delay_ns, 0.0))
        )
        round_trips = self._round_trips
        self._origin_us, self._origin_ns = round_trips[-1].head_us, round_trips[-1].host_ns
        x = np.array([b.head_us - self._origin_us for b in round_trips]) * 1e3
        y = np.array([b.host_ns - self._origin_ns for b in round_trips]) - x
        delays = np.array([b.delay_ns for b in round_trips])
        # A line that is faster than its baud rate says is none that bytes pass one by one (a pseudo-terminal): then
        # nothing is known of how much of the shortest round trip was the line itself.
        shortest = float(delays.min())
        line_ns = self._line_ns if shortest >= LINE_TOLERANCE * self._line_ns else 0.0
        held_up = np.maximum(delays - line_ns, 0.0)
        # What a frame was held up may have been all on one way: an error spread evenly over ± half of it.
        weight = 1 / (STEP_SIGMA_NS**2 + held_up**2 / 12)
        information = np.array([[weight.sum(), weight @ x], [weight @ x, weight @ x**2 + DRIFT_SIGMA**-2]])
        self._covariance = np.linalg.inv(information)
        self._fit = self._covariance @ np.array([weight @ y, weight @ (x * y)])
        self._asymmetry_ns = float(held_up.min()) / 2  # and that of the best one may be the same in all of them

    def to_host(self, head_us: NDArray[np.int64]) -> tuple[NDArray[np.int64], float]:
        """Return the bench's times (ns) of unwrapped times of the head, and their largest standard uncertainty (ns)."""
        ahead_ns = (head_us - self._origin_us) * 1e3
        offset, drift = self._fit
        time_ns = round(self._origin_ns) + np.rint(ahead_ns * (1 + drift) + offset).astype(np.int64)
        return time_ns, self._sigma_ns(float(np.abs(ahead_ns).max(initial=0.0)))

    def _sigma_ns(self, ahead_ns: float) -> float:
        a = np.array([1.0, ahead_ns])
        return hypot(sqrt(float(a @ self._covariance @ a)), self._asymmetry_ns / sqrt(3))
