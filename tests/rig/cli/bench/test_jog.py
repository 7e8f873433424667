"""`rig jog`: keys rotate the table in steps, and the torque is off at the end."""

import os
import pty
from collections.abc import Iterable
from contextlib import nullcontext

import pytest

from rig.cli.ui.desk import CommandDesk
from rig.cli.ui.settings import Settings
from rig.core.errors import FaultLatched, MotionStopped, Stalled, UsageError
from rig.events.events import Moved
from rig.jobs.desk import Remark, Steps
from rig.jobs.table import JogKey
from rig.jobs.table import jog as job
from tests.programs import Program

FORWARD, BACK, LARGER, SMALLER = JogKey.FORWARD, JogKey.BACK, JogKey.LARGER_STEP, JogKey.SMALLER_STEP


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


@pytest.mark.parametrize("step_deg", [0.0, -1.0, 361.0, float("nan")])
def test_impossible_step_is_rejected(jog, simulated, step_deg):
    with pytest.raises(UsageError):
        next(jog(simulated().bench, [FORWARD], step_deg=step_deg))


@pytest.mark.realtime
def test_arrow_keys_of_a_terminal_rotate_the_table(rig, tmp_path):
    assert rig("jog").exit_code == 2  # no terminal
    ours, theirs = pty.openpty()
    program = Program("jog", "--step", "2", folder=tmp_path, terminal=theirs)
    os.close(theirs)
    shown = b""
    for answer, key in ((b"q end", b"\x1b[C"), (b"2.0", b"\x1b[A"), (b"step 5", b"q"), (b"torque is off", b"")):
        while answer not in shown:
            shown += os.read(ours, 1024)
        shown = shown.partition(answer)[2]
        os.write(ours, key)
    assert program.wait(20) == 0
    os.close(ours)
