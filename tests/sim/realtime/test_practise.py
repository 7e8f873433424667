"""docs/how-to/practise-on-a-simulated-bench.md: every command is typed, and its output is that of the page."""

import os
import re
import shlex
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from typer.testing import CliRunner

from rig.cli.main import app
from rig.core.errors import DeviceNotFound
from rig.devices.dynamixel.port import open_serial
from sim.realtime.wire import send_command
from tests.docs.pages import DOCS
from tests.programs import Program, until

START = "from rig.cli.main import main; main()"
PATIENCE_S = 60.0
IN_DEPTH = ("A cable is unplugged", "A program is killed", "Enroll and identify")
"""Sections that only the nightly test walks through."""


@dataclass
class Typed:
    """A command of the page, with the answer on the page."""

    section: str
    terminal: str
    command: str
    answer: str = ""

    def check(self, found: str) -> None:
        pattern = re.escape(self.answer.strip("\n")).replace("…", ".*?")
        assert re.search(rf"\A{pattern}\s*\Z", found.strip("\n"), re.DOTALL), f"$ {self.command}\n{found}"


def commands() -> Iterator[Typed]:
    page = (DOCS / "how-to" / "practise-on-a-simulated-bench.md").read_text(encoding="utf-8")
    for text in page.split("\n## ")[1:]:
        section = text.partition("\n")[0]
        for terminal, block in re.findall(r'```console title="(.*?)"\n(.*?)```', text, re.DOTALL):
            typed: Typed | None = None
            for line in block.splitlines():
                if line.startswith("$ "):
                    if typed:
                        yield typed
                    typed = Typed(section, terminal, line[2:])
                elif typed:
                    typed.answer += line + "\n"
            if typed:
                yield typed


def is_free(port: Path) -> bool:
    """Return whether no program, such as a guardian, has a port open."""
    try:
        open_serial(str(port), 57_600).close()
    except DeviceNotFound:
        return False
    return True


def process(*words: str, cwd: Path) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-c", START, *words],
        cwd=cwd,
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1", "COLUMNS": "500"},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


@pytest.mark.nightly
@pytest.mark.realtime
@pytest.mark.parametrize("in_depth", [False, True])
def test_practice_shows_the_output_of_the_page(in_depth, tmp_path, monkeypatch):
    first, *rest = commands()
    assert {typed.section for typed in rest} > set(IN_DEPTH)
    folder = tmp_path / "sim-bench"
    # a busy computer may pause programs
    (tmp_path / "rig.toml").write_text("[table]\nwatchdog_s = 2.5\n[servo]\nretries = 20\n")
    bench = process(*shlex.split(first.command)[1:], cwd=tmp_path)
    others: list[tuple[Typed, Program]] = []
    try:
        assert bench.stdout is not None
        first.check("".join(bench.stdout.readline() for _ in range(3)))
        monkeypatch.chdir(folder)
        monkeypatch.setenv("COLUMNS", "500")
        walked = [typed for typed in rest if in_depth or typed.section not in IN_DEPTH]
        for typed, following in zip(walked, [*walked[1:], None], strict=True):
            program, *words = shlex.split(typed.command)
            if program == "kill":
                killed = others.pop()[1]
                killed.kill()
                killed.communicate()
                until(lambda: not send_command(folder, "status")["world"]["torque"] and is_free(folder / "servo"))
            elif following and (typed.terminal, following.terminal) == ("second terminal", "third terminal"):
                start_deg = send_command(folder, "status")["world"]["table_deg"]
                others.append((typed, Program(*words, folder=folder, OPENBLAS_NUM_THREADS="1", COLUMNS="500")))
                until(
                    lambda start_deg=start_deg: (
                        abs(send_command(folder, "status")["world"]["table_deg"] - start_deg) > 20.0
                    )
                )
            else:
                typed.check(CliRunner().invoke(app, words).output)
        for typed, other in others:
            typed.check("".join(reversed(other.communicate(timeout=PATIENCE_S))))
        bench.send_signal(signal.SIGTERM if in_depth else signal.SIGINT)
        said = bench.communicate(timeout=PATIENCE_S)[0]
        assert "Traceback" not in said
        assert in_depth or said.endswith("The simulated bench has ended.\n")
        assert bench.returncode == (143 if in_depth else 0)
        assert {path.name for path in folder.iterdir()} <= {"lock", "rig.toml", "state", "catalog", "calibration"}
    finally:
        bench.kill()
        bench.communicate()
        for _, other in others:
            other.close()
