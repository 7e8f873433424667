"""`rig enroll` with its options, and a bench with an operator."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from rig.cli.main import app


def test_label_option_is_repeatable(rig):
    listed = json.loads(rig("catalog", "list", "--json").stdout)
    assert next(o["label"] for o in listed["objects"] if o["name"] == "lamp") == "kitchen, brass"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("enroll", "clock", "--list", "x.csv"), "NAME and --list cannot be used together"),
        (("enroll", "--list", "x.csv", "--replace", "--label", "a"), "--label, --replace"),
        (("enroll", "--list", "x.csv"), "cannot be read"),
        (("enroll", "--list", "x.csv", "--retake", "2"), "--retake cannot be used with --list"),
        (("enroll", "lamp", "--retake", "2", "--views", "8", "--fly"), "--views, --fly cannot be used with --retake"),
        (("enroll", "lamp", "--retake", "999"), "has the views 1 to"),
    ],
)
def test_enroll_rejects_wrong_options_with_a_next_step(rig, arguments, words):
    done = rig(*arguments)
    assert done.exit_code == 2
    assert words in done.stderr
    assert "Next step:" in done.stderr


def test_view_is_taken_again(rig):
    done = rig("enroll", "lamp", "--retake", "2", "--retake", "3")
    assert done.exit_code == 0, done.output
    assert "Views 2 and 3 of lamp were taken again." in done.stdout
    entry = json.loads(rig("log", "--json").stdout.splitlines()[-1])
    assert "taken_again" in json.dumps(entry)


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
