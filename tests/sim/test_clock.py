"""The virtual clock: time advances only during sleeps, and timers fire at their time and in their order."""

from hypothesis import given
from hypothesis import strategies as st

from sim.clock import VirtualClock
from tests.fuzzing import examples

quick = examples(10)
times = st.lists(st.integers(0, 1_000), max_size=30)


@quick
@given(at=times, until=st.integers(0, 1_200))
def test_timers_fire_at_their_time_in_the_order_of_scheduling(at: list[int], until: int) -> None:
    clock = VirtualClock()
    fired: list[tuple[int, int]] = []
    for k, t in enumerate(at):
        clock.call_at(t, lambda k=k: fired.append((clock.now_ns(), k)))
    clock.advance_to(until)
    assert fired == sorted((t, k) for k, t in enumerate(at) if t <= until)
    assert clock.now_ns() == until
    assert clock.next_event_ns() == min((t for t in at if t > until), default=None)


@quick
@given(at=times, cancelled=st.sets(st.integers(0, 29)))
def test_cancelled_timer_does_not_fire(at: list[int], cancelled: set[int]) -> None:
    clock = VirtualClock()
    fired: list[int] = []
    timers = [clock.call_at(t, lambda k=k: fired.append(k)) for k, t in enumerate(at)]
    for k in cancelled & set(range(len(at))):
        timers[k].cancel()
    clock.advance_to(1_000)
    assert sorted(fired) == [k for k in range(len(at)) if k not in cancelled]


def test_timer_can_schedule_timers_for_the_same_sleep() -> None:
    clock = VirtualClock()
    fired: list[int] = []

    def again() -> None:
        fired.append(clock.now_ns())
        if len(fired) < 4:
            clock.call_at(clock.now_ns() + 10, again)

    clock.call_at(10, again)
    clock.advance_to(35)
    assert fired == [10, 20, 30]
    assert clock.next_event_ns() == 40


@quick
@given(st.floats(-5.0, 5.0))
def test_sleep_advances_time_by_positive_durations_only(seconds: float) -> None:
    clock = VirtualClock()
    clock.sleep(seconds)
    assert clock.now_ns() == max(round(seconds * 1e9), 0)
