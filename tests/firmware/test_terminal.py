"""The head on a pseudo-terminal in real time, with pyserial, and a program that is killed."""

import os
import signal
import subprocess
import time
from collections.abc import Iterator
from dataclasses import dataclass, field

import pytest

from sim.head import build
from tests.programs import Program

HOST = """
import sys, serial
from rig.core.clock import SystemClock
from rig.config import ImuConfig
from rig.devices.head import link
from rig.devices.head.head import RigHead
from rig.devices.head.protocol import BAUD
from rig.devices.head.samples import head_sensor

link.REPLY_S = 2.0  # the head is a program that may have to wait for a processor
clock = SystemClock()
wire = serial.Serial(sys.argv[1], BAUD, timeout=0.002, exclusive=True)
sensor = head_sensor(ImuConfig())
head = RigHead(wire, clock, sensor, deadman_s=float(sys.argv[2]))
head.set_power(True)
head.set_light(0.5)
print("on", flush=True)
if sys.argv[3] == "stay":
    clock.sleep(60)
clock.sleep(0.5)
head.read_samples()
clock.sleep(1.0)
samples = head.read_samples()
print(len(samples.time_ns), samples.lost, round(samples.gyro_dps[:, 2].mean(), 2), flush=True)
head.close()
"""


@dataclass
class Terminal:
    """A running `head-pty`, and the changes of its outputs: seconds, pin, value."""

    program: subprocess.Popen
    port: str
    changes: list[tuple[float, str, int]] = field(default_factory=list)

    def say(self, order: str) -> None:
        self.program.stdin.write(f"{order}\n")
        self.program.stdin.flush()

    def wait_for(self, pin: str, value: int) -> float:
        """Return when (in its own seconds) the output took the value."""
        while True:
            line = self.program.stdout.readline()
            assert line, "head-pty has ended"
            at, name, level = line.split()
            self.changes.append((float(at), name, int(level)))
            if (name, int(level)) == (pin, value):
                return float(at)


@pytest.fixture
def terminal() -> Iterator[Terminal]:
    if lacking := build.missing():
        pytest.skip(lacking)
    program = subprocess.Popen(
        [str(build.pty_program())], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1
    )
    try:
        yield Terminal(program, program.stdout.readline().strip())
    finally:
        program.kill()
        program.communicate()


def host(port: str, deadman_s: float, how: str) -> Program:
    return Program(port, str(deadman_s), how, code=HOST)


@pytest.mark.realtime
def test_stream_runs_in_real_time(terminal):
    terminal.say("spin 20")
    program = host(terminal.port, 2.0, "leave")
    reported, _ = program.communicate(timeout=60)
    count, lost, rate_dps = reported.split()[1:]
    assert int(lost) == 0
    assert int(count) > 150  # a busy machine may be late with some; none is lost
    assert float(rate_dps) == pytest.approx(20.0, abs=0.02)
    terminal.wait_for("relay", 0)
    assert terminal.changes[-1][1:] == ("relay", 0)
    assert program.returncode == 0


@pytest.mark.parametrize("deadman_s", [0.25, 1.0])
def test_light_and_servo_power_are_off_after_a_killed_program(terminal, deadman_s):
    program = host(terminal.port, deadman_s, "stay")
    assert program.stdout.readline() == "on\n"
    terminal.wait_for("light", 128)
    killed = time.monotonic()  # noqa: TID251
    os.kill(program.pid, signal.SIGKILL)
    program.close()
    opened_s = terminal.wait_for("relay", 0)
    took_s = time.monotonic() - killed  # noqa: TID251
    dark_s = terminal.wait_for("light", 0)
    assert dark_s == opened_s
    assert took_s < deadman_s + 0.5  # the deadman, and a busy machine


def test_estop_works_in_real_time(terminal):
    program = host(terminal.port, 2.0, "stay")
    assert program.stdout.readline() == "on\n"
    terminal.wait_for("light", 128)
    terminal.say("estop open")
    assert terminal.wait_for("relay", 0) > 0
    program.close()
