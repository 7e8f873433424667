"""Signals at every line of a motion and of its clean-up: the torque is off afterwards."""

import random
import signal
import sys
from pathlib import Path

import pytest

import rig
from rig.core import signals
from rig.core.signals import handle_signals
from rig.motion.turntable import Turntable
from tests.rig.bench_parts import motion_bench

ROOTS = tuple(str(Path(rig.__file__).parent / room) for room in ("motion", "safety", "devices", "bench"))


def bursts_at(first_line: int, following: list[int]):
    """Return a trace function that raises SIGINT and SIGTERM at these numbers of executed lines."""
    count, due = 0, {first_line, *(first_line + after for after in following)}

    def line(_frame, event, _argument):
        nonlocal count
        if event == "line":
            count += 1
            if count in due:
                signal.raise_signal(signal.SIGINT)
                signal.raise_signal(signal.SIGTERM)
        return line

    def call(frame, _event, _argument):
        return line if frame.f_code.co_filename.startswith(ROOTS) else None

    return call


@pytest.mark.parametrize("seed", [*range(6), *(pytest.param(n, marks=pytest.mark.nightly) for n in range(6, 200))])
def test_torque_is_off_after_signals_at_any_line(seed):
    rng = random.Random(seed)
    before = {number: signal.getsignal(number) for number in signals.ENDING}
    # from torque on, through the motion, to its normal end
    first = rng.randrange(300, 10_500)
    following = sorted(rng.sample(range(1, 400), 5))
    with motion_bench() as (bench, wires):
        handle_signals()
        trace = sys.gettrace()
        sys.settrace(bursts_at(first, following))
        try:
            with bench_closed(bench), Turntable(bench, trust_gyro=False) as table:
                table.goto(20.0)
        except (KeyboardInterrupt, SystemExit):
            pass
        finally:
            sys.settrace(trace)
            for number, handler in before.items():
                signal.signal(number, handler)
            signals._state.raised_ns = None
        assert wires.device.memory["Torque Enable"] == 0


class bench_closed:  # noqa: N801 - a with block
    """Closes the bench at the end, which switches the torque off, too."""

    def __init__(self, bench) -> None:
        self._bench = bench

    def __enter__(self) -> None:
        pass

    def __exit__(self, *_: object) -> None:
        self._bench.servo.torque_off()
