"""The simulated computer of a simulated bench."""

from pathlib import Path

from rig.core.clock import SystemClock
from tests.programs import Program

KILLED = """
import os, signal
from rig.config import RigConfig
from sim.computer import simulated_computer
from sim.devices import SimDevices
from sim.world import World

config = RigConfig()
with SimDevices.connected(config, World()) as devices, simulated_computer(config, devices) as computer:
    print(len(list(computer.root.iterdir())), flush=True)
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_killed_program_leaves_no_file_of_its_simulated_computer(tmp_path: Path) -> None:
    program = Program(code=KILLED, TMPDIR=str(tmp_path))
    output, errors = program.communicate(timeout=60)
    assert int(output) > 2, errors
    clock = SystemClock()
    deadline_ns = clock.now_ns() + 30_000_000_000
    while list(tmp_path.iterdir()):  # another process removes them
        assert clock.now_ns() < deadline_ns
        clock.sleep(0.01)
