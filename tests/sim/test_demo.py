"""`rig demo` with few objects, also with faults: output, report, reproducibility; and `rig faults`."""

import json
import re

import pytest
from typer.testing import CliRunner

from rig.cli.main import app
from rig.core.json_form import plain
from sim.change import Change
from sim.faults import Fault, fault_kinds
from tests import small

SETTINGS = ("enroll.views=6", "identify.max_views=2", *small.SMALL)
SMALL = ("--count", "2", *(word for setting in SETTINGS for word in ("--set", setting)))


def rig(*arguments: str):
    return CliRunner().invoke(app, list(arguments))


def timeless(page: str) -> str:
    """Return the page without its date, and without its footer, which has the run time."""
    cut, found = re.subn(r"<footer>.*?</footer>|<time[^>]*>.*?</time>", "", page, flags=re.DOTALL)
    assert found == 2
    return cut


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Return the same demo twice, the second time with --json: what it prints, and its report."""
    found = []
    for options in ((), ("--json",)):
        out = tmp_path_factory.mktemp("demo")
        done = rig("demo", *SMALL, "--seed", "5", "--out", str(out), *options)
        assert done.exit_code in (0, 6)  # with so few views an answer can be wrong: exit code 6
        assert [path.name for path in out.iterdir()] == ["report.html"]
        found.append((done.stdout, (out / "report.html").read_text(encoding="utf-8")))
    return found


def test_demo_enrolls_and_finds_objects_and_recognises_unknown_ones(runs):
    (text, _), _ = runs
    moves = re.findall(r"table at ([+-]?[\d.]+)° \(asked ([+-]?[\d.]+)°\)", text.replace("−", "-"))
    assert moves
    for reached, asked in moves:
        assert float(reached) == pytest.approx(float(asked), abs=0.5)
    assert text.count("(not enrolled)") == 2
    assert "2 objects enrolled with 12 views" in text


def test_report_depends_on_nothing_but_the_seed(runs):
    (_, first), (_, again) = runs
    assert timeless(first) == timeless(again)


def test_ambiguous_answers_are_a_count_of_their_own(runs):
    """After two views, the first of the two mugs may still be the other one."""
    (text, page), (output, _) = runs
    result = json.loads(output)
    assert (result["enrolled"], len(result["trials"])) == (2, 4)
    known = [trial for trial in result["trials"] if trial["enrolled"]]
    for correctness, count in (("right", "found"), ("ambiguous", "ambiguous")):
        assert result[count] == sum(trial["correctness"] == correctness for trial in known)
    assert [trial["possible"] for trial in result["trials"][:2]] == [["mug-white", "mug-star"], ["mug-star"]]
    assert (result["found"], result["ambiguous"], result["of"]) == (1, 1, 2)
    assert result["median_pose_error_deg"] < 5
    assert "1 of 2 enrolled objects found again, 1 ambiguous; 2 of 2 unknown objects recognised." in text
    assert re.findall(r"^\?  (\S+) +ambiguous ", text, re.MULTILINE) == ["mug-white"]
    assert "1 of 2 enrolled objects found again, 1 ambiguous;" in page


@pytest.mark.nightly
def test_changed_bench_is_searched_with_the_faults_of_command_line_and_configuration(tmp_path):
    """With marks on the platter, in other light, and with clutter; they do not end the demo."""
    done = rig(
        *("demo", *SMALL, "--views", "5", "--change", "hard", "--out", str(tmp_path)),
        *("--fault", "crc_flip@1s+3s", "--fault", "camera.slow@2s+1s"),
        *("--set", 'bench.sim.faults=["i2c_nack@3s+1s"]'),
    )
    assert done.exit_code in (0, 6), done.output
    assert "2 objects enrolled with 10 views" in done.stdout  # --views wins over enroll.views
    assert done.stdout.count("(not enrolled)") == 2
    for name in ("crc_flip", "camera.slow", "i2c_nack"):
        assert f"fault begins: {name}" in done.stderr
        assert f"fault ends: {name}" in done.stderr


@pytest.mark.nightly
def test_json_names_the_change_of_the_bench_which_changes_every_score(runs, tmp_path):
    done = rig("demo", *SMALL, "--seed", "5", "--change", "hard", "--json", "--out", str(tmp_path))
    unchanged, changed = json.loads(runs[1][0]), json.loads(done.stdout)
    assert (unchanged["change"], changed["change"]) == (None, plain(Change.named(["hard"])))
    before, after = ([trial["score"] for trial in result["trials"]] for result in (unchanged, changed))
    assert all(score != other for score, other in zip(before, after, strict=True))


def test_fault_ends_the_demo_with_its_exit_code_and_next_step(tmp_path):
    done = rig("demo", *SMALL, "--fault", "jam@move2", "--out", str(tmp_path))
    assert done.exit_code == 5
    assert "fault begins: jam" in done.stderr
    assert "Next step:" in done.stderr
    assert list(tmp_path.iterdir()) == []


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
        (("--fault", "jamm"), "Did you mean jam?"),
        (("--fault", "jam@noon"), "12s, move3 or view10"),
        (("--set", 'bench.sim.faults=["jamm"]'), "Did you mean jam?"),
    ],
)
def test_demo_rejects_invalid_options_with_a_next_step(arguments, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = rig("demo", *arguments)
    assert done.exit_code in (2, 3)
    assert words in done.stderr
    assert "Next step:" in done.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.nightly
def test_default_demo_finds_all_objects_and_recognises_both_unknown_ones(tmp_path):
    done = rig("demo", "--json", "--out", str(tmp_path))
    totals = json.loads(done.stdout.splitlines()[-1])
    assert totals["views_enrolled"] == 16 * 36
    assert (totals["found"], totals["unknown_recognised"]) == (totals["of"], totals["of_unknown"]) == (16, 2)


def test_faults_are_listed_as_json():
    listed = [json.loads(line) for line in rig("faults", "--json").stdout.splitlines()]
    assert [entry["fault"] for entry in listed] == list(fault_kinds())
    for entry in listed:
        given = "".join(f":{name}={value['default']}" for name, value in entry["parameters"].items())
        assert Fault.parse(entry["fault"] + given).kind.what == entry["what"]


@pytest.mark.parametrize("stored", [False, True])
def test_a_jam_asks_for_an_acknowledgement_only_where_a_fault_stays_latched(stored, tmp_path):
    """The simulated bench forgets its state with its program, unless it has a folder for it."""
    bench = ("--bench", "sim", *(("--set", f"state_dir={tmp_path}") if stored else ()))
    jammed = rig("goto", "40", *bench, "--set", 'bench.sim.faults=["jam"]')
    assert jammed.exit_code == 5
    assert ("rig acknowledge" in jammed.stderr) == stored
    assert ("start the program again" in jammed.stderr) != stored
    assert rig("goto", "40", *bench).exit_code == (5 if stored else 0)  # as the next step says
    acknowledged = json.loads(rig("acknowledge", *bench, "--json").stdout)["acknowledged"]
    assert (acknowledged is not None) == stored
