"""`rig identify`: strategies, recorded results, and an object that comes while it waits."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from rig.catalog import Catalog
from rig.cli.main import app
from rig.cli.ui.exit_codes import EXIT_QUALITY
from rig.core.clock import SystemClock
from rig.search.model import CurrentModel
from rig.views.object_presence import TableWatcher
from sim.bench import ShelfOperator
from sim.objects.shelf import shelf
from tests.rig.catalog.catalog_samples import fill


def in_json(done):
    return [json.loads(line) for line in done.stdout.splitlines()]


def test_each_search_of_watch_asks_for_the_sample(enrolled, monkeypatch):
    monkeypatch.chdir(enrolled[0])
    command = ["identify", "--watch", "--scan", "--operator", "A. Silva", "--json", "--set", "bench.sim.object=dice"]
    done = CliRunner().invoke(app, [*command, "--save-run", "runs"], input="S-1\nS\x1d2\nS-2\n\n")
    assert done.exit_code == 2  # the answers have ended
    events = in_json(done)
    assert [event["sample"] for event in events if event.get("event") == "recorded"] == ["S-1", "S-2", None]
    kinds = [event["event"] for event in events[:-1]]
    assert all(kinds[k + 1] == "recorded" for k, kind in enumerate(kinds) if kind == "identified")
    assert "cannot be printed" in done.stderr
    listed = in_json(CliRunner().invoke(app, ["results", "list", "--json", "--sample", "S-2"]))
    assert [one["operator"] for one in listed] == ["A. Silva"]
    assert sorted(path.name for path in Path("runs").iterdir())[:3] == ["0001", "0002", "0003"]
    assert CliRunner().invoke(app, ["replay", "runs/0002", "--check"]).exit_code == 0


def test_sample_of_watch_is_that_of_the_object_on_the_table(rig, with_operator, monkeypatch):
    """The operator scans the object that is on the table, not the one that was there before."""
    on_table = []

    class Comes(TableWatcher):
        def place(self, name):
            (world,) = with_operator
            if len(on_table) == 2:
                raise KeyboardInterrupt
            coming = ("lamp", "dice")[len(on_table)]

            def put() -> None:
                on_table.append(coming)
                world.put(shelf()[coming], 33.0)

            world.clock.call_at(world.clock.now_ns() + 3 * 10**9, put)
            super().place(name)

    def scan() -> str | None:
        (world,) = with_operator
        scanned_ns.append(world.clock.now_ns())
        return f"S-{on_table[-1]}" if on_table else None

    scanned_ns: list[int] = []
    monkeypatch.setattr("rig.jobs.identify.TableWatcher", Comes)
    monkeypatch.setattr("rig.cli.ui.prompts.TerminalOperator.ask_sample", lambda _: scan())
    done = rig("identify", "--watch", "--scan", "--json")
    assert done.exit_code == 130, done.output
    events = in_json(done)
    exposed_ns = [event["evidence"]["exposed_ns"] for event in events if event["event"] == "accepted"]
    assert exposed_ns[0] - scanned_ns[0] > 10**9  # the hand with the scanner must be away
    recorded = [event["result"] for event in events if event["event"] == "recorded"]
    listed = {row["result"]: row for row in in_json(rig("results", "list", "--json"))}
    assert [(listed[n]["object"], listed[n]["sample"]) for n in recorded] == [("lamp", "S-lamp"), ("dice", "S-dice")]


def test_sample_is_rejected_if_it_cannot_be_recorded(rig):
    assert rig("identify", "--sample", "S-1", "--watch").exit_code == 2
    assert rig("identify", "--sample", "S-1", "--set", "identify.record=none").exit_code == 2
    assert rig("identify", "--sample", " ").exit_code == 2


@pytest.mark.nightly
def test_closed_pipe_ends_the_command_without_an_error(enrolled):
    folder, _ = enrolled
    command = (
        f"{sys.executable} -c 'from rig.cli.main import main; main()' identify | head -n 1; echo ${{PIPESTATUS[0]}}"
    )
    done = subprocess.run(["bash", "-c", command], cwd=folder, capture_output=True, text=True)
    assert done.stdout.splitlines()[-1] in ("0", "8", "141")  # it can end before head does
    assert "Traceback" not in done.stderr
    assert "Error" not in done.stderr


def test_region_that_differs_from_that_of_the_enrollment_is_reported(rig):
    moved = ("--set", "view.roi=[45, 0, 230, 240]", "--set", "bench.sim.object=dice", "--set", "identify.max_views=2")
    note = rig("identify", *moved).stderr
    assert "now it is [45, 0, 230, 240]" in note
    assert "rig config set view.roi '[40, 0, 240, 240]'" in note
    assert "view.roi" not in rig("identify", *moved[2:]).stderr


def test_watch_finds_objects_that_were_enrolled_meanwhile(rig, enrolled):
    """The model is loaded again only if the catalog has changed."""
    folder, _ = enrolled
    with Catalog.open(folder / "catalog", clock=SystemClock(), read_only=True) as catalog:
        model = CurrentModel(catalog)
        before = model()
        assert model() is before
        with Catalog.open(folder / "catalog", clock=SystemClock()) as other:
            fill(other, "amphora", 4)
        assert "amphora" not in before.views.object_names
        assert "amphora" in model().views.object_names


def test_empty_table_is_no_object_with_an_exit_code_of_its_own(rig, monkeypatch):
    before = rig("results", "list", "--json").stdout
    monkeypatch.setattr(ShelfOperator, "place", lambda self, _: self.world.put(None))
    for words in (["identify", "--sample", "S-1"], ["identify", "--strategy", "ahbr"], ["enroll", "nothing"]):
        done = rig(*words, "--json", "--set", "state_dir=state")  # with the image of the first command
        assert done.exit_code == EXIT_QUALITY
        error = in_json(done)[-1]
        assert (error["title"], error["code"]) == ("no object", 606)
        assert error["next_step"].startswith("Put the object on the table")
    assert rig("results", "list", "--json").stdout == before
    assert "nothing" not in rig("catalog", "list").stdout
    assert rig("identify", "--save-run", "runs/empty").exit_code == EXIT_QUALITY
    assert rig("replay", "runs/empty", "--check").exit_code == 0
    assert rig("report", "runs/empty").exit_code == 0
