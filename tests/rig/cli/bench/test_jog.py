"""`rig jog`: keys rotate the table in steps, and the torque is off after every kind of end."""

import os
import signal
from collections.abc import Iterable
from contextlib import nullcontext
from pathlib import Path

import pytest

from rig.cli.ui.desk import CommandDesk
from rig.cli.ui.settings import Settings
from rig.core.errors import FaultLatched, MotionStopped, Stalled, UsageError
from rig.events.events import Moved
from rig.jobs.desk import Remark, Steps
from rig.jobs.table import JogKey
from rig.jobs.table import jog as job
from sim.realtime.wire import send_command
from tests.programs import Program, until

FORWARD, BACK, LARGER, SMALLER = JogKey.FORWARD, JogKey.BACK, JogKey.LARGER_STEP, JogKey.SMALLER_STEP

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


@pytest.fixture
def jog(rig, monkeypatch):
    """Return a function that begins the job on a bench that is open."""

    def begin(bench, keys: Iterable[JogKey | None], step_deg: float = 5.0) -> Steps[None]:
        desk = CommandDesk(Settings())
        monkeypatch.setattr(desk, "open_bench", lambda _: nullcontext(bench))
        return job(desk, keys, step_deg=step_deg)

    return begin


def torque(s) -> int:
    return s.operator.devices.servo.memory["Torque Enable"]


def test_keys_rotate_by_steps_within_the_limits(jog, simulated):
    s = simulated("table.limits_deg=[-200, 200]")
    keys = [FORWARD, None, SMALLER, BACK, LARGER, LARGER, LARGER, LARGER, FORWARD, FORWARD, FORWARD, JogKey.HOME]
    events = list(jog(s.bench, keys))
    steps = [event.text for event in events if isinstance(event, Remark)]
    assert steps == ["step 1°", "step 5°", "step 15°", "step 45°", "step 90°"]
    angles = [event.commanded_deg for event in events if isinstance(event, Moved)]
    assert angles == pytest.approx([5.0, 4.0, 94.0, 184.0, 200.0, 0.0], abs=0.1)
    assert torque(s) == 0


def test_torque_is_off_after_the_end_key_a_fault_and_a_stop(jog, simulated):
    s = simulated()
    events = jog(s.bench, [FORWARD, JogKey.END, FORWARD])
    next(events)
    assert torque(s) == 1
    assert list(events) == []
    assert torque(s) == 0
    s.bench.state.request_stop()
    with pytest.raises(MotionStopped):
        list(jog(s.bench, [None]))
    assert torque(s) == 0
    s.bench.state.clear_stop()
    with pytest.raises(Stalled):
        for _ in jog(s.bench, [FORWARD, FORWARD], step_deg=90):
            s.operator.devices.servo.jam()
    assert torque(s) == 0
    with pytest.raises(FaultLatched):
        list(jog(s.bench, [FORWARD]))


def test_impossible_step_is_rejected(jog):
    for step_deg in (0.0, -1.0, 361.0, float("nan")):
        with pytest.raises(UsageError):
            next(jog(None, [FORWARD], step_deg=step_deg))


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


@pytest.mark.realtime
def test_arrow_keys_of_a_terminal_rotate_the_table(rig, tmp_path):
    assert rig("jog").exit_code == 2  # no terminal
    terminal = Terminal(tmp_path, "--step", "2")
    for answer, key in ((b"q end", RIGHT), (b"2.0", b"\x1b[A"), (b"step 5", b"q")):
        terminal.wait_for(answer)
        terminal.press(key)
    terminal.wait_for(b"torque is off")
    assert terminal.program.wait(20) == 0
    terminal.hang_up()


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
