"""Programs that end while the table rotates: the table stops, and its torque is off."""

import signal

import pytest

from tests.kernel.guest_bench import GuestBench
from tests.kernel.machine import GuestProcess

pytestmark = [pytest.mark.kernel, pytest.mark.timeout(600)]

SLOW = ("--set", "table.velocity_dps=20")
STOPPED_S = 5.0


def rotating(bench: GuestBench, *settings: object) -> GuestProcess:
    """Start a long rotation, and return when the table rotates."""
    away = 0 if bench.played.table()[0] > 200 else 390
    goto = bench.start("goto", away, *SLOW, *settings)
    try:
        bench.until(lambda: abs(bench.played.table()[1]) > 5 or not goto.runs, "the table rotates", 120)
        assert goto.runs, "the program has ended"
    except AssertionError as late:
        raise AssertionError(f"{late}; the program has printed:\n{goto.output}") from None
    return goto


def stands_without_torque(bench: GuestBench) -> bool:
    with bench.played.time.present():
        servo = bench.played.devices.servo
        return bench.played.devices.world.shaft()[1] == 0 and not servo.memory["Torque Enable"]


@pytest.mark.parametrize(
    ("number", "codes"),
    [
        (signal.SIGKILL, {-signal.SIGKILL}),
        (signal.SIGTERM, {143, -signal.SIGTERM}),
        (signal.SIGINT, {130, -signal.SIGINT}),
    ],
    ids=["kill -9", "SIGTERM", "Ctrl+C"],
)
def test_table_stops_when_its_program_is_ended(bench: GuestBench, number: int, codes: set[int]) -> None:
    goto = rotating(bench)
    goto.signal(number)
    bench.until(lambda: stands_without_torque(bench), "the table stands, and its torque is off", STOPPED_S)
    assert goto.wait().code in codes


def test_stop_ends_the_program_that_rotates_the_table(bench: GuestBench) -> None:
    goto = rotating(bench)
    stop = bench.rig("stop")
    assert stop.code == 0, stop.output
    bench.until(lambda: stands_without_torque(bench), "the table stands, and its torque is off", STOPPED_S)
    ended = goto.wait()
    # A program that is too slow to notice the request gets SIGTERM.
    assert ended.code == 143 or (ended.code != 0 and "stopped" in ended.output), ended.output
