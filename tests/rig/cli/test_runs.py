"""The commands identify, replay and report; dry runs, completion, closed pipes, and benches with an operator."""

import json
import re
import shutil
import sqlite3
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import pytest
from typer.testing import CliRunner

from rig.bench import ObjectAlreadyPlaced
from rig.catalog import Catalog
from rig.cli.main import app
from rig.cli.ui.exit_codes import EXIT_AMBIGUOUS
from rig.core.clock import SystemClock
from rig.events.events import SimilarObjects
from rig.search.current_model import CurrentModel
from rig.search.replay import Difference
from rig.views.object_presence import TableWatcher
from sim.bench import SimBenchKind
from sim.objects.shelf import shelf
from tests.programs import Program, stopping_after_view

SMALL = (
    'default_bench = "sim"\n[catalog]\npath = "catalog"\n[camera]\nwidth = 320\nheight = 240\n'
    "[view]\nroi = [40, 0, 240, 240]\n[enroll]\nviews = 6\n"
)


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    """Return a folder with two enrolled objects, the report of one, and a saved run."""
    folder = tmp_path_factory.mktemp("day")
    (folder / "rig.toml").write_text(SMALL, encoding="utf-8")
    outputs = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for name, words in {
            "lamp": ["enroll", "lamp", "--label", "kitchen", "--label", "brass", "--report", "lamp.html"],
            "dice": ["enroll", "dice", "--json"],
            "run": [
                "identify",
                "--strategy",
                "ahbr",
                "--set",
                "bench.sim.object=dice",
                "--seed",
                "4",
                "--save-run",
                "runs/1",
            ],
        }.items():
            done = CliRunner().invoke(app, words)
            assert done.exit_code == 0, done.output
            outputs[name] = done
    return folder, outputs


@pytest.fixture
def enrolled(original, tmp_path):
    """Return a copy of the folder, so that no test finds what another one has changed."""
    folder, outputs = original
    return Path(shutil.copytree(folder, tmp_path / "day")), outputs


@pytest.fixture
def rig(enrolled, monkeypatch):
    folder, _ = enrolled
    monkeypatch.chdir(folder)

    def run(*arguments: str):
        return CliRunner().invoke(app, list(arguments))

    return run


def test_enrollment_ends_with_similar_objects_and_a_report(enrolled):
    folder, outputs = enrolled
    assert "looks like no other enrolled object" in outputs["lamp"].stdout
    events = [json.loads(line) for line in outputs["dice"].stdout.splitlines()]
    assert events[-2].keys() == {"event", *(SimilarObjects.__dataclass_fields__)}
    assert events[-1]["event"] == "enrolled"
    page = (folder / "lamp.html").read_text(encoding="utf-8")
    assert "Contact sheet of lamp: 6 views" in page
    assert "Ring of 6 views by azimuth" in page
    assert "looks like" in page
    assert not re.search(r'(src|href)="(?!data:|#)', page)  # the page is self-contained


def in_json(done):
    return [json.loads(line) for line in done.stdout.splitlines()]


def test_identification_is_recorded_corrected_and_exported(rig, tmp_path):
    (first, *_) = in_json(rig("results", "list", "--json"))
    assert (first["object"], first["outcome"], first["sample"], first["bench"]) == ("dice", "found", None, "sim")
    with Catalog.open("catalog", clock=SystemClock(), read_only=True) as catalog:
        assert first["catalog_version"] == catalog.version()
    assert Path("catalog", first["image"]).is_file()
    shown = rig("results", "show", "1").stdout
    assert "dice, rotated" in shown
    wrong = rig("results", "correct", "1", "--object", "dise", "--reason", "label")
    assert wrong.exit_code == 7
    assert "did you mean 'dice'?" in wrong.stderr
    assert rig("results", "correct", "1", "--sample", "S-1", "--reason", "label \x1b[2J read").exit_code == 2
    corrected = rig("results", "correct", "1", "--sample", "S-1", "--reason", "label read")
    assert corrected.stdout == "Result 1 is now dice, sample S-1.\n"
    assert "label read" in rig("results", "show", "1").stdout
    assert "dice *" in rig("results", "list", "--sample", "S-1").stdout
    assert rig("results", "list", "--sample", "S-2").stdout == "No results match.\n"
    log = rig("log", "--object", "dice").stdout
    assert "identified" in log
    assert "result corrected" in log
    assert rig("results", "export", str(tmp_path / "a.csv"), "--object", "dice").exit_code == 0
    assert rig("results", "export", str(tmp_path / "a.txt")).exit_code == 2


def test_each_search_of_watch_asks_for_the_sample(enrolled, monkeypatch):
    monkeypatch.chdir(enrolled[0])
    command = ["identify", "--watch", "--scan", "--operator", "A. Silva", "--json", "--set", "bench.sim.object=dice"]
    done = CliRunner().invoke(app, command, input="S-1\nS\x1d2\nS-2\n\n")
    assert done.exit_code == 2  # the answers have ended
    events = in_json(done)
    assert [event["sample"] for event in events if event.get("event") == "recorded"] == ["S-1", "S-2", None]
    kinds = [event["event"] for event in events[:-1]]
    assert all(kinds[k + 1] == "recorded" for k, kind in enumerate(kinds) if kind == "identified")
    assert "cannot be printed" in done.stderr
    listed = in_json(CliRunner().invoke(app, ["results", "list", "--json", "--sample", "S-2"]))
    assert [one["operator"] for one in listed] == ["A. Silva"]


def test_sample_is_rejected_where_it_cannot_be_recorded(rig):
    assert rig("identify", "--sample", "S-1", "--watch").exit_code == 2
    assert rig("identify", "--sample", "S-1", "--set", "identify.record=none").exit_code == 2
    assert rig("identify", "--sample", " ").exit_code == 2


def earlier_version(root: Path) -> None:
    with closing(sqlite3.connect(root / "catalog.sqlite", isolation_level=None)) as connection:
        connection.executescript("DROP TABLE results; DROP TABLE corrections; PRAGMA user_version = 3")


def no_place_for_images(root: Path) -> None:
    (root / "images" / "results").write_text("in the way")


@pytest.mark.parametrize(
    ("spoil", "fix"), [(earlier_version, "rig catalog migrate"), (no_place_for_images, "check the folder")]
)
def test_answer_is_printed_even_if_it_cannot_be_recorded(rig, tmp_path, spoil, fix):
    shutil.copytree("catalog", tmp_path / "catalog", ignore=shutil.ignore_patterns("results"))
    spoil(tmp_path / "catalog")
    settings = ["--set", f"catalog.path={tmp_path / 'catalog'}", "--set", "bench.sim.object=dice"]
    done = rig("identify", "--sample", "S-1", *settings)
    assert done.exit_code == 0
    answer, warning = done.stdout.index("dice, rotated"), done.stdout.index("Warning: the answer is not recorded")
    assert answer < warning < done.stdout.index(fix)
    assert "Recorded" not in done.output


def test_training_set_is_exported_and_imported(rig, tmp_path):
    target = str(tmp_path / "set")
    words = ["export", target, "dice", "--format", "coco", "--split", "view", "--fractions", "0.5,0.5", "--json"]
    done = rig(*words)
    assert json.loads(done.stdout) == {
        "target": target,
        "format": "coco",
        "objects": 1,
        "views": {"train": 3, "val": 3},
        "without_mask": 0,
    }
    assert rig(*words).exit_code == 7
    imported = json.loads(rig("import", target, "--json", "--set", f"catalog.path={tmp_path / 'new'}").stdout)
    assert (imported["objects"], imported["views"], imported["rejected"]) == (1, 6, [])
    for wrong in (["--split", "colour"], ["--fractions", "a,b"], ["--fractions", "0.1,0.1"]):
        assert rig("export", f"{target}-2", "--format", "yolo", *wrong).exit_code == 2


def test_label_option_is_repeatable(rig):
    listed = json.loads(rig("catalog", "list", "--json").stdout)
    assert next(o["label"] for o in listed["objects"] if o["name"] == "lamp") == "kitchen, brass"


def test_saved_run_is_replayed_checked_and_reported(rig, enrolled):
    folder, outputs = enrolled
    replayed = rig("replay", "runs/1")
    assert replayed.exit_code == 0
    assert replayed.stdout.splitlines()[1:] == outputs["run"].stdout.splitlines()
    events = [json.loads(line) for line in rig("replay", "runs/1", "--json").stdout.splitlines()]
    assert (events[0]["event"], events[-1]["event"]) == ("started", "identified")
    checked = rig("replay", "runs/1", "--check")
    assert checked.exit_code == 0
    assert "All are as saved" in checked.stdout
    assert json.loads(rig("replay", "runs/1", "--check", "--json").stdout)["differences"] == []
    assert rig("report", "runs/1").exit_code == 0
    page = (folder / "runs" / "1" / "report.html").read_text(encoding="utf-8")
    assert "dice" in page
    assert "The camera’s path around the object" in page
    assert rig("report", "runs/1", "--out", "elsewhere.html", "--json").exit_code == 0
    assert Path("elsewhere.html").exists()


def test_replay_check_finds_a_changed_decision(rig, tmp_path):

    shutil.copytree("runs/1", tmp_path / "run")
    lines = (tmp_path / "run" / "events.jsonl").read_text().splitlines()
    for number, line in enumerate(lines):
        event = json.loads(line)
        if event["event"] == "decided":
            lines[number] = json.dumps(event | {"rotation_deg": -event["rotation_deg"]})
    (tmp_path / "run" / "events.jsonl").write_text("\n".join(lines) + "\n")
    done = rig("replay", str(tmp_path / "run"), "--check")
    assert done.exit_code == 6
    assert "Error 602 (replay mismatch)" in done.stderr
    assert "view 1, rotation_deg: saved -90.0, computed 90.0" in done.stderr


def test_replay_check_sums_differences_up(rig, tmp_path):
    shutil.copytree("runs/1", tmp_path / "run")
    text = (tmp_path / "run" / "events.jsonl").read_text()
    (tmp_path / "run" / "events.jsonl").write_text(text.replace('"score": 0.', '"score": 0.1'))
    run = str(tmp_path / "run")
    differences = json.loads(rig("replay", run, "--check", "--json").stdout)["evidence"]["differences"]
    count = len(differences)
    assert count > 3
    short = rig("replay", run, "--check").stderr
    assert f"{count} numbers in the saved run differ" in short
    assert short.count("    view ") == 3
    assert f"and {count - 3} more: --all" in short
    assert rig("replay", run, "--check", "--all").stderr.count("    view ") == count


def test_difference_of_long_values_is_cut():
    one = Difference(2, "candidates", ["mug-white"] * 50, 1)
    assert len(one.summary()) < 120
    assert str(one).count("mug-white") == 50


def test_missing_runs_and_existing_folders_are_rejected(rig):
    assert rig("replay", "nowhere").exit_code == 2
    assert rig("report", "nowhere").exit_code == 2
    again = rig("identify", "--save-run", "runs/1")
    assert again.exit_code == 2
    assert "not empty" in again.stderr


def test_failed_identification_is_saved_with_its_error(rig):
    done = rig("identify", "--save-run", "runs/dark", "--set", "view.min_mean=250", "--set", "view.retakes=0")
    assert done.exit_code == 6
    replayed = rig("replay", "runs/dark")
    assert replayed.exit_code == 0
    assert "Error 600 (view rejected)" in replayed.stdout
    assert rig("report", "runs/dark").exit_code == 0
    assert rig("replay", "runs/dark", "--check").exit_code == 0


@pytest.mark.parametrize("strategy", ["hbr", "ahbr", "sweep", "random"])
def test_every_strategy_finds_the_object(rig, strategy):
    done = rig(
        "identify", "--strategy", strategy, "--max-views", "3", "--top", "1", "--json", "--set", "bench.sim.object=lamp"
    )
    events = [json.loads(line) for line in done.stdout.splitlines()]
    assert events[0]["strategy"] == strategy
    assert (events[-2]["event"], events[-2]["name"]) == ("identified", "lamp")
    assert all(len(e["candidates"]) == 1 for e in events if e["event"] == "ranked")
    assert len([e for e in events if e["event"] == "accepted"]) == (3 if strategy == "hbr" else 2)


def test_dense_is_the_default_strategy(rig, enrolled):
    def searched(*words: str) -> tuple[list[dict], str]:
        done = rig("identify", "--json", "--set", "bench.sim.object=lamp", *words)
        return [json.loads(line) for line in done.stdout.splitlines() if "event" in line], done.stderr

    events, _ = searched("--top", "1", "--save-run", "runs/own")
    started, *_, answer, _ = (event for event in events if event["event"] != "empty_table_image")
    assert (started["strategy"], started["descriptor"], answer["name"]) == ("dense", "edges+colours", "lamp")
    assert 0.9 < answer["confidence"] <= 1
    assert answer["open_set_score"] >= answer["open_set_threshold"]
    assert started["notes"][0]["code"] == "rates-not-guaranteed"
    assert rig("replay", "runs/own", "--check").exit_code == 0
    assert rig("report", "runs/own").exit_code == 0
    page = (enrolled[0] / "runs" / "own" / "report.html").read_text(encoding="utf-8")
    assert ("What was weighed before each turn" in page) == any(e["event"] == "decided" for e in events)
    events, _ = searched("--set", "identify.strategy=ahbr")
    assert next(e for e in events if e["event"] == "started")["strategy"] == "ahbr"


def test_stopping_rule_is_calibrated_stored_and_used(rig, enrolled):
    reported = rig("catalog", "calibrate", "--false-reject", "0.1")
    assert reported.exit_code == 0, reported.output
    assert re.search(r"^\d+ leave-one-out searches of 4 views for 2 objects", reported.stdout)
    assert "Not guaranteed: An error rate of 1.0 % needs 100 leave-one-out searches" in reported.stdout
    kept = enrolled[0] / "catalog" / "search_rules.json"
    assert reported.stdout.rstrip().endswith(str(kept))
    values = json.loads(rig("catalog", "calibrate", "--json").stdout)
    assert values["false_reject"] == 0.02
    assert values["calibration"]["views"] == 4
    assert json.loads(kept.read_text(encoding="utf-8"))["searches"] == values["searches"]
    kept.write_text("{", encoding="utf-8")
    done = rig("identify", "--set", "bench.sim.object=lamp")
    assert done.exit_code == 0
    assert "to renew it: rig catalog calibrate" in done.stdout
    kept.unlink()


def test_catalog_without_dense_descriptors_is_searched_by_ahbr_with_a_note(enrolled, tmp_path, monkeypatch):

    from rig.catalog import Catalog
    from rig.catalog.seal import seal_enrollments
    from rig.core.clock import SystemClock

    shutil.copytree(enrolled[0] / "catalog", tmp_path / "catalog")
    (tmp_path / "rig.toml").write_text(SMALL, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    with Catalog.open("catalog", clock=SystemClock()) as catalog, catalog.database.write() as connection:
        connection.exec_driver_sql("DELETE FROM descriptors WHERE name != 'cedd'")
        seal_enrollments(connection, None)
    run = CliRunner().invoke
    done = run(app, ["identify", "--set", "bench.sim.object=lamp"])
    assert done.exit_code == 0, done.output
    assert "rig catalog redescribe --descriptor edges+colours" in done.stdout
    assert "S_left" in done.stdout or "fixed" in done.stdout
    for words in (["identify", "--strategy", "dense"], ["catalog", "calibrate"]):
        rejected = run(app, words)
        assert rejected.exit_code == 7
        assert "rig catalog redescribe --descriptor edges+colours" in rejected.stderr
    assert run(app, ["catalog", "redescribe", "--descriptor", "edges+colours"]).exit_code == 0
    again = run(app, ["identify", "--json", "--set", "bench.sim.object=lamp"])
    assert '"strategy": "dense"' in again.stdout


def test_unknown_strategy_is_rejected(rig):
    done = rig("identify", "--strategy", "swep")
    assert done.exit_code == 2
    assert "Did you mean sweep?" in done.stderr


def test_dry_run_shows_the_plan_and_stores_nothing(rig):
    before = sorted(Path("catalog").rglob("*.png"))
    done = rig("enroll", "clock", "--step", "60", "--dry-run")
    assert done.exit_code == 0
    assert "clock: enroll, 6 views, about" in done.stdout
    assert "Table angles: 0.0°, 60.0°, 120.0°, 180.0°, 240.0°, 300.0°" in done.stdout
    assert "600° of rotation" in done.stdout
    assert "not possible, it is already enrolled" in rig("enroll", "lamp", "--dry-run").stdout
    (planned,) = json.loads(rig("enroll", "lamp", "--replace", "--dry-run", "--json").stdout)["dry_run"]
    assert (planned["action"], planned["views"]) == ("replace", 6)
    assert sorted(Path("catalog").rglob("*.png")) == before


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("enroll",), "No object is given"),
        (("enroll", "clock", "--list", "x.csv"), "NAME and --list cannot be used together"),
        (("enroll", "clock", "--views", "8", "--step", "45"), "--views and --step cannot be used together"),
        (("enroll", "clock", "--step", "50"), "--views 7"),
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


def test_closed_pipe_ends_the_command_without_an_error(enrolled):
    folder, _ = enrolled
    command = (
        f"{sys.executable} -c 'from rig.cli.main import main; main()' identify | head -n 1; echo ${{PIPESTATUS[0]}}"
    )
    done = subprocess.run(["bash", "-c", command], cwd=folder, capture_output=True, text=True)
    assert done.stdout.splitlines()[-1] in ("0", "8", "141")  # it can end before head does
    assert "Traceback" not in done.stderr
    assert "Error" not in done.stderr


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


@pytest.fixture
def with_operator(monkeypatch):
    """Open the simulated bench without the operator that places objects; return its world."""
    opened = []
    really = SimBenchKind.open

    def open_without(self, config, options, seed):
        bench = really(self, config, options, seed)
        opened.append(bench.operator.world)
        bench.operator = ObjectAlreadyPlaced()
        return bench

    monkeypatch.setattr(SimBenchKind, "open", open_without)
    return opened


def test_operator_is_asked_for_each_object(rig, with_operator, tmp_path):
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


def test_watch_waits_until_the_camera_sees_an_object(rig, with_operator, monkeypatch):
    class Comes(TableWatcher):
        """Puts an object on the table while the command waits."""

        def place(self, name):
            (world,) = with_operator
            if self._empty is not None:
                raise KeyboardInterrupt
            world.clock.call_at(world.clock.now_ns() + 3 * 10**9, lambda: world.put(shelf()["lamp"], 33.0))
            super().place(name)

    monkeypatch.setattr("rig.views.object_presence.TableWatcher", Comes)
    done = rig("identify", "--watch", "--json")
    assert done.exit_code == 130
    events = [json.loads(line) for line in done.stdout.splitlines()]
    assert [e["name"] for e in events if e["event"] == "identified"] == ["lamp"]
    assert [e["reason"] for e in events if e["event"] == "waiting"] == [
        "first-object",
        "next-object",
    ]


def test_watch_finds_objects_that_were_enrolled_meanwhile(rig, enrolled):
    """The model is loaded again only if the catalog has changed."""
    folder, _ = enrolled
    with Catalog.open(folder / "catalog", clock=SystemClock(), read_only=True) as catalog:
        model = CurrentModel(catalog)
        before = model()
        assert model() is before
        assert rig("enroll", "amphora", "--views", "4").exit_code == 0
        assert "amphora" not in before.views.object_names
        assert "amphora" in model().views.object_names


def test_ambiguous_object_ends_with_exit_code_10(rig):
    assert rig("catalog", "calibrate").exit_code == 0
    path = Path("catalog/search_rules.json")
    before = path.read_text(encoding="utf-8")
    try:
        path.write_text(json.dumps(json.loads(before) | {"min_confidence": 1.5, "open_set_thresholds": [None] * 4}))
        words = ("identify", "--strategy", "dense", "--max-views", "2", "--set", "bench.sim.object=dice")
        done = rig(*words, "--json", "--save-run", "runs/ambiguous")
        answer = json.loads(done.stdout.splitlines()[-2])
        assert done.exit_code == EXIT_AMBIGUOUS
        assert (answer["outcome"], answer["name"]) == ("ambiguous", "dice")
        assert answer["possible"] == [one["name"] for one in answer["candidates"]]
        assert "\nAmbiguous: dice" in rig("replay", "runs/ambiguous").stdout
        assert rig("replay", "runs/ambiguous", "--check").exit_code == 0
        assert rig("report", "runs/ambiguous").exit_code == 0
        assert "Search: dice or " in Path("runs/ambiguous/report.html").read_text(encoding="utf-8")
    finally:
        path.unlink()
