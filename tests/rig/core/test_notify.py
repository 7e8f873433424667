"""The command of the user hears of jobs and faults, and cannot stop or delay them."""

import json
import sys
import threading
from pathlib import Path

import pytest
from typer.testing import CliRunner

from rig.cli.main import app
from rig.config import load_config
from rig.core import notify as notify_module
from rig.core.errors import MotionTimeout
from rig.core.notify import notify

COPY = "import sys, pathlib; pathlib.Path(sys.argv[1]).open('a').write(sys.stdin.read())"


def ended() -> None:
    """Wait for the commands that run."""
    for thread in threading.enumerate():
        if thread.name == "notify":
            thread.join()


def messages(path: Path) -> list[dict[str, object]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_command_gets_the_message_and_no_shell_reads_its_arguments(tmp_path):
    path = tmp_path / "$(touch harm); heard"
    notify([sys.executable, "-c", COPY, str(path)], {"event": "job", "text": "größer\n"})
    ended()
    assert messages(path) == [{"event": "job", "text": "größer\n"}]
    assert [one.name for one in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize(
    ("command", "why"),
    [
        (["/no/such/program"], "No such file"),
        ([sys.executable, "-c", "import sys; sys.exit('no network')"], "exit code 1. no network"),
        ([sys.executable, "-c", "import threading; threading.Event().wait()"], "it took more than 0.2 s"),
    ],
)
def test_command_that_fails_is_a_warning(command, why, monkeypatch, capsys):
    monkeypatch.setattr(notify_module, "LIMIT_S", 0.2 if "wait" in command[-1] else 30.0)
    notify(command, {})
    ended()
    warning = capsys.readouterr().err
    assert warning.startswith("Warning: notify_command")
    assert why in warning
    assert "Next step" in warning


def test_latched_fault_is_reported_once(tmp_path):
    from rig import open_bench

    heard = tmp_path / "heard"
    overrides = [f"notify_command={json.dumps([sys.executable, '-c', COPY, str(heard)])}"]
    config = load_config(None, [*overrides, f'state_dir="{tmp_path}"'], search=False)
    with open_bench("sim", config, seed=1) as bench:
        fault = MotionTimeout("The table does not arrive.", next_step="Look at the table.")
        bench.safety.latch(fault)
        bench.safety.latch(fault)
    ended()
    (message,) = messages(heard)
    assert (message["event"], message["bench"]) == ("fault", "sim")
    assert message["fault"]["code"] == MotionTimeout.code


@pytest.mark.parametrize(("angle", "state"), [("10", "done"), ("5000", "failed")])
def test_command_reports_how_its_job_ended(tmp_path, angle, state):
    heard = tmp_path / "heard"
    settings = [f"notify_command={json.dumps([sys.executable, '-c', COPY, str(heard)])}", f'state_dir="{tmp_path}"']
    options = [word for one in settings for word in ("--set", one)]
    CliRunner().invoke(app, ["goto", angle, "--bench", "sim", "--seed", "1", *options])
    ended()
    (message,) = messages(heard)
    assert (message["event"], message["job"]["kind"], message["job"]["state"]) == ("job", "goto", state)
    assert (message["job"]["error"] is None) == (state == "done")
    why = "" if state == "done" else " The table cannot rotate from"
    assert message["text"].startswith(f"sim: goto {state}.{why}")


def test_command_hears_the_answer_of_a_search(tmp_path):
    heard = tmp_path / "heard"
    settings = [
        f"notify_command={json.dumps([sys.executable, '-c', COPY, str(heard)])}",
        f'state_dir="{tmp_path}"',
        f'catalog.path="{tmp_path}/catalog"',
        'bench.sim.object="lamp"',
    ]
    options = ["--bench", "sim", "--seed", "1", *(word for one in settings for word in ("--set", one))]
    for command in (["enroll", "lamp", "--views", "6"], ["identify"]):
        assert CliRunner().invoke(app, [*command, *options]).exit_code == 0
    ended()
    enrolled, found = messages(heard)
    assert enrolled["text"].startswith("sim: enroll done. lamp: 6 views enrolled")
    assert found["text"].startswith("sim: identify done. lamp (looks the same from all sides)")
    assert "\n" not in found["text"]
    assert found["job"]["result"]["name"] == "lamp"
