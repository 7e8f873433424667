"""Signals unwind the stack once, and wait for a clean-up that has begun."""

import signal
import subprocess
import sys

import pytest

from rig.core import signals
from rig.core.signals import ENDING, handle_signals, uninterrupted

PROGRAM = """
import os, sys
from rig.core.signals import handle_signals, uninterrupted
handle_signals()
try:
    print("moving", flush=True)
    sys.stdin.read()
finally:
    with uninterrupted():
        for _ in range(300):
            os.stat(".")
        print("torque off", flush=True)
"""


@pytest.fixture(autouse=True)
def handlers():
    """Restore the handlers of this process."""
    before = {number: signal.getsignal(number) for number in ENDING}
    signals._state.raised_ns = None
    yield
    for number, handler in before.items():
        signal.signal(number, handler)
    signals._state.raised_ns = None


@pytest.mark.parametrize("number", ENDING, ids=lambda number: number.name)
def test_each_signal_that_can_be_handled_unwinds_the_stack_once(number):
    signal.signal(number, signal.SIG_DFL)
    handle_signals()
    cleaned = []
    with pytest.raises(KeyboardInterrupt if number is signal.SIGINT else SystemExit) as caught:
        try:
            signal.raise_signal(number)
        finally:
            for again in ENDING:
                if signal.getsignal(again) is signals._end:
                    signal.raise_signal(again)
            cleaned.append(number)
    assert cleaned == [number]
    if number is not signal.SIGINT:
        assert caught.value.code == 128 + number


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGQUIT], ids=lambda number: number.name)
def test_stop_reaches_a_background_job_of_a_script(number):
    for ignored in (signal.SIGINT, signal.SIGQUIT, signal.SIGHUP):
        signal.signal(ignored, signal.SIG_IGN)
    handle_signals()
    signal.raise_signal(signal.SIGHUP)
    with pytest.raises(KeyboardInterrupt if number is signal.SIGINT else SystemExit):
        signal.raise_signal(number)


def test_signals_wait_for_the_end_of_a_cleanup():
    handle_signals()
    done = []
    with pytest.raises(KeyboardInterrupt), uninterrupted():
        with uninterrupted():
            for _ in range(5):
                signal.raise_signal(signal.SIGINT)
        done.append("torque off")
    assert done


def test_ctrl_c_waits_for_a_cleanup_in_a_program_without_handlers():
    signal.signal(signal.SIGINT, signal.default_int_handler)
    done = []
    with pytest.raises(KeyboardInterrupt), uninterrupted():
        signal.raise_signal(signal.SIGINT)
        done.append("torque off")
    assert done
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_cleanup_that_hangs_can_be_interrupted_after_two_seconds():
    handle_signals()
    with pytest.raises(KeyboardInterrupt), uninterrupted():
        signals._state.held_ns -= round(signals.HOLD_S * 1e9)
        signal.raise_signal(signal.SIGINT)
        pytest.fail("not interrupted")


@pytest.mark.parametrize("numbers", [[signal.SIGINT] * 10, [signal.SIGTERM] * 4, [signal.SIGQUIT, signal.SIGUSR1] * 3])
def test_burst_of_signals_does_not_stop_the_cleanup(numbers):
    process = subprocess.Popen(
        [sys.executable, "-c", PROGRAM], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    )
    assert process.stdout.readline() == b"moving\n"
    for number in numbers:
        process.send_signal(number)
    output, _ = process.communicate(timeout=60)
    assert output == b"torque off\n"
    assert process.returncode in {128 + number for number in numbers} | {-signal.SIGINT}


def test_signal_at_the_end_of_the_interpreter_keeps_the_exit_code():
    program = """
import os, signal
from rig.core.signals import handle_signals
class Late:  # cleared after the interpreter has restored the default handlers
    def __init__(self): self.kill, self.pid, self.number = os.kill, os.getpid(), signal.SIGUSR1
    def __del__(self): self.kill(self.pid, self.number)
late = Late()
handle_signals()
signal.raise_signal(signal.SIGTERM)
"""
    done = subprocess.run([sys.executable, "-c", program], timeout=60)
    assert done.returncode == 128 + signal.SIGTERM
