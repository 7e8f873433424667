"""The commands of the catalog as a technician calls them."""

import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from click.testing import Result
from typer.testing import CliRunner

from rig.cli.main import app
from tests.rig.cli.noise_photographs import photographs

Rig = Callable[..., Result]


def result(done: Result) -> Any:
    assert done.exit_code == 0, done.output
    return json.loads(done.stdout)


def names(rig: Rig, *options: str) -> list[str]:
    return [item["name"] for item in result(rig("catalog", "list", "--json", *options))["objects"]]


def test_what_is_deleted_is_confirmed_and_can_be_collected(two: Rig) -> None:
    assert two("catalog", "label", "tin").exit_code == 2
    rejected = two("catalog", "delete", "tin")  # no operator is at the terminal
    assert rejected.exit_code == 2
    assert "--yes" in rejected.stderr
    assert two("catalog", "delete", "tin", "--yes").exit_code == 0
    assert names(two, "--label", "kitchen") == ["mug"]
    assert two("catalog", "gc").exit_code == 2
    assert result(two("catalog", "gc", "--yes", "--json"))["views"] == 4
    assert two("catalog", "undelete", "tin").exit_code == 7
    assert "nothing to remove" in two("catalog", "gc").stdout
    assert two("log", "--since", "1h").stdout.count("deleted") == 1
    assert two("log", "--since", "2999-01-01").stdout.splitlines() == ["time_utc  user  action  object_name  details"]
    assert two("log", "--since", "yesterdayish").exit_code == 2


@pytest.mark.parametrize(("answer", "left"), [("n\n", ["mug", "tin"]), ("y\n", ["tin"])])
def test_delete_asks_for_confirmation(two: Rig, monkeypatch: pytest.MonkeyPatch, answer: str, left: list[str]) -> None:
    monkeypatch.setattr("rig.cli.ui.prompts.is_interactive", lambda: True)
    done = CliRunner().invoke(app, ["catalog", "delete", "mug"], input=answer)
    assert "Delete mug with 4 views?" in done.output
    assert done.exit_code == (0 if answer == "y\n" else 1)
    assert names(two) == left


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


def test_interrupted_check_changes_nothing(two: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("rig.catalog.verify.map_in_processes", interrupted)
    stopped = two("catalog", "verify")
    assert stopped.exit_code == 130
    assert "Interrupted; nothing was changed." in stopped.stderr
    assert "torque" not in stopped.stderr


def test_some_objects_are_exported(two: Rig) -> None:
    assert result(two("export", "mug.rigcat.zip", "mug", "--json"))["objects"] == 1
    assert two("export", "none.rigcat.zip", "jug").exit_code == 7
    assert two("export", "none.rigcat.zip", "--label", "lab").exit_code == 7
    unknown = two("export", "out.tar")
    assert unknown.exit_code == 2
    assert ".csv (csv)" in unknown.stderr


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
    Path("in/mug__5.png").write_bytes(b"x")
    done = rig("import", "in", "--empty-table", "tables/table__0.png", "--dry-run")
    assert done.exit_code == 0, done.output
    assert "Whole photographs are described" in done.stdout
    assert "1 file rejected:" in done.stderr
    assert not Path("catalog").exists()
    assert result(rig("import", "in", "--empty-table", "tables/table__0.png", "--json"))["views"] == 8
    shown = result(rig("catalog", "show", "tin", "--json"))
    (session,) = shown["enrollments"][0]["sessions"]
    stored = Path("catalog", "images", session["empty_table"][:2], session["empty_table"])
    assert stored.read_bytes() == Path("tables/table__0.png").read_bytes()
