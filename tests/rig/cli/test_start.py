"""Ctrl+C while the program starts and while it ends: exit code 130 or that of the command, and never a traceback."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

RIG = Path(sys.executable).with_name("rig")
SITE = """
import atexit, os, signal, sys, threading

def interrupt(*_):
    os.kill(os.getpid(), signal.SIGINT)

class Finder:
    def find_spec(self, name, path=None, target=None):
        if name == moment:
            sys.meta_path.remove(self)
            interrupt()

moment = os.environ["RIG_TEST_MOMENT"]
if moment == "atexit":
    atexit.register(interrupt)
elif moment == "threads":
    shutdown = threading._shutdown
    threading._shutdown = lambda: (interrupt(), shutdown())
else:
    sys.meta_path.insert(0, Finder())
"""
"""Python imports this at its start. It sends SIGINT when a module is to be imported, or at a moment of the end."""


def interrupted(
    folder: Path, moment: str, *words: str, handler: object = signal.SIG_DFL
) -> subprocess.CompletedProcess:
    (folder / "sitecustomize.py").write_text(SITE, encoding="utf-8")
    return subprocess.run(
        [RIG, *words],
        env={**os.environ, "PYTHONPATH": str(folder), "RIG_TEST_MOMENT": moment},
        cwd=folder,
        capture_output=True,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, handler),
    )


@pytest.mark.parametrize(
    ("moment", "words"),
    [
        ("rig.cli.main", "--version"),
        ("sim.bench", "goto 90 --bench sim"),  # the command has begun
        *(
            pytest.param(moment, "goto 90 --bench sim", marks=pytest.mark.nightly)
            for moment in ("typer", "rig.core.signals", "rig.cli.bench.table", "numpy", "cv2")
        ),
    ],
)
def test_ctrl_c_at_the_start_ends_the_program_without_a_traceback(moment, words, tmp_path):
    done = interrupted(tmp_path, moment, *words.split())
    assert done.returncode == 130
    assert "Traceback" not in done.stderr
    assert "°" not in done.stdout  # the table has not moved


@pytest.mark.parametrize(
    ("moment", "words"),
    [
        ("atexit", "--version"),
        *(pytest.param("threads", words, marks=pytest.mark.nightly) for words in ("config show", "--version")),
    ],
)
def test_ctrl_c_at_the_end_keeps_the_exit_code_and_prints_no_traceback(moment, words, tmp_path):
    done = interrupted(tmp_path, moment, *words.split())
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout


@pytest.mark.nightly
def test_ignored_ctrl_c_stays_ignored_until_a_command_begins(tmp_path):
    done = interrupted(tmp_path, "typer", "config", "show", handler=signal.SIG_IGN)
    assert (done.returncode, done.stderr) == (0, "")
    done = interrupted(tmp_path, "sim.bench", "goto", "90", "--bench", "sim", handler=signal.SIG_IGN)
    assert (done.returncode, done.stderr.split()[0]) == (130, "Interrupted.")


PLAIN = """
def new():
    try:
        interrupt()
    finally:
        print("closed")
"""
SET_NAME = """
@command
def new(settings):
    class Part:
        def __set_name__(self, owner, name): interrupt()
    class Whole:
        part = Part()
"""
DEL = """
@command
def new(settings):
    class Part:
        def __del__(self): interrupt()
    Part()
    threading.Event().wait(60)
"""
SLOW = (
    """
usual = threading.Thread.start
def start(thread):
    usual(thread)
    threading.Event().wait(0.1)
threading.Thread.start = start
"""
    + DEL
)


@pytest.mark.parametrize(
    ("command", "output", "errors"),
    [
        pytest.param(PLAIN, "closed\n", "", id="command-of-a-package"),
        pytest.param(SET_NAME, "", "Interrupted.\n", id="python-3.11-makes-another-exception-of-it"),
        pytest.param(DEL, "", "Interrupted.\n", id="python-drops-the-exception"),
        pytest.param(
            SLOW, "", "Interrupted.\n", id="python-drops-the-exception-on-a-busy-computer", marks=pytest.mark.nightly
        ),
    ],
)
def test_ctrl_c_unwinds_each_command(command, output, errors):
    code = f"""
import os, signal, sys, threading
from importlib.metadata import EntryPoint
from rig.cli.main import _places
from rig.cli.start import main
from rig.cli.ui.command import command

def interrupt():
    os.kill(os.getpid(), signal.SIGINT)
{command}
_places()["new"] = EntryPoint("new", "__main__:new", "rig.commands")
sys.argv = ["rig", "new"]
main()
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=50)
    assert (done.returncode, done.stdout, done.stderr) == (130, output, errors)
