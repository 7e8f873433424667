"""The commands of the catalog as a technician calls them."""

import json
import os
import re
import sqlite3
import subprocess
import sys
import zipfile
from collections.abc import Callable
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from click.testing import Result
from typer.testing import CliRunner

from hbr.descriptors import registry
from hbr.descriptors.cedd import Cedd
from rig.catalog import Catalog
from rig.catalog.exchange.photographs import read_folder
from rig.catalog.jobs import finished
from rig.catalog.verify import verify
from rig.cli.main import app
from rig.core.clock import SystemClock
from tests.rig.cli.noise_photographs import photographs

COIL = Path(os.environ.get("RIG_TEST_DATA", Path(__file__).parents[4] / ".." / "shared" / "data")) / "coil-100"

Rig = Callable[..., Result]


def result(done: Result) -> Any:
    assert done.exit_code == 0, done.output
    return json.loads(done.stdout)


def names(rig: Rig, *options: str) -> list[str]:
    return [item["name"] for item in result(rig("catalog", "list", "--json", *options))["objects"]]


def test_list_filters_by_label(two: Rig) -> None:
    assert names(two) == ["mug", "tin"]
    assert names(two, "--label", "kitchen") == ["mug", "tin"]
    assert names(two, "--label", "lab") == []
    assert "No such objects" in two("catalog", "list", "--label", "lab").stdout
    assert two("catalog", "list").stdout.splitlines()[1].split()[:3] == ["mug", "kitchen", "4"]


def test_list_in_a_pipe_is_complete_and_without_markup(rig: Rig, tmp_path: Path) -> None:
    name = f"[red]{'long ' * 18}name"
    folder = photographs(tmp_path / "in", "x")
    (folder / "views.csv").write_text(f"object,azimuth_deg,image\n{name},0,x__0.png\n")
    assert rig("import", "in").exit_code == 0
    assert name in rig("catalog", "list").stdout


def test_catalog_is_edited_and_every_change_is_logged(two: Rig) -> None:
    assert two("catalog", "rename", "mug", "cup").exit_code == 0
    assert two("catalog", "label", "cup", "lab", "--note", "a chip").exit_code == 0
    shown = two("catalog", "show", "cup").stdout
    assert "cup  lab" in shown
    assert "a chip" in shown
    assert two("catalog", "label", "cup").exit_code == 2
    assert two("catalog", "rename", "cup", "tin").exit_code == 7
    rejected = two("catalog", "delete", "cup")  # no operator is at the terminal
    assert rejected.exit_code == 2
    assert "--yes" in rejected.stderr
    assert two("catalog", "delete", "cup", "--yes").exit_code == 0
    assert names(two) == ["tin"]
    assert names(two, "--deleted") == ["cup"]
    assert two("catalog", "undelete", "cup").exit_code == 0
    assert two("catalog", "delete", "tin", "--yes").exit_code == 0
    assert result(two("catalog", "gc", "--dry-run", "--json"))["objects"] == ["tin"]
    assert two("catalog", "gc").exit_code == 2
    assert result(two("catalog", "gc", "--yes", "--json"))["views"] == 4
    assert two("catalog", "undelete", "tin").exit_code == 7
    assert "nothing to remove" in two("catalog", "gc").stdout
    log = [json.loads(line) for line in two("log", "--json").stdout.splitlines()]
    changes = [entry["action"] for entry in log]
    assert changes[0] == "imported"
    assert [change for change in changes if change != "imported"] == [
        *("renamed", "labelled", "deleted", "undeleted", "deleted", "collected garbage")
    ]
    assert all(entry["user"] for entry in log)
    assert two("log", "--since", "1h").stdout.count("deleted") == 3
    assert "No entries since then" in two("log", "--since", "2999-01-01").stdout
    assert two("log", "--since", "yesterdayish").exit_code == 2


@pytest.mark.parametrize(("answer", "left"), [("n\n", ["mug", "tin"]), ("y\n", ["tin"])])
def test_delete_asks_for_confirmation(two: Rig, monkeypatch: pytest.MonkeyPatch, answer: str, left: list[str]) -> None:
    monkeypatch.setattr("rig.cli.ui.prompts.is_interactive", lambda: True)
    done = CliRunner().invoke(app, ["catalog", "delete", "mug"], input=answer)
    assert "Delete mug with 4 views?" in done.output
    assert done.exit_code == (0 if answer == "y\n" else 1)
    assert names(two) == left


def test_log_has_moves_and_rejected_moves(two: Rig) -> None:
    assert two("goto", "30").exit_code == 0
    assert two("goto", "5000").exit_code == 5
    log = [json.loads(line) for line in two("log", "--json").stdout.splitlines()]
    moves = [entry["details"] for entry in log if entry["action"] == "moved"]
    assert moves[0] == {"to_deg": 30.0}
    assert "cable" in moves[1]["ended"]
    assert re.search(r" moved +to 30\.0°$", two("log").stdout, re.MULTILINE)


def test_verify_names_the_object_and_sets_the_exit_code(two: Rig) -> None:
    assert result(two("catalog", "verify", "--json"))["findings"] == []
    image = Path("catalog", result(two("catalog", "show", "mug", "--json"))["views"][0]["image"])
    content = image.read_bytes()
    image.unlink()
    found = two("catalog", "verify")
    assert found.exit_code == 7
    assert (
        f"image missing: 'mug': {image.relative_to('catalog')}; No such file or directory; restore it" in found.stdout
    )
    assert "2 objects, 8 views, 0 results" in found.stdout
    assert "1 problem" in found.stdout
    (finding,) = json.loads(two("catalog", "verify", "--json").stdout)["findings"]
    assert (finding["problem"], finding["object_name"]) == ("image missing", "mug")
    image.write_bytes(content)
    assert two("catalog", "verify").exit_code == 0


def test_search_computes_a_new_descriptor_by_itself(two: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(registry._KNOWN, "cedd", Cedd(version=2))
    assert two("identify", "--strategy", "ahbr", "--set", "identify.max_views=2").exit_code in (0, 8)


def test_identify_reports_another_region(rig: Rig) -> None:
    assert rig("enroll", "dice", "--views", "4").exit_code == 0
    moved = ("--set", "view.roi=[45, 0, 230, 240]", "--set", "bench.sim.object=dice", "--set", "identify.max_views=2")
    note = rig("identify", *moved).stderr
    assert "now it is [45, 0, 230, 240]" in note
    assert "rig config set view.roi '[40, 0, 240, 240]'" in note
    assert "view.roi" not in rig("identify", *moved[2:]).stderr


def test_dry_run_writes_nothing(rig: Rig, tmp_path: Path) -> None:
    folder = photographs(tmp_path / "in", "mug")
    (folder / "mug__5.png").write_bytes(b"x")
    done = result(rig("import", "in", "--dry-run", "--json"))
    assert (done["objects"], done["views"], len(done["rejected"])) == (1, 4, 1)
    assert not Path("catalog").exists()


@pytest.mark.parametrize(
    ("target", "options"),
    [("out.rigcat.zip", ()), ("out", ()), ("out.images", ("--format", "folder"))],
)
def test_export_can_be_imported(two: Rig, target: str, options: tuple[str, ...]) -> None:
    assert result(two("export", target, "--json", *options))["objects"] == 2
    other = ("--set", "catalog.path=other")
    assert two("import", target, *other).exit_code == 0
    assert two("catalog", "verify", *other).exit_code == 0
    shown = [result(two("catalog", "show", "tin", "--json", *where))["views"] for where in ((), other)]
    assert next([v["image_sha256"] for v in views] for views in shown) == [v["image_sha256"] for v in shown[1]]
    assert [v["descriptors"] for v in shown[0]] == [v["descriptors"] for v in shown[1]]
    again = two("import", target, *other)
    if target.endswith(".zip"):  # these enrollments are in the catalog already
        assert again.exit_code == 0
        assert "Skipped, already in the catalog: mug, tin" in again.output
    else:
        assert again.exit_code == 7
        assert "--on-conflict skip" in again.stderr
    assert result(two("import", target, "--on-conflict", "skip", "--json", *other))["skipped"] == ["mug", "tin"]
    assert two("export", target, *options).exit_code == 7  # it exists already


def test_some_objects_are_exported(two: Rig) -> None:
    assert result(two("export", "mug.rigcat.zip", "mug", "--json"))["objects"] == 1
    assert two("export", "none.rigcat.zip", "jug").exit_code == 7
    assert two("export", "none.rigcat.zip", "--label", "lab").exit_code == 7
    unknown = two("export", "out.tar")
    assert unknown.exit_code == 2
    assert ".csv (csv)" in unknown.stderr


def test_merge_is_all_or_nothing(two: Rig) -> None:
    other = ("--set", "catalog.path=other")
    assert two("import", "photographs", "--table-angles", *other).exit_code == 0
    assert two("catalog", "rename", "tin", "jar", *other).exit_code == 0
    assert two("import", "other").exit_code == 7
    assert names(two) == ["mug", "tin"]
    assert two("import", "catalog").exit_code == 0  # with what it has already
    assert result(two("import", "other", "--on-conflict", "skip", "--json"))["objects"] == 1
    assert names(two) == ["mug", "tin", "jar"]


def test_import_rejects_bad_source(rig: Rig) -> None:
    with zipfile.ZipFile("evil.rigcat.zip", "w") as archive:
        archive.writestr("../../evil.png", b"x")
    Path("notes.txt").write_text("x")
    Path("empty").mkdir()
    for source, words in (
        ("evil.rigcat.zip", "outside the catalog"),
        ("notes.txt", "is not a folder"),
        ("empty", "No photograph"),
        ("nowhere", "does not exist"),
    ):
        done = rig("import", source)
        assert done.exit_code == 7, source
        assert words in done.stderr
    assert rig("import", "empty", "--pattern", "{angle}").exit_code == 2
    assert rig("import", "empty", "--on-conflict", "merge").exit_code == 2


def test_photographs_are_imported_with_empty_table_images(rig: Rig, tmp_path: Path) -> None:
    photographs(tmp_path / "in", "mug", "tin")
    photographs(tmp_path / "tables", "table", step_deg=360)
    done = rig("import", "in", "--empty-table", "tables/table__0.png", "--dry-run")
    assert done.exit_code == 0, done.output
    assert "Whole photographs are described" in done.stdout
    assert result(rig("import", "in", "--empty-table", "tables/table__0.png", "--json"))["views"] == 8
    shown = result(rig("catalog", "show", "tin", "--json"))
    (session,) = shown["enrollments"][0]["sessions"]
    stored = Path("catalog", "images", session["empty_table"][:2], session["empty_table"])
    assert stored.read_bytes() == Path("tables/table__0.png").read_bytes()


def test_empty_table_images_that_do_not_fit_the_source_are_rejected(two: Rig, tmp_path: Path) -> None:
    photographs(tmp_path / "in", "jar")
    photographs(tmp_path / "tables", "table", step_deg=360, side=20)
    rejected = two("import", "in", "--empty-table", "tables/table__0.png")
    assert rejected.exit_code == 7
    assert "20 x 20 pixels" in rejected.stderr
    assert two("import", "in", "--empty-table", "tables").exit_code == 7
    assert names(two) == ["mug", "tin"]
    of_catalog = two("import", "catalog", "--empty-table", "tables/table__0.png")
    assert of_catalog.exit_code == 2
    assert "only with photographs" in of_catalog.stderr


def test_busy_catalog_is_reported_after_the_timeout(two: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(Catalog.open.__func__.__kwdefaults__, "busy_timeout_s", 0.05)
    with closing(sqlite3.connect("catalog/catalog.sqlite", isolation_level=None)) as other:
        other.execute("BEGIN IMMEDIATE")
        assert names(two) == ["mug", "tin"]  # readers do not wait
        done = two("catalog", "rename", "mug", "cup")
    assert done.exit_code == 9
    assert "Another process has been writing" in done.stderr
    assert two("catalog", "rename", "mug", "cup").exit_code == 0


INTERRUPTED = """
import os, signal
from contextlib import closing
from rig.catalog import incoming, jobs
from rig.cli.main import main

jobs.PORTION = 8  # so that few photographs are enough for two processes
staged = incoming.map_in_processes

def interrupted(*arguments):
    with closing(staged(*arguments)) as portions:  # a loop closes it, too; a variable of the traceback would not
        yield next(portions)
        os.killpg(os.getpgrp(), signal.SIGINT)  # as in a terminal, to all processes of the program
        yield from portions

incoming.map_in_processes = interrupted
main()
"""


def test_interrupted_import_leaves_images_only(tmp_path: Path) -> None:
    photographs(tmp_path / "in", "jar", step_deg=5)
    (tmp_path / "rig.toml").write_text('default_bench = "sim"\n[catalog]\npath = "catalog"\n', encoding="utf-8")
    words = [sys.executable, "-c", INTERRUPTED, "import", "in", "--jobs", "2"]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, start_new_session=True, timeout=60)
    assert done.returncode == 130, done.stderr
    assert "nothing was imported" in done.stderr
    assert "Traceback" not in done.stderr
    with Catalog.open(tmp_path / "catalog", clock=SystemClock()) as catalog:
        assert (catalog.objects(), catalog.log()) == ([], [])
        assert not list(catalog.path.rglob("*.part"))
        assert finished(verify(catalog)).findings == ()


@pytest.mark.skipif(not COIL.is_dir(), reason="no COIL-100 at ../shared/data nor where RIG_TEST_DATA points")
def test_coil_100_is_read() -> None:
    batch = read_folder(COIL, now=datetime(2026, 1, 1, tzinfo=UTC))
    items = list(batch.items())
    views = sum(len(state.enrollment.views) for item in items for state in item.enrollments)
    assert (len(items), views, list(batch.rejected)) == (100, 7178, [])
