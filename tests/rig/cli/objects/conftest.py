"""A day with two enrolled objects and a saved run: enrolled once, and copied for each test."""

import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner

from rig.cli.main import app
from sim.bench import SimBenchKind
from sim.objects.shelf import shelf
from tests.small import SMALL_FILE


@pytest.fixture(scope="session")
def original(tmp_path_factory):
    """Return a folder with two enrolled objects and a saved run."""
    folder = tmp_path_factory.mktemp("day")
    (folder / "rig.toml").write_text(f"{SMALL_FILE}[enroll]\nviews = 6\n", encoding="utf-8")
    outputs = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for name, words in {
            "lamp": ["enroll", "lamp", "--label", "kitchen", "--label", "brass"],
            "dice": ["enroll", "dice", "--json"],
            "run": [
                *("identify", "--strategy", "ahbr", "--set", "bench.sim.object=dice", "--seed", "4"),
                # six views and two objects give a limit that none of them reaches
                *("--set", "identify.min_score=0.9", "--save-run", "runs/1"),
            ],
        }.items():
            done = CliRunner().invoke(app, words)
            assert done.exit_code == 0, done.output
            outputs[name] = done
    return folder, outputs


@pytest.fixture
def enrolled(original, tmp_path):
    """Return a copy of the folder, so that no test finds what another one has changed."""
    folder, outputs = original
    return Path(shutil.copytree(folder, tmp_path / "day")), outputs


@pytest.fixture
def rig(enrolled, monkeypatch):
    folder, _ = enrolled
    monkeypatch.chdir(folder)

    def run(*arguments: str):
        return CliRunner().invoke(app, list(arguments))

    return run


@pytest.fixture
def with_operator(monkeypatch):
    """Open the simulated bench with a lamp, without the operator that places objects; return its world."""
    opened = []
    really = SimBenchKind.open

    def open_without(self, config, options, seed):
        bench = really(self, config, options, seed)
        opened.append(bench.placer.world)
        bench.placer = None
        opened[-1].put(shelf()["lamp"])
        return bench

    monkeypatch.setattr(SimBenchKind, "open", open_without)
    return opened
