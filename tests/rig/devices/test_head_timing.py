"""The head's clock converted to the bench's: the error is within the uncertainty for all delays of the connection."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.devices.head.samples import HeadClock
from tests.fuzzing import examples

LINE_NS = 1_600_000


class Line:
    """A head with a clock error, and a connection that delays frames."""

    def __init__(self, drift: float, start_us: int, seed: int = 0) -> None:
        self.drift, self.start_us = drift, start_us
        self.clock = HeadClock(LINE_NS)
        self._rng = np.random.default_rng(seed)

    def head_us(self, host_ns: float) -> int:
        return self.start_us + int(host_ns * (1 + self.drift) / 1000)

    def beat(self, at_ns: int, *, there_ns: float = 0, back_ns: float = 0) -> None:
        received_ns = at_ns + LINE_NS / 2 + there_ns
        answered_ns = received_ns + 30_000
        heard_ns = answered_ns + LINE_NS / 2 + back_ns
        unwrap = self.clock.unwrap
        received_us = unwrap(self.head_us(received_ns) % 2**32)
        answered_us = unwrap(self.head_us(answered_ns) % 2**32)
        self.clock.add(at_ns, received_us, answered_us, round(heard_ns))

    def held_up(self, typical_ns: float) -> float:
        return float(self._rng.exponential(typical_ns))

    def error_ns(self, at_ns: int) -> tuple[float, float]:
        """Return the error of a time, and the stated uncertainty."""
        time_ns = self.clock.to_host(np.array([self.clock.unwrap(self.head_us(at_ns) % 2**32)]))
        return float(time_ns[0]) - at_ns, self.clock.uncertainty_ns


@given(drift=st.floats(-5e-3, 5e-3), start_us=st.integers(0, 2**32 - 1))
def test_symmetric_delays_give_microsecond_times(drift, start_us):
    line = Line(drift, start_us)
    for k in range(8):
        line.beat(2_000_000 * k)
    for k in range(1, 60):
        line.beat(16_000_000 + 62_500_000 * k)
    error_ns, sigma_ns = line.error_ns(16_000_000 + 62_500_000 * 60)
    assert abs(error_ns) < 10_000
    assert sigma_ns < 20_000
    assert line.clock.drift_ppm == pytest.approx(drift * 1e6, abs=20)


@examples(7)
@given(drift=st.floats(-5e-3, 5e-3), seed=st.integers(0, 10_000), typical_us=st.floats(10, 1500))
def test_error_with_asymmetric_delays_is_within_the_uncertainty(drift, seed, typical_us):
    line = Line(drift, 0, seed)
    for k in range(100):
        hold = line.held_up
        line.beat(62_500_000 * k, there_ns=hold(typical_us * 1e3), back_ns=hold(typical_us * 1e3))
    error_ns, sigma_ns = line.error_ns(62_500_000 * 100)
    assert abs(error_ns) < 5 * sigma_ns


def test_faster_than_baud_rate_gives_half_the_round_trip_as_uncertainty():
    clock = HeadClock(LINE_NS)
    for k in range(20):
        at_ns = 62_500_000 * k
        clock.add(at_ns, (at_ns + 200_000) // 1000, (at_ns + 200_000) // 1000, at_ns + 400_000)  # a pseudo-terminal
    assert clock.uncertainty_ns > 100_000


def test_times_continue_after_the_clock_wraps():
    line = Line(1e-3, 2**32 - 1_000_000)
    for k in range(100):
        line.beat(62_500_000 * k)
    error_ns, _ = line.error_ns(62_500_000 * 100)
    assert abs(error_ns) < 10_000


def test_earlier_time_is_not_a_wrap():
    clock = HeadClock(LINE_NS)
    assert clock.unwrap(1000) == 1000
    assert clock.unwrap(5000) == 5000
    assert clock.unwrap(4000) == 4000
    assert clock.unwrap(2**32 - 1) == -1
