"""A command that is killed at any point loses nothing that was stored, and the same command completes afterwards."""

import json
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from click.testing import Result
from typer.testing import CliRunner

from rig.cli.main import app
from tests.faults.killed_commands import COMMANDS, environment
from tests.programs import Program
from tests.rig.cli.noise_photographs import photographs

CONFIG = """default_bench = "sim"
[camera]
width = 320
height = 240
[view]
roi = [40, 0, 240, 240]
"""
KILLS = int(os.environ.get("RIG_TEST_KILLS", "1"))
"""Kills of each command; `make test-kills` asks for more."""
SIMILAR = ("photographs", "merge", "delete", "gc", "verify")
"""Commands that store their work as others do; with one kill, only the nightly tests run them."""

Rig = Callable[..., Result]


@pytest.fixture(scope="module")
def rig() -> Iterator[Rig]:
    """Return a function that runs a command in a home folder and in the present process."""
    with pytest.MonkeyPatch.context() as patch:

        def run(home: Path, *arguments: str, codes: tuple[int, ...] = (0,)) -> Result:
            patch.chdir(home)
            for key, value in environment(home).items():
                patch.setenv(key, value)
            result = CliRunner().invoke(app, list(arguments))
            assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
            assert result.exit_code in codes, result.output
            return result

        yield run


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, rig: Rig) -> Path:
    """Return a folder whose ``home`` has a catalog of two objects and a deleted one, another catalog and a bundle."""
    folder = tmp_path_factory.mktemp("killed")
    other, home = folder / "other", folder / "home"
    for place, names in ((other, ("book-night",)), (home, ("lamp", "dice", "toy-car"))):
        place.mkdir()
        (place / "rig.toml").write_text(CONFIG)
        for name in names:
            rig(place, "enroll", name, "--views", "4", "--yes")
    rig(other, "export", str(home / "third.rigcat.zip"))
    shutil.copytree(next((other / "data").rglob("catalog.sqlite")).parent, home / "other")
    rig(home, "catalog", "delete", "toy-car", "--yes")
    photographs(home / "photographs", "card", "stamp")
    (home / "tray.csv").write_text("name,label,note,views\nmug-star,kitchen,,4\nteapot,kitchen,,5\n")
    return folder


def state(rig: Rig, home: Path) -> dict[str, Any]:
    """Return what the operator finds in a home folder: objects with their views, configuration, and exported files."""
    listing = [json.loads(line) for line in rig(home, "catalog", "list", "--json").stdout.splitlines()]
    return {
        "objects": {one["name"]: one["views"] for line in listing for one in line.get("objects", [line])},
        "max_views": "max_views = 5" in (home / "rig.toml").read_text(),
        "exported": (home / "all.rigcat.zip").exists(),
    }


@pytest.mark.parametrize(
    "command", [pytest.param(one, marks=[pytest.mark.nightly] * (KILLS == 1 and one in SIMILAR)) for one in COMMANDS]
)
def test_killed_command_loses_nothing_and_completes(folder: Path, rig: Rig, command: str) -> None:
    process = Program(
        str(folder), str(KILLS), "1", command, code="from tests.faults.killed_commands import main; main()"
    )
    _, errors = process.communicate()
    assert process.returncode == 0, errors
    before, complete = (state(rig, home) for home in (folder / "home", folder / command / "complete"))
    for number in range(KILLS):
        home = folder / command / str(number)
        found = state(rig, home)
        if command == "tray":
            stored, all_views = found["objects"], complete["objects"]
            assert before["objects"].items() <= stored.items(), "a tray changes no other object"
            assert all(views <= all_views[name] for name, views in stored.items()), "a tray keeps what it has stored"
        else:
            assert found in (before, complete), "a command takes effect as a whole or not at all"
        rig(home, "catalog", "verify")
        if command == "search":
            shutil.rmtree(home / "run", ignore_errors=True)  # a run is never continued
        if found != complete:
            rig(home, *COMMANDS[command], codes=(0, 8))  # a search may end with "unknown object"
        assert state(rig, home) == complete
        rig(home, "catalog", "verify")
