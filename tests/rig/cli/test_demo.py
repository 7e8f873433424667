"""`rig demo` with few objects: output, report, reproducibility."""

import json
import re

import pytest
from typer.testing import CliRunner

from rig.cli.main import app
from rig.core.json_form import plain
from sim.change import Change

SETTINGS = (
    *("enroll.views=6", "identify.max_views=2"),
    *("camera.width=320", "camera.height=240", "view.roi=[40, 0, 240, 240]"),
)
SMALL = ("--count", "2", *(word for setting in SETTINGS for word in ("--set", setting)))


def demo(*arguments: str):
    return CliRunner().invoke(app, ["demo", *arguments])


def timeless(page: str) -> str:
    """Return the page without its date, and without its footer, which has the run time."""
    cut, found = re.subn(r"<footer>.*?</footer>|<time[^>]*>.*?</time>", "", page, flags=re.DOTALL)
    assert found == 2
    return cut


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    out = tmp_path_factory.mktemp("demo")
    return demo(*SMALL, "--seed", "5", "--out", str(out)), out


@pytest.fixture(scope="module")
def in_json(tmp_path_factory):
    out = tmp_path_factory.mktemp("demo-json")
    return demo(*SMALL, "--seed", "5", "--json", "--out", str(out)), out


def test_demo_enrolls_and_finds_objects_and_recognises_unknown_ones(small):
    done, _ = small
    assert done.exit_code in (0, 6)  # with so few views an answer can be wrong: exit code 6
    text = done.stdout
    moves = re.findall(
        r"table at ([+-]?[\d.]+)° \(asked ([+-]?[\d.]+)°\)",
        text.replace("−", "-"),
    )
    assert moves
    for reached, asked in moves:
        assert float(reached) == pytest.approx(float(asked), abs=0.5)
    assert text.count("(not enrolled)") == 2
    assert "2 objects enrolled with 12 views" in text


def test_demo_leaves_only_the_report(small):
    _, out = small
    assert [path.name for path in out.iterdir()] == ["report.html"]


def test_report_depends_on_nothing_but_the_seed(small, in_json):
    first, again = ((out / "report.html").read_text(encoding="utf-8") for _, out in (small, in_json))
    assert timeless(first) == timeless(again)


def test_json_is_one_object_with_every_trial(in_json):
    result = json.loads(in_json[0].stdout)
    assert result["enrolled"] == 2
    assert len(result["trials"]) == 4
    known = [trial for trial in result["trials"] if trial["enrolled"]]
    for correctness, count in (("right", "found"), ("ambiguous", "ambiguous")):
        assert result[count] == sum(trial["correctness"] == correctness for trial in known)


def test_ambiguous_answers_are_a_count_of_their_own(small, in_json):
    """After two views, the first of the two mugs may still be the other one."""
    result = json.loads(in_json[0].stdout)
    assert [trial["possible"] for trial in result["trials"][:2]] == [
        ["mug-white", "mug-star"],
        ["mug-star"],
    ]
    assert (result["found"], result["ambiguous"], result["of"]) == (1, 1, 2)
    assert result["median_pose_error_deg"] < 5
    text = small[0].stdout
    assert "1 of 2 enrolled objects found again, 1 ambiguous; 2 of 2 unknown objects recognised." in text
    assert re.findall(r"^\?  (\S+) +ambiguous ", text, re.MULTILINE) == ["mug-white"]
    assert "1 of 2 enrolled objects found again, 1 ambiguous;" in (small[1] / "report.html").read_text(encoding="utf-8")


@pytest.mark.nightly
def test_json_names_the_change_of_the_bench(in_json, tmp_path):
    """With marks on the platter, in other light, and with clutter; they do not end the demo."""
    unchanged = json.loads(in_json[0].stdout)
    done = demo(*SMALL, "--seed", "5", "--change", "hard", "--json", "--out", str(tmp_path))
    assert done.exit_code in (0, 6)
    assert "Error" not in done.output
    changed = json.loads(done.stdout)
    assert (unchanged["change"], changed["change"]) == (None, plain(Change.named(["hard"])))
    light = Change.named(["light"])
    assert light.brightness > 0
    assert light.placement_mm == 0
    assert changed["enrolled"] == 2
    before, after = ([trial["score"] for trial in result["trials"]] for result in (unchanged, changed))
    assert all(score != other for score, other in zip(before, after, strict=True))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--objects", "nowhere"), "nowhere"),
        (("--count", "1000"), "1000"),
        (("--out", "/proc/demo"), "/proc/demo"),
        (("--out", "/proc/self"), "/proc/self"),
        (("--set", "bench.sim.nois=1"), "bench.sim.nois: unknown key; did you mean noise?"),
        (("--set", "bench.sim.noise.fog=1"), "fog"),
        (("--change", "fog"), "There is no change 'fog'"),
        (("--bench", "hardware"), "simulated bench"),
    ],
)
def test_demo_rejects_invalid_options_with_a_next_step(arguments, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = demo(*arguments)
    assert done.exit_code in (2, 3)
    assert words in done.stderr
    assert "Next step:" in done.stderr


@pytest.mark.nightly
def test_default_demo_finds_all_objects_and_recognises_both_unknown_ones(tmp_path):
    done = demo("--json", "--out", str(tmp_path))
    totals = json.loads(done.stdout.splitlines()[-1])
    assert totals["views_enrolled"] == 16 * 36
    assert (totals["found"], totals["unknown_recognised"]) == (totals["of"], totals["of_unknown"]) == (16, 2)
