"""Runs a command with input from an attacker, and checks the rules for every input.

No traceback, an exit code of the registry, no hang, at most 1 GiB of memory, nothing written outside its place, nothing
that controls a terminal, and with ``--json`` lines of JSON.
"""

import json
import os
import shutil
import subprocess
import sys
import unicodedata
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from hypothesis import HealthCheck, settings

from rig.cli.ui.exit_codes import EXIT_CODES
from tests.fuzzing import MAX_MEMORY

CONFIG = (
    'default_bench = "sim"\n[camera]\nwidth = 320\nheight = 240\n[view]\nroi = [40, 0, 240, 240]\n'
    '[catalog]\npath = "catalog"\n'
)
WITH_VALUE = ("--seed", "--views", "--revolutions", "--config", "--set", "--bench")
NIGHTLY = 200
"""How many times as many cases the nightly profile has."""


def cases(count: int) -> settings:
    """Return settings with ``count`` cases in CI, and many more at night."""
    nightly = settings.get_current_profile_name() == "nightly"
    return settings(
        max_examples=count * NIGHTLY if nightly else count,
        deadline=None,
        suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.function_scoped_fixture],
    )


@dataclass(frozen=True)
class Done:
    """A command that ended."""

    exit_code: int
    out: str
    err: str
    memory_bytes: int
    cpu_s: float


class Commands:
    """Commands in the folder ``inside``; they may change nothing outside of it, except the program's own folders."""

    def __init__(self, home: Path) -> None:
        self.home = home
        """An empty folder."""
        self.inside = home / "inside"
        self.outside = home / "outside"
        self.inside.mkdir()
        self.outside.mkdir()
        (self.outside / "secret.txt").write_text("secret", encoding="utf-8")
        (self.outside / "folder").mkdir()
        xdg = {f"XDG_{name}_HOME": str(home / "xdg" / name.lower()) for name in ("CONFIG", "DATA", "STATE", "CACHE")}
        self._worker = subprocess.Popen(
            [sys.executable, "-m", "tests.fuzz.worker"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, **xdg, "HOME": str(self.outside), "OPENBLAS_NUM_THREADS": "1", "COLUMNS": "200"},
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        assert self._worker.stdin is not None
        self._worker.stdin.close()
        self._worker.wait(60)
        if self._worker.stdout is not None:
            self._worker.stdout.close()

    def fresh(self) -> Path:
        """Return the folder of the next command, with a configuration for the simulator and nothing else."""
        shutil.rmtree(self.inside, ignore_errors=True)
        self.inside.mkdir()
        (self.inside / "rig.toml").write_text(CONFIG, encoding="utf-8")
        return self.inside

    def run(self, *arguments: str) -> Done:
        """Run a command and check the rules for every input."""
        assert self._worker.stdin is not None
        assert self._worker.stdout is not None
        before = tree(self.outside)
        print(json.dumps({"arguments": arguments, "folder": str(self.home)}), file=self._worker.stdin, flush=True)
        done = Done(**json.loads(self._worker.stdout.readline()))
        check(done, arguments)
        assert tree(self.outside) == before, arguments
        return done


def check(done: Done, arguments: tuple[str, ...]) -> None:
    """Check the rules for every input."""
    assert done.exit_code in EXIT_CODES, (arguments, done)
    assert done.exit_code != 1, (arguments, done)
    assert "Traceback" not in done.err, (arguments, done)
    assert done.memory_bytes <= MAX_MEMORY, (arguments, done.memory_bytes)
    for text in (done.out, done.err):
        assert not [c for c in text if unicodedata.category(c) == "Cc" and c not in "\n\t"], (arguments, text)
    if done.exit_code:
        shown = done.out + done.err  # rig status reports a broken device among the others
        assert "Next step:" in shown or "for help.\n\nError: " in done.err or done.exit_code in (6, 7, 8), (
            arguments,
            done,
        )
    if asks_for_json(arguments):
        assert all(isinstance(json.loads(line), dict) for line in done.out.splitlines()), (arguments, done.out)


def asks_for_json(arguments: tuple[str, ...]) -> bool:
    """Return whether ``--json`` is an option here: not the value of another option, and not after ``--``."""
    options = arguments[: arguments.index("--")] if "--" in arguments else arguments
    return any(word == "--json" and before not in WITH_VALUE for before, word in pairwise(("", *options)))


def tree(folder: Path) -> dict[str, Any]:
    """Return the content of a folder: names with kind, size and time of each."""
    found = {}
    for path in sorted(folder.rglob("*")):
        state = path.lstat()
        found[str(path.relative_to(folder))] = (state.st_mode, state.st_size, state.st_mtime_ns)
    return found
