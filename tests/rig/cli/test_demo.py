"""`rig demo`, small: the whole job, its report, and that a seed determines both."""

import json
import os
import re
import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner

from rig.cli.main import app

SMALL = ("--count", "3", "--set", "enroll.views=12", "--set", "identify.max_views=4")


def demo(*arguments: str):
    return CliRunner().invoke(app, ["demo", *arguments])


def timeless(page: str) -> str:
    """Return the page without its part on the wall clock, which must be there."""
    cut, found = re.subn(r"<footer>.*?</footer>", "", page, flags=re.DOTALL)
    assert found == 1
    return cut


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    out = tmp_path_factory.mktemp("demo")
    return demo(*SMALL, "--seed", "3", "--out", str(out)), out


def test_it_enrolls_finds_and_recognises_strangers(small):
    done, _ = small
    assert done.exit_code in (0, 6)  # with so few views an answer may be wrong; that is said, and the exit code tells
    text = done.stdout
    moves = re.findall(
        r"^ +\d +[\d.]+° +([+-][\d.]+)° +([+-][\d.]+)° +([+-][\d.]+) ± [\d.]+°.* (\S+) [<>]?(\d+\.\d)%",
        text.replace("−", "-"),
        re.MULTILINE,
    )
    assert moves
    for asked, encoder, imu, leader, odds in moves:
        assert float(encoder) == pytest.approx(float(asked), abs=0.5)
        assert float(imu) == pytest.approx(float(encoder), abs=0.3 + 0.04 * abs(float(encoder)))
        assert leader
        assert 0 < float(odds) < 100
    assert text.count("(never") == 2  # a narrow terminal breaks the line after this word
    assert "3 objects enrolled with 36 views" in text


def test_it_leaves_the_report_and_nothing_else(small):
    _, out = small
    assert [path.name for path in out.iterdir()] == ["report.html"]


def test_equal_seeds_give_equal_reports_and_other_seeds_do_not(small, tmp_path):
    _, out = small
    first = (out / "report.html").read_text(encoding="utf-8")
    demo(*SMALL, "--seed", "3", "--out", str(tmp_path / "again"))
    demo(*SMALL, "--seed", "4", "--out", str(tmp_path / "other"))
    again = (tmp_path / "again" / "report.html").read_text(encoding="utf-8")
    other = (tmp_path / "other" / "report.html").read_text(encoding="utf-8")
    assert timeless(first) == timeless(again)
    assert timeless(first) != timeless(other)


def test_json_is_one_object_with_every_trial(tmp_path):
    done = demo(*SMALL, "--json", "--out", str(tmp_path))
    told = json.loads(done.stdout)
    assert told["enrolled"] == 3
    assert len(told["trials"]) == 5
    assert told["found"] == sum(t["right"] for t in told["trials"] if t["enrolled"])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--objects", "nowhere"), "nowhere"),
        (("--count", "1000"), "1000"),
        (("--out", "/proc/demo"), "/proc/demo"),
        (("--out", "/proc/self"), "/proc/self"),
        (("--set", "bench.sim.nois=1"), "bench.sim.nois: unknown key; did you mean noise?"),
        (("--set", "bench.sim.noise.fog=1"), "fog"),
        (("--bench", "hardware"), "simulated bench"),
    ],
)
def test_what_cannot_be_is_refused_with_a_next_step(arguments, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = demo(*arguments)
    assert done.exit_code in (2, 3)
    assert words in done.stderr
    assert "Next step:" in done.stderr


def test_photographs_are_enrolled_and_found(tmp_path):
    coil = Path(os.environ.get("RIG_TEST_DATA", Path(__file__).parents[3] / ".." / "shared" / "data")) / "coil-100"
    if not coil.is_dir():
        pytest.skip(f"no photographs at {coil}; set RIG_TEST_DATA")
    folder = tmp_path / "photographs"
    folder.mkdir()
    for number in range(1, 5):
        for path in coil.glob(f"obj{number}__*.png"):
            shutil.copy(path, folder)
    done = demo("--objects", str(folder), "--set", "enroll.views=36", "--out", str(tmp_path / "out"), "--json")
    told = json.loads(done.stdout)
    assert (told["found"], told["of"]) == (4, 4)
    assert [t["object"] for t in told["trials"] if t["enrolled"]] == ["obj1", "obj2", "obj3", "obj4"]
