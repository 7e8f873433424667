"""`rig jog` in a terminal of its own: the torque is off after every kind of end."""

import os
import signal
from pathlib import Path

import pytest

from sim.realtime.wire import send_command
from tests.programs import Program, until

OF_ITS_TERMINAL = """
import fcntl, os, termios
os.setsid()
fcntl.ioctl(0, termios.TIOCSCTTY, 0)
from rig.cli.main import main
main()
"""
"""A terminal sends its signals to the programs that it controls."""
PATIENT = ("--set", "table.velocity_dps=20", "--set", "servo.retries=10", "--set", "table.watchdog_s=2.4")
"""The simulated bench answers late on a busy computer."""
RIGHT, CTRL_C = b"\x1b[C", b"\x03"


class Terminal:
    """A terminal with a running `rig jog`: what it shows, and keys."""

    def __init__(self, folder: Path, *words: str) -> None:
        self._ours, theirs = os.openpty()
        self.program = Program("jog", *words, code=OF_ITS_TERMINAL, folder=folder, terminal=theirs)
        os.close(theirs)

    def wait_for(self, text: bytes) -> bytes:
        shown = b""
        while text not in shown:
            shown += os.read(self._ours, 1024)
        return shown

    def press(self, key: bytes) -> None:
        os.write(self._ours, key)

    def hang_up(self) -> None:
        """Close the terminal's window."""
        os.close(self._ours)


def test_jog_ends_when_its_terminal_hangs_up(tmp_path: Path) -> None:
    terminal = Terminal(tmp_path, "--step", "2", "--bench", "sim")
    terminal.wait_for(b"q end")
    terminal.press(RIGHT)
    terminal.wait_for(b"asked 2.0")
    terminal.hang_up()
    assert terminal.program.wait(20) == 128 + signal.SIGHUP


@pytest.mark.nightly
def test_torque_is_off_however_jog_ends_in_motion(running_sim_bench: Path) -> None:
    config = ("--config", str(running_sim_bench / "rig.toml"))

    def world() -> dict[str, float]:
        known: dict[str, float] = send_command(running_sim_bench, "status")["world"]
        return known

    Program("home", "--here", *config).communicate(30)
    for how, code in (("Ctrl+C", 130), ("hang-up", 128 + signal.SIGHUP), ("kill -9", -signal.SIGKILL), ("q", 0)):
        begun_deg = world()["table_deg"]
        terminal = Terminal(running_sim_bench, "--step", "90", *PATIENT, *config)
        terminal.wait_for(b"q end")
        terminal.press(RIGHT)
        # Each answer takes time of the simulated bench.
        until(lambda begun_deg=begun_deg: world()["torque"] and abs(world()["table_deg"] - begun_deg) > 10, every_s=0.5)
        if how == "Ctrl+C":
            terminal.press(CTRL_C)
        elif how == "hang-up":
            terminal.hang_up()
        elif how == "kill -9":
            terminal.program.kill()
        else:
            terminal.wait_for(b"table at")
            terminal.press(b"q")
        assert terminal.program.wait(30) == code, how
        until(lambda: not world()["torque"], every_s=0.5)
        rotated_deg = abs(world()["table_deg"] - begun_deg)
        assert rotated_deg > 89 if how == "q" else rotated_deg < 80, how
        if how != "hang-up":
            terminal.hang_up()
        Program("home", "--here", *config).communicate(30)
