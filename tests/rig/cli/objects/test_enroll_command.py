"""`rig enroll` with its options, reports, completion, and a bench with an operator."""

import json
import re
from pathlib import Path

import pytest
from typer.testing import CliRunner

from rig.cli.main import app
from rig.events.events import SimilarObjects
from tests.programs import Program, stopping_after_view


def test_enrollment_ends_with_similar_objects_and_a_report(enrolled):
    folder, outputs = enrolled
    assert "looks like no other enrolled object" in outputs["lamp"].stdout
    events = [json.loads(line) for line in outputs["dice"].stdout.splitlines()]
    assert events[-2].keys() == {"event", *(SimilarObjects.__dataclass_fields__)}
    assert events[-1]["event"] == "enrolled"
    page = (folder / "lamp.html").read_text(encoding="utf-8")
    assert "Contact sheet of lamp: 6 views" in page
    assert "Sharpness of the views" in page
    assert "looks like" in page
    assert not re.search(r'(src|href)="(?!data:|#)', page)  # the page is self-contained


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
        (("enroll", "clock", "--report", "/proc/nowhere/clock.html"), "The report cannot be written"),
        (("enroll", "clock", "--report", "catalog"), "The report cannot be written"),
    ],
)
def test_enroll_rejects_wrong_options_with_a_next_step(rig, arguments, words):
    done = rig(*arguments)
    assert done.exit_code == 2
    assert words in done.stderr
    assert "Next step:" in done.stderr


def test_report_of_a_resumed_enrollment_has_all_views(rig, enrolled):
    folder, _ = enrolled
    process = Program("enroll", "candle", "--json", code=stopping_after_view(4), folder=folder)
    process.wait_until_stopped()
    process.close()
    done = rig("enroll", "candle", "--resume", "--report", "candle.html")
    assert done.exit_code == 0, done.output
    assert "Contact sheet of candle: 6 views" in Path("candle.html").read_text(encoding="utf-8")


def test_shell_completes_objects_benches_and_strategies(enrolled):
    folder, _ = enrolled

    def complete(*words: str) -> set[str]:
        variables = {"COMP_WORDS": "rig " + " ".join(words), "COMP_CWORD": str(len(words))}
        code = "from rig.cli.main import app; app(prog_name='rig')"
        process = Program(code=code, folder=folder, _RIG_COMPLETE="complete_bash", **variables)
        return set(process.communicate()[0].split())

    assert complete("enroll", "l") == {"lamp"}
    assert complete("enroll", "--bench", "s") == {"sim", "sim-bench"}
    assert complete("identify", "--strategy", "s") == {"sweep"}
    assert complete("ide") == {"identify"}
    assert complete("config", "set", "camera.e") == {"camera.exposure_us"}
    assert complete("config", "show", "bench.sim.y") == {"bench.sim.yaw_deg"}
    assert complete("enroll", "--config", "nonsense.toml", "l") == set()


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
