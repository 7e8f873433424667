"""`rig eval` as its users call it, on folders of small drawn photographs."""

import csv
import json
import os
import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from rig.catalog import Catalog, Provenance, View
from rig.cli.objects.evaluate import evaluate
from rig.cli.ui.settings import Settings
from rig.core.clock import SystemClock
from rig.evaluation.report import Rows
from tests.programs import server

app = typer.Typer()
app.command("eval")(evaluate)

QUICK = ("--methods", "hbr,ahbr", "--trials", "2", "--views", "4", "--jobs", "1")
NOISY = ("--noise", "mb:5")


def drawing(number: int, angle: float, size: int = 40) -> np.ndarray:
    """A disc with a coloured spot that goes around it."""
    rng = np.random.default_rng(number)
    image = np.zeros((size, size, 3), np.uint8)
    cv2.circle(image, (size // 2, size // 2), size // 2 - 2, rng.integers(60, 256, 3).tolist(), -1)
    x, y = size / 2 + size / 4 * np.cos(np.radians(angle)), size / 2 - size / 4 * np.sin(np.radians(angle))
    cv2.circle(image, (round(x), round(y)), size // 7, rng.integers(0, 256, 3).tolist(), -1)
    return image


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("photographs")
    for number in range(1, 5):
        for angle in range(0, 360, 30):
            assert cv2.imwrite(str(folder / f"obj{number}__{angle}.png"), drawing(number, angle))
    return folder


def run(*arguments: str | Path):
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


@pytest.fixture(scope="module")
def evaluated(photographs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of one evaluation with noise; tests that write to it take a copy."""
    out = tmp_path_factory.mktemp("evaluated") / "out"
    done = run(photographs, *QUICK, *NOISY, "--out", out)
    assert done.exit_code == 0, done.output
    return out


def results(folder: Path) -> dict:
    found = json.loads((folder / "results.json").read_text())
    found.pop("wall_clock")
    return found


def test_evaluation_writes_its_results_in_every_format(photographs: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    done = run(photographs, "--noise", "gn", "--methods", "all,omega-sweep", *QUICK[2:], "--out", out)
    assert done.exit_code == 0, done.output
    assert "AHBR ω = 0.5 at N = 4" in done.output
    assert "McNemar p" in done.output
    found = results(out)
    assert found["settings"]["condition"]["noise"] == "gn:0.012"
    assert found["settings"]["dataset"]["views"] == 48
    assert found["bytes_per_view"] == 54
    hbr = next(method for method in found["methods"] if method["name"] == "hbr")
    assert [point["views"] for point in hbr["curve"]] == [1, 2, 3, 4]
    assert all(point["trials"] == 8 for point in hbr["curve"])
    assert hbr["curve"][-1]["hit_rate_low"] <= hbr["curve"][-1]["hit_rate"] <= hbr["curve"][-1]["hit_rate_high"]
    rows = list(csv.DictReader((out / "results.csv").read_text().splitlines()))
    assert len(rows) == sum(len(method["curve"]) for method in found["methods"])
    assert float(rows[-1]["hit_rate"]) == found["methods"][-1]["curve"][-1]["hit_rate"]
    for name in ("hit-rate", "travel", "pose", "omega-sweep"):
        picture = cv2.imread(str(out / f"{name}.png"))
        assert picture is not None
        assert picture.std() > 5
        assert (out / f"{name}.svg").read_text().startswith("<svg")
    page = (out / "report.html").read_text()
    assert page.count("<svg") == 4
    assert "McNemar" in page
    assert "http://" not in page.replace("http://www.w3.org/", "")  # but for the names of XML namespaces


def test_equal_commands_give_equal_results_with_any_number_of_processes(
    photographs: Path, evaluated: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    command = (photographs, *QUICK, *NOISY)
    # Processes that have imported the program: the tests of `map_in_processes` start others.
    context = server()
    monkeypatch.setattr("rig.core.processes.get_context", lambda _: context)
    assert run(*command, "--out", tmp_path / "again", "--jobs", "2").exit_code == 0
    assert results(tmp_path / "again") == results(evaluated)
    assert (tmp_path / "again/hit-rate.svg").read_bytes() == (evaluated / "hit-rate.svg").read_bytes()
    assert run(*command, "--out", tmp_path / "other", "--seed", "1").exit_code == 0
    assert results(tmp_path / "other")["methods"] != results(evaluated)["methods"]


def test_interrupted_evaluation_continues_with_its_stored_runs(
    photographs: Path, evaluated: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    really = Settings.print_json

    def interrupt(self: Settings, value: dict) -> None:
        really(self, value)
        if value["event"] == "searched":
            raise KeyboardInterrupt

    command = (photographs, *QUICK, *NOISY, "--json", "--out", tmp_path / "out")
    with monkeypatch.context() as patch:
        patch.setattr(Settings, "print_json", interrupt)
        stopped = run(*command)
    assert stopped.exit_code == 130
    assert "--resume" in stopped.stderr
    kept = {path: path.stat().st_mtime_ns for path in (tmp_path / "out/runs").glob("*.npz")}
    assert 1 <= len(kept) < 4
    assert run(*command).exit_code == 2  # not without --resume
    assert run(*command, "--resume").exit_code == 0
    assert all(path.stat().st_mtime_ns == written for path, written in kept.items())
    assert results(tmp_path / "out") == results(evaluated)


def test_runs_of_other_settings_are_not_mixed(photographs: Path, evaluated: Path, tmp_path: Path) -> None:
    out = shutil.copytree(evaluated, tmp_path / "out")
    done = run(photographs, *QUICK, "--out", out, "--resume", "--noise", "gn")
    assert done.exit_code == 2
    assert "other settings" in done.output
    assert "condition" in done.output


def test_report_of_some_objects_searches_among_all(photographs: Path, evaluated: Path, tmp_path: Path) -> None:
    out = shutil.copytree(evaluated, tmp_path / "out")
    whole = results(out)
    assert run(photographs, *QUICK, *NOISY, "--out", out, "--resume", "--report", "3-4").exit_code == 0
    part = results(out)
    assert part["settings"] == whole["settings"]
    assert (whole["reported"], part["reported"]) == (None, [3, 4])
    assert [method["curve"][0]["trials"] for method in part["methods"]] == [4, 4]
    assert part["methods"][0]["pose_rmse_deg_by_object"] == whole["methods"][0]["pose_rmse_deg_by_object"][2:]
    assert "Reported: objects 3 to 4." in (out / "report.html").read_text()


def test_damaged_runs_are_run_again_and_written_through_no_link(
    photographs: Path, evaluated: Path, tmp_path: Path
) -> None:
    out = shutil.copytree(evaluated, tmp_path / "out")
    damaged = out / "runs/obj2.npz"
    damaged.write_bytes(damaged.read_bytes()[:100])
    (tmp_path / "victim").write_text("mine")
    for name in ("runs/obj2.npz.part", "runs/obj2.part", "results.csv.part"):
        (out / name).symlink_to(tmp_path / "victim")
    (out / "results.csv").unlink()
    (out / "results.csv").symlink_to(tmp_path / "victim")
    assert run(photographs, *QUICK, *NOISY, "--out", out, "--resume").exit_code == 0
    assert (tmp_path / "victim").read_text() == "mine"
    assert results(out) == results(evaluated)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--noise", "fog"), "noise 'fog' is unknown"),
        (("--methods", "guess"), "method 'guess' is unknown"),
        (("--removal", "all"), "removal 'all' is unknown"),
        (("--background", "sea"), "background 'sea' is unknown"),
        (("--objects", "3"), "not a range"),
        (("--objects", "3-9"), "has 4"),
        (("--views", "12"), "obj1 has 12 views"),
    ],
)
def test_wrong_options_end_with_a_next_step(photographs: Path, tmp_path: Path, options: tuple, message: str) -> None:
    done = run(photographs, *QUICK, "--out", tmp_path / "out", *options)
    assert done.exit_code == 2
    assert message in done.output
    assert "Next step" in done.output


@pytest.mark.parametrize("jobs", ["1", pytest.param("2", marks=pytest.mark.nightly)])
def test_damaged_photograph_is_reported_by_its_name(photographs: Path, tmp_path: Path, jobs: str) -> None:
    folder = shutil.copytree(photographs, tmp_path / "photographs")
    broken = folder / "obj3__60.png"
    broken.write_bytes(broken.read_bytes()[:200])
    done = run(folder, *QUICK, "--out", tmp_path / "out", "--jobs", jobs)
    assert done.exit_code == 2
    assert "obj3__60.png is cut off" in done.output
    done = run(tmp_path / "nowhere", *QUICK)
    assert done.exit_code == 2
    assert "nowhere is not a folder" in done.output


def test_catalog_is_evaluated_if_no_folder_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("rig.toml").write_text('default_bench = "sim"\n[catalog]\npath = "catalog"\n[view]\nroi = [4, 0, 40, 40]\n')
    with Catalog.open("catalog", clock=SystemClock()) as catalog:
        for number, name in enumerate(("mug", "tea box")):
            enrollment = catalog.begin(
                name, planned_azimuth_deg=list(range(0, 360, 30)), provenance=Provenance("bench", {}, {})
            )
            for index in range(12):
                view = View(index=index, azimuth_deg=30.0 * index + 0.25)
                enrollment.add(view, cv2.copyMakeBorder(drawing(number, 30 * index), 0, 0, 4, 4, 0))
            enrollment.finish()
    done = run(*QUICK, "--out", "out")
    assert done.exit_code == 0, done.output
    assert results(Path("out"))["settings"]["dataset"]["objects"] == ["mug", "tea box"]
    assert results(Path("out"))["methods"][0]["curve"][0]["hit_rate"] > 0.5


def test_matrix_has_every_perturbation_at_three_strengths(photographs: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    few = ("--enrolled", "6", "--trials", "1", "--views", "2", "--jobs", "1", "--objects", "1-2")
    done = run(photographs, "--matrix", "--descriptor", "edges+colours", *few, "--out", out)
    assert done.exit_code == 0, done.output
    found = json.loads((out / "matrix.json").read_text())
    kinds = {row["kind"] for row in found["matrix"]}
    assert {"none", "gn", "mb", "defocus", "gain", "white-balance", "shift", "scale", "elevation"} <= kinds
    assert {"occlusion", "background"} <= kinds
    assert all(
        {row["strength"] for row in found["matrix"] if row["kind"] == kind} == {1, 2, 3} for kind in kinds - {"none"}
    )
    assert all(len(row["hit_rate"]) == 2 and row["trials"] == 2 for row in found["matrix"])
    assert found["matrix"][0]["hit_rate"][-1] == 1
    assert "white-balance" in done.output
    assert run(photographs, "--matrix", "--descriptor", "edges", "--jobs", "1", "--out", out).exit_code == 2


def test_other_descriptors_are_evaluated_with_the_dense_filter(photographs: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    options = ("--descriptor", "edges+colours", "--perturb", "shift:1+gain:1", "--enrolled", "6", *QUICK[2:])
    done = run(photographs, "--methods", "dense,dense-90", *options, "--out", out)
    assert done.exit_code == 0, done.output
    found = results(out)
    assert found["bytes_per_view"] == 160
    assert found["settings"]["condition"]["perturbations"] == "shift:1+gain:1"
    assert found["settings"]["protocol"]["enrolled"] == 6
    assert [method["name"] for method in found["methods"]] == ["dense", "dense-90"]
    assert "stopping rule" in (out / "report.html").read_text()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--descriptor", "sift"), "'sift' is unknown"),
        (("--perturb", "fog"), "'fog' is unknown"),
        (("--report", "3"), "'3' is not a range"),
        (("--report", "3-5"), "has 4; the first is 1"),
        (("--descriptor", "edges", "--methods", "hbr"), "compares CEDD alone"),
        (("--background", "bench", "--rotate", "10"), "leave out one of them"),
        (("--enrolled", "12", "--methods", "dense"), "queries it needs more"),
    ],
)
def test_contradicting_options_are_rejected(
    photographs: Path, tmp_path: Path, options: tuple[str, ...], words: str
) -> None:
    done = run(photographs, *options, *QUICK[2:], "--out", tmp_path / "out")
    assert done.exit_code == 2
    assert words in " ".join(done.output.split())


def test_left_out_objects_are_searched_for(photographs: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    options = ("--descriptor", "edges+colours", "--enrolled", "6", "--leave-out", "2", "--trials", "3")
    done = run(photographs, *options, "--views", "2", "--jobs", "1", "--out", out)
    assert done.exit_code == 0, done.output
    assert "false rejects / accepts" in done.output
    found = json.loads((out / "unknown_objects.json").read_text())
    rows = found["unknown_objects"]
    assert {row["unknown_trials"] for row in rows} == {30}
    # Fitted rules are measured with all trials, others with the third that they do not come from.
    assert {(row["fitted"], row["known_trials"]) for row in rows} == {(False, 10), (True, 30)}
    # With two trials for thresholds, no object is called unknown.
    by_trials = [row for row in rows if not row["fitted"]]
    assert all(row["false_rejects"] == 0 and row["false_accepts"] == 30 for row in by_trials)
    assert run(photographs, *options[:4], "--leave-out", "3", "--jobs", "1", "--out", out).exit_code == 2


@pytest.mark.nightly
def test_bench_change_searches_for_each_object_also_as_if_it_were_not_enrolled(
    photographs: Path, tmp_path: Path
) -> None:
    asked = ("--bench-change", "mild", "--objects", "1-3", "--report", "2-3", "--enrolled", "6", "--jobs", "1")
    done = run(photographs, *asked, "--out", tmp_path)
    assert done.exit_code == 0, done.output
    found = json.loads((tmp_path / "bench_change.json").read_text())
    assert (found["changed_bench"]["searches"], found["reported"]["searches"]) == (12, 8)
    assert found["changed_bench"]["left_out_searches"] == 12
    assert list(found["searches"]) == ["obj1", "obj2", "obj3"]
    for name, searches in found["searches"].items():
        assert len(searches) == 4
        assert {len(one["leaders"]) for one in searches} == {4}, name


def test_evaluations_with_other_settings_have_other_folders(
    photographs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for noise in ("mb:5", "gn:0.01"):
        done = run(photographs, *QUICK, "--noise", noise)
        assert done.exit_code == 0, done.output
        assert "Written: rig-eval/" in done.stderr
    first, second = sorted(Path("rig-eval").iterdir())
    assert (first.name[:-9], second.name[:-9]) == (
        f"{photographs.name}-gn-0.01",
        f"{photographs.name}-mb-5-20",
    )
    again = run(photographs, *QUICK, "--noise", "mb:5")
    assert again.exit_code == 2
    assert f"{second}/runs already contains runs" in again.stderr
    assert run(photographs, *QUICK, "--noise", "mb:5", "--resume", "--report", "3-4").exit_code == 0
    assert results(second)["reported"] == [3, 4]


def test_commands_of_the_results_run_one_after_the_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each command of the page ends with results of its own; nothing is computed here."""
    monkeypatch.chdir(tmp_path)
    Path("coil-100").mkdir()
    one = tmp_path / "view.png"
    assert cv2.imwrite(str(one), drawing(1, 0))
    for number in range(1, 101):
        for angle in range(0, 360, 5):
            os.link(one, f"coil-100/obj{number}__{angle}.png")
    monkeypatch.setattr("rig.evaluation.run.enrolled_views", lambda *_: None)
    monkeypatch.setattr("rig.evaluation.run.run_plan", lambda *_: None)
    for computed in ("matrix.run_matrix", "changes.run_changes", "unknown_objects.run_unknown_objects"):
        monkeypatch.setattr(f"rig.evaluation.{computed}", lambda *_: {})
    for table in ("matrix.matrix_rows", "changes.change_rows", "unknown_objects.unknown_object_rows"):
        monkeypatch.setattr(f"rig.evaluation.{table}", lambda _: Rows([], []))
    for table in ("curve_rows", "decision_rows"):
        monkeypatch.setattr(f"rig.evaluation.report.{table}", lambda _: Rows([], []))
    monkeypatch.setattr("rig.evaluation.report.contest_sentences", lambda _: [])
    monkeypatch.setattr("rig.evaluation.write.write_results", lambda *_: {})
    page = (Path(__file__).parents[4] / "docs/results.md").read_text(encoding="utf-8")
    commands = [words for words in re.findall(r"^rig eval (.+)$", page, re.MULTILINE) if words.startswith("coil-100 ")]
    assert len(commands) > 30
    for words in commands:
        done = run(*words.split())
        assert done.exit_code == 0, (words, done.output)
    assert len(list(Path("rig-eval").iterdir())) == len(commands)
