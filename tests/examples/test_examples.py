"""The example scripts run as their README says."""

import json
import re
import shlex
import subprocess
from pathlib import Path

import pytest

from tests.programs import Program

EXAMPLES = Path(__file__).parents[2] / "examples"
SMALL = "[camera]\nwidth = 320\nheight = 240\n[view]\nroi = [40, 0, 240, 240]\n"  # takes less computing


def run(script: str, *arguments: str, cwd: Path, before: str = "") -> subprocess.CompletedProcess[str]:
    code = f"{before}\nimport runpy; runpy.run_path({script!r}, run_name='__main__')"
    program = Program(*arguments, code=code, folder=cwd)
    output, errors = program.communicate()
    return subprocess.CompletedProcess(script, program.wait(), output, errors)


def commands() -> list[list[str]]:
    """Return the arguments of the documented commands, without the program and the redirection."""
    text = (EXAMPLES / "README.md").read_text(encoding="utf-8")
    return [shlex.split(line.partition(">>")[0]) for line in re.findall(r"^ +\.venv/bin/python (.*)$", text, re.M)]


@pytest.fixture(scope="module")
def workshop(tmp_path_factory):
    """Return a folder with the examples and a catalog of the example tray."""
    folder = tmp_path_factory.mktemp("workshop")
    (folder / "examples").symlink_to(EXAMPLES)
    (folder / "rig.toml").write_text(SMALL)
    tray, *_ = commands()
    done = run(*tray, cwd=folder)
    assert done.returncode == 0, done.stderr
    return folder, done.stdout


def test_every_script_has_a_documented_command():
    assert sorted(f"examples/{path.name}" for path in EXAMPLES.glob("*.py")) == sorted(words[0] for words in commands())


def test_tray_is_enrolled_once_and_then_skipped(workshop):
    folder, first = workshop
    assert re.findall(r"\d/3 (\S+): (\w+)", first) == [("lamp", "enroll"), ("toy-car", "enroll"), ("dice", "enroll")]
    again = run(*commands()[0], cwd=folder)
    assert re.findall(r"\d/3 (\S+): (\w+)", again.stdout) == [("lamp", "skip"), ("toy-car", "skip"), ("dice", "skip")]


def test_loop_writes_json_lines_and_ends_after_its_answers(workshop):
    folder, _ = workshop
    done = run(*commands()[1], cwd=folder)
    assert done.returncode == 0, done.stderr
    events = [json.loads(line)["event"] for line in done.stdout.splitlines()]
    assert events.count("identified") == 3
    assert events.count("waiting") == 3
    assert events[-1] == "identified"


def test_loop_writes_an_error_as_its_last_line(tmp_path):
    done = run(str(EXAMPLES / "unattended_loop.py"), "--catalog", "nowhere", cwd=tmp_path)
    assert done.returncode == 7
    assert json.loads(done.stdout.splitlines()[-1])["next_step"]


@pytest.mark.nightly  # the golden sessions run every strategy of the rig
def test_custom_strategies_find_the_same_objects_as_the_default(tmp_path):
    done = run(str(EXAMPLES / "custom_strategy.py"), cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    found = re.findall(r"^([\w-]+) +(\S+) +found as (\S+) +(\d) views", done.stdout, re.M)
    assert [strategy for strategy, *_ in found] == ["dense"] * 3 + ["golden"] * 3 + ["far-side"] * 3
    assert all(shown == answer for _, shown, answer, _ in found), done.stdout


def test_bluesky_example_fails_without_bluesky(tmp_path):
    missing = "import sys; sys.modules['bluesky'] = None"
    done = run(str(EXAMPLES / "bluesky_bench.py"), cwd=tmp_path, before=missing)
    assert done.returncode == 1
    assert done.stdout == ""
    assert done.stderr == "This example needs bluesky. Install it: pip install 'hbr-rig[bluesky]'\n"
