"""`rig home`, `rig stop`, `rig acknowledge`, and the state after a killed program, in real processes."""

import json
import signal
from pathlib import Path

import pytest
from typer.testing import CliRunner

from rig.cli.main import app
from rig.config import RigConfig, load_config
from rig.core.clock import SystemClock
from rig.core.errors import Stalled
from rig.jobs.stop import stop
from rig.safety.saved_state import FileStore, LatchedFault
from tests.programs import Program
from tests.small import SMALL_WORDS

ARRIVED_DEG = RigConfig().table.tolerance_deg
"""Friction holds the table short of its goal by half a degree; the rotations of these tests differ by revolutions."""


@pytest.fixture
def running(rig):
    """Return a function that starts an enrollment of many views and returns it when the third is stored."""
    processes = []

    def start() -> Program:
        process = Program("enroll", "dice", "--views", "720", "--json", *SMALL_WORDS)
        processes.append(process)
        accepted = 0
        for line in process.stdout:
            accepted += json.loads(line)["event"] == "accepted"
            if accepted == 3:
                break
        return process

    yield start
    for process in processes:
        process.close()


def state() -> dict:
    return json.loads(Path("state/sim/state.json").read_text())


def test_angle_in_doubt_is_reported_and_resolved_by_the_operator(rig):
    rig("goto", "90")
    store = FileStore(Path("state/sim"))
    kept = store.load()
    moving = kept.table.model_copy(update={"path_deg": (200.0, 600.0)})  # killed in a motion, and without supply since
    store.save(kept.model_copy(update={"table": moving}))
    reported = json.loads(rig("status", "--json").stdout)
    assert reported["state"] == "unreferenced"
    assert reported["table_deg"] is None
    rejected = rig("goto", "0")
    assert rejected.exit_code == 5
    assert "rig home --revolutions 0" in rejected.stderr
    assert rig("home").exit_code == 5
    assert rig("home", "--revolutions", "0", "--here").exit_code == 2
    done = rig("home", "--revolutions", "0", "--json")
    assert json.loads(done.stdout)["rotation_encoder_deg"] == pytest.approx(-90, abs=ARRIVED_DEG)
    assert json.loads(rig("status", "--json").stdout)["state"] == "ready"


def test_home_shows_a_long_rotation_and_asks(rig):
    rig("goto", "10")
    asked = rig("home", "--revolutions", "1")  # standard input has ended: no answer
    assert asked.exit_code == 2
    assert "rotates by −370° to home" in asked.stderr
    assert "--yes" in asked.stderr
    assert json.loads(rig("status", "--json").stdout)["table_deg"] == pytest.approx(10, abs=ARRIVED_DEG)
    for rotations in ("3", "249", "99999999", "9" * 400):
        assert rig("home", "--revolutions", rotations, "--yes").exit_code == 2, rotations
    assert json.loads(rig("status", "--json").stdout)["table_deg"] == pytest.approx(10, abs=ARRIVED_DEG)
    done = rig("home", "--revolutions", "1", "--yes", "--json")
    unwinding, moved = (json.loads(line) for line in done.stdout.splitlines())
    assert (unwinding["event"], unwinding["revolutions"]) == ("unwinding", 1)
    assert moved["rotation_encoder_deg"] == pytest.approx(-370, abs=ARRIVED_DEG)


@pytest.mark.parametrize("angle", ["nan", "inf", "-inf", "1e308"])
def test_angle_that_is_no_number_is_rejected_before_the_bench_opens(rig, angle):
    done = rig("goto", "--", angle)
    assert done.exit_code == 2
    assert "not an angle" in done.stderr
    assert not Path("state/sim/state.json").exists()


def test_every_command_reports_a_fault_until_it_is_acknowledged(rig):
    rig("goto", "5")
    store = FileStore(Path("state/sim"))
    stalled = Stalled(
        "The table is blocked at 7.0°.", next_step="Free it. Then run `rig acknowledge`.", evidence={"load_percent": 99}
    )
    store.save(store.load().model_copy(update={"fault": LatchedFault.of(stalled, "2026-01-02T03:04:05+00:00")}))
    for rejected in (
        rig("goto", "0"),
        rig("home"),
        rig("home", "--here"),
        rig("enroll", "dice", "--views", "4", *SMALL_WORDS),
    ):
        assert rejected.exit_code == 5
        assert "2026-01-02T03:04:05+00:00: The table is blocked at 7.0°." in rejected.stderr
        assert "Free it. Then run `rig acknowledge`." in rejected.stderr
    reported = rig("status")
    assert reported.exit_code == 0
    assert "fault 505" in reported.stdout
    assert json.loads(rig("status", "--json").stdout)["fault"]["evidence"] == {"load_percent": 99}
    done = rig("acknowledge")
    assert done.exit_code == 0
    assert "Acknowledged: The table is blocked at 7.0°.\nThe table is ready." in done.stdout
    assert rig("acknowledge").stdout.startswith("No fault was latched.")
    assert rig("goto", "0").exit_code == 0


def test_running_plan_blocks_the_bench_and_stop_ends_it(rig, running):
    process = running()
    rejected = rig("goto", "0")
    assert rejected.exit_code == 9
    assert f"process {process.pid} " in rejected.stderr
    assert "enroll dice --views 720" in rejected.stderr
    assert "rig stop" in rejected.stderr

    done = rig("stop", "--json")
    assert done.exit_code == 0, done.stderr
    report = json.loads(done.stdout)
    assert report == {"bench": "sim", "pid": process.pid, "ended": True, "torque_was_on": False}
    rest, errors = process.communicate(timeout=60)
    assert process.returncode == 5
    assert "Error 512 (stopped)" in errors
    assert "--resume" in errors
    assert json.loads(rest.splitlines()[-1])["code"] == 512
    assert state()["table"]["path_deg"] is None
    assert json.loads(rig("status", "--json").stdout)["state"] == "ready"
    assert "No program held the bench" in rig("stop").stdout


@pytest.mark.realtime
@pytest.mark.parametrize(("handler", "number"), [("", signal.SIGINT), ("unwinding", signal.SIGTERM)])
def test_stop_signals_a_program_outside_its_control_loop(tmp_path, monkeypatch, handler, number):
    monkeypatch.setattr("rig.jobs.stop.END_S", 60)  # a busy computer may need longer than a bench
    code = f"""
import signal, sys, time
from pathlib import Path
from rig.core.clock import SystemClock
from rig.safety.saved_state import BenchLock
def unwind(number, frame):
    raise SystemExit(128 + number)
if {handler!r}:
    signal.signal(signal.SIGTERM, unwind)
lock = BenchLock(Path({str(tmp_path / "sim")!r}), SystemClock())
try:
    print("held", flush=True)
    for _ in range(600):  # a signal that comes between two instructions of Python does not end a sleep that begins then
        time.sleep(0.1)
finally:
    print("torque off", flush=True)
"""
    process = Program(code=code)
    assert process.stdout.readline() == "held\n"
    done = stop("sim", load_config(None, [f"state_dir={str(tmp_path)!r}"]), SystemClock())
    assert (done.holder.pid, done.signalled, done.ended) == (process.pid, True, True)
    assert process.communicate(timeout=60)[0] == "torque off\n"
    assert process.returncode == (143 if handler else -number)


def test_stop_reports_how_to_end_a_program_that_does_not_react(tmp_path, monkeypatch):
    monkeypatch.setattr("rig.jobs.stop.REACTION_S", 0.1)
    monkeypatch.setattr("rig.jobs.stop.END_S", 0.3)
    code = f"""
import signal, time
from pathlib import Path
from rig.core.clock import SystemClock
from rig.safety.saved_state import BenchLock
signal.signal(signal.SIGINT, signal.SIG_IGN)
lock = BenchLock(Path({str(tmp_path / "sim")!r}), SystemClock())
print("held", flush=True)
time.sleep(60)
"""
    process = Program(code=code)
    assert process.stdout.readline() == "held\n"
    done = CliRunner().invoke(app, ["stop", "--bench", "sim", "--set", f"state_dir={str(tmp_path)!r}"])
    process.kill()
    process.communicate()
    assert done.exit_code == 9
    assert f"kill -9 {process.pid}" in done.stderr
    assert "0.5 s" in done.stderr
