"""A program that runs commands again and again and kills each run at another point of its progress.

Arguments: FOLDER KILLS SEED [NAME ...].
FOLDER/home is the state before a command. Every run works on a copy of it, FOLDER/<command>/<number>, in a child
process (`tests.faults.kills`). FOLDER/<command>/complete is the copy on which the command ran to its end.
"""

import os
import shutil
import sys
from contextlib import redirect_stderr, redirect_stdout
from functools import partial
from pathlib import Path

from rig.cli.main import app
from tests.faults.kills import killed_child, points

COMMANDS = {
    "import": ("import", "third.rigcat.zip", "--on-conflict", "skip", "--jobs", "1"),
    "export": ("export", "all.rigcat.zip"),
    "photographs": ("import", "photographs", "--jobs", "1"),
    "merge": ("import", "other", "--on-conflict", "skip", "--jobs", "1"),
    "rename": ("catalog", "rename", "lamp", "lantern"),
    "delete": ("catalog", "delete", "lamp", "--yes"),
    "gc": ("catalog", "gc", "--yes"),
    "verify": ("catalog", "verify"),
    "configuration": ("config", "set", "identify.max_views", "5"),
    "tray": ("enroll", "--list", "tray.csv", "--yes"),
    "search": ("identify", "--save-run", "run", "--set", "bench.sim.object=radio"),
}


def environment(home: Path) -> dict[str, str]:
    """Return the variables that make ``home`` the home folder of the program."""
    return {f"XDG_{kind}_HOME": str(home / kind.lower()) for kind in ("CONFIG", "DATA", "STATE", "CACHE")}


def main() -> None:
    folder, kills, seed = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
    for name in sys.argv[4:] or COMMANDS:
        _enter(folder, name, "warm-up")
        _run(name)  # the first run stores byte code
        _enter(folder, name, "complete")
        for number, (point, delay_s) in enumerate(points(partial(_run, name), kills, seed)):
            _enter(folder, name, str(number))
            killed_child(lambda _report, command=name: _run(command), point, delay_s)


def _enter(folder: Path, command: str, number: str) -> None:
    """Make a copy of the home folder, and make it the home of the program."""
    home = folder / command / number
    shutil.copytree(folder / "home", home)
    os.environ |= environment(home)
    os.chdir(home)


def _run(command: str) -> None:
    with open(os.devnull, "w") as nowhere, redirect_stdout(nowhere), redirect_stderr(nowhere):  # noqa: PTH123
        code = app(COMMANDS[command], standalone_mode=False)
    if code not in (None, 0, 8):  # a search may end with "unknown object"
        raise SystemExit(f"{command} ended with {code}")
