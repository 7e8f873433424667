"""`rig enroll` with its options, and a bench with an operator."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from rig.cli.main import app
from rig.events.events import SimilarObjects


def test_enrollment_ends_with_similar_objects(enrolled):
    _, outputs = enrolled
    assert "looks like no other enrolled object" in outputs["lamp"].stdout
    events = [json.loads(line) for line in outputs["dice"].stdout.splitlines()]
    assert events[-2].keys() == {"event", *(SimilarObjects.__dataclass_fields__)}
    assert events[-1]["event"] == "enrolled"


def test_label_option_is_repeatable(rig):
    listed = json.loads(rig("catalog", "list", "--json").stdout)
    assert next(o["label"] for o in listed["objects"] if o["name"] == "lamp") == "kitchen, brass"


def test_training_set_is_exported_and_imported(rig, tmp_path):
    target = str(tmp_path / "set")
    words = ["export", target, "dice", "--format", "coco", "--json"]
    done = rig(*words)
    assert json.loads(done.stdout) == {
        "target": target,
        "format": "coco",
        "objects": 1,
        "views": {"train": 5, "val": 1, "test": 0},
        "without_mask": 0,
    }
    assert rig(*words).exit_code == 7
    imported = json.loads(rig("import", target, "--json", "--set", f"catalog.path={tmp_path / 'new'}").stdout)
    assert (imported["objects"], imported["views"], imported["rejected"]) == (1, 6, [])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("enroll", "clock", "--list", "x.csv"), "NAME and --list cannot be used together"),
        (("enroll", "--list", "x.csv", "--replace", "--label", "a"), "--label, --replace"),
        (("enroll", "--list", "x.csv"), "cannot be read"),
    ],
)
def test_enroll_rejects_wrong_options_with_a_next_step(rig, arguments, words):
    done = rig(*arguments)
    assert done.exit_code == 2
    assert words in done.stderr
    assert "Next step:" in done.stderr


def test_operator_is_asked_for_each_object(rig, with_operator):
    Path("tray.csv").write_text("name,label\nlamp,\nradio,desk\nclock,\nbook-atlas,\n", encoding="utf-8")
    done = CliRunner().invoke(
        app, ["enroll", "--list", "tray.csv", "--views", "4", "--set", "view.min_sharpness=0"], input="\ns\nq\n"
    )
    assert done.exit_code == 0, done.output
    assert "1 of 4  lamp: skipped, it is already enrolled" in done.stdout
    assert "2 of 4: put radio (desk) on the table" in done.stderr
    assert "3 of 4: put clock on the table" in done.stderr
    assert "3 of 4  clock: skipped, as the operator asked" in done.stdout
    assert "4 of 4: put book-atlas on the table" in done.stderr
    assert "1 of 4 objects enrolled in this run." in done.stderr
    names = {o["name"] for o in json.loads(rig("catalog", "list", "--json").stdout)["objects"]}
    assert "radio" in names
    assert not {"clock", "book-atlas"} & names
