"""Saved runs: kept in open formats, walked through again, and computed again to the same decisions."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

import hbr
from rig.catalog import Catalog
from rig.config import load_config
from rig.core.errors import UsageError
from rig.events.events import Accepted, Decided, Identified, Rejected, Started, event_dict
from rig.plans.enroll import enroll
from rig.plans.identify import identify
from rig.plans.photograph_table import photograph_table
from rig.search.model import load_model
from rig.search.replay import check
from rig.search.saved_run import RunWriter, event_of, load_run
from sim.bench import ShelfOperator, open_sim_bench
from sim.objects.shelf import shelf
from sim.world import World


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """Return the folders of runs by strategy, and the events that each run yielded."""
    home = tmp_path_factory.mktemp("runs")
    operator = ShelfOperator(World(seed=9), shelf())
    runs = {}
    small = ("camera.width=320", "camera.height=240", "view.roi=[40, 0, 240, 240]")
    settings = (*small, "identify.max_views=4", "identify.margin=0.9")  # every run takes all its views
    with (
        open_sim_bench(load_config(None, settings), operator) as bench,
        Catalog.open(home / "catalog", clock=bench.clock) as catalog,
    ):
        list(photograph_table(bench))
        for name in ("mug-white", "mug-star", "lamp"):
            list(enroll(bench, catalog, name, views=8))
        index = hbr.ViewIndex(catalog.views().views)
        for number, strategy in enumerate(("ahbr", "hbr", "sweep", "random")):
            operator.next_object, operator.yaw_deg = "mug-star", 40.0 * number
            with RunWriter(home / strategy, bench, index) as writer:
                events = []
                for event in identify(bench, index, strategy=strategy, seed=number, top=2):
                    writer.add(event)
                    events.append(event)
            runs[strategy] = home / strategy, events
        model = load_model(catalog)
        operator.next_object, operator.yaw_deg = "mug-star", 70.0
        with RunWriter(home / "dense", bench, model) as writer:
            events = []
            for event in identify(bench, model, top=2):
                writer.add(event)
                events.append(event)
        runs["dense"] = home / "dense", events
    return runs


def changed(saved, tmp_path: Path, line: int, **values: object) -> Path:
    """Return a copy of the first run in which an event says something else."""
    folder = tmp_path / "changed"
    shutil.copytree(saved["ahbr"][0], folder)
    lines = (folder / "events.jsonl").read_text().splitlines()
    lines[line] = json.dumps(json.loads(lines[line]) | values)
    (folder / "events.jsonl").write_text("\n".join(lines) + "\n")
    return folder


def place(saved, kind: type) -> int:
    """Return the number of the last event of a kind in the first run."""
    return max(i for i, event in enumerate(saved["ahbr"][1]) if isinstance(event, kind))


@pytest.mark.parametrize("strategy", ["ahbr", "hbr", "sweep", "random"])
def test_a_run_computed_again_decides_the_same(saved, strategy):
    folder, events = saved[strategy]
    found = check(load_run(folder))
    assert found.differences == []
    assert found.views == 4
    assert found.decisions == 4  # three turns and the answer
    assert isinstance(events[-1], Identified)


@pytest.mark.parametrize("strategy", ["ahbr", "random"])
def test_the_events_come_back_as_they_were(saved, strategy):
    folder, events = saved[strategy]
    again = list(load_run(folder).events())
    assert [event_dict(event) for event in again] == [event_dict(event) for event in events]
    for one, other in zip(events, again, strict=True):
        if isinstance(one, Accepted):
            assert isinstance(other, Accepted)
            assert (one.image_bgr == other.image_bgr).all()


def test_the_folder_is_open_formats(saved):
    folder, _ = saved["ahbr"]
    assert sorted(path.name for path in folder.iterdir()) == ["events.jsonl", "frames", "model.jsonl", "run.json"]
    assert [path.name for path in sorted((folder / "frames").iterdir())] == [f"{i:03d}.png" for i in range(4)]
    model = [json.loads(line) for line in (folder / "model.jsonl").read_text().splitlines()]
    assert [line["object"] for line in model] == ["mug-white", "mug-star", "lamp"]
    assert len(bytes.fromhex(model[0]["descriptors"][0])) == 54
    assert json.loads((folder / "run.json").read_text())["devices"]["servo"]["model"] == "xl430_w250"


def test_a_dense_search_is_computed_again_from_its_frames_rules_and_empty_table(saved, tmp_path):
    folder, events = saved["dense"]
    run = load_run(folder)
    found = check(run)
    assert found.differences == []
    assert found.views == found.decisions == len([e for e in events if isinstance(e, Accepted)])
    assert run.views.descriptor == events[0].descriptor == "edges+colours"
    assert run.model.rules is not None
    assert run.empty_table is not None
    assert all(e.segmentation["agreement"] > 0.9 for e in events if isinstance(e, Accepted))
    again = list(run.events())
    assert [event_dict(event) for event in again] == [event_dict(event) for event in events]
    for missing, words in (("empty_table.png", "segmentation.agreement"), ("search_rules.json", None)):
        other = tmp_path / missing
        shutil.copytree(folder, other)
        (other / missing).unlink()
        if words is None:
            with pytest.raises(UsageError, match="cannot be read"):
                load_run(other)
        else:
            assert words in {difference.what for difference in check(load_run(other)).differences}


def test_other_rules_decide_otherwise(saved, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(saved["dense"][0], folder)
    rules = json.loads((folder / "search_rules.json").read_text())
    (folder / "search_rules.json").write_text(json.dumps(rules | {"familiar": [2.0] * len(rules["familiar"])}))
    assert {"what", "verdict"} & {difference.what for difference in check(load_run(folder)).differences}


def test_a_run_of_the_first_format_is_read(saved, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(saved["ahbr"][0], folder)
    about = json.loads((folder / "run.json").read_text())
    (folder / "run.json").write_text(json.dumps(about | {"version": 1}))
    assert check(load_run(folder)).differences == []


def test_every_decision_says_why(saved):
    for strategy, words in (("ahbr", "S_left"), ("hbr", "at random"), ("sweep", "even steps"), ("random", "at random")):
        decided = [e for e in saved[strategy][1] if isinstance(e, Decided)]
        assert len(decided) == 3
        assert all(words in e.why for e in decided[1:])
    assert [e.rotation_deg for e in saved["sweep"][1] if isinstance(e, Decided)] == [90.0] * 3


def test_a_frame_that_was_changed_is_noticed(saved, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(saved["ahbr"][0], folder)
    frame = folder / "frames" / "002.png"
    image = cv2.imread(str(frame))
    assert image is not None
    cv2.imwrite(str(frame), image // 3)
    differences = check(load_run(folder)).differences
    assert differences
    assert all(d.view >= 3 for d in differences)


def test_a_decision_that_was_changed_is_noticed(saved, tmp_path):
    folder = changed(saved, tmp_path, place(saved, Decided), rotation_deg=12.0)
    (difference,) = check(load_run(folder)).differences
    assert (difference.view, difference.what, difference.saved) == (3, "rotation_deg", 12.0)


def test_an_answer_that_was_changed_is_noticed(saved, tmp_path):
    folder = changed(saved, tmp_path, place(saved, Identified), name="lamp")
    (difference,) = check(load_run(folder)).differences
    assert str(difference) == f"view 4, name: saved lamp, computed {saved['ahbr'][1][-1].name}"


def test_a_run_that_was_cut_off_is_read_as_far_as_it_goes(saved, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(saved["ahbr"][0], folder)
    path = folder / "events.jsonl"
    whole = path.read_bytes()
    for length in (len(whole) // 3, len(whole) // 2, len(whole) - 5):
        path.write_bytes(whole[:length])
        run = load_run(folder)
        kept = whole[:length].count(b"\n")
        assert len(list(run.events())) == kept
        assert check(run).differences == []


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("run.json", b"{", "cannot be read"),
        ("run.json", b"[]", "cannot be read"),
        ("run.json", b'{"format": "other"}', "cannot be read"),
        ("run.json", b'{"format": "hbr-rig run", "version": 99}', "version 99"),
        ("model.jsonl", b'{"object": "a", "azimuth_deg": [0], "descriptors": ["00"]}\n', "cannot be read"),
        ("events.jsonl", b"\xff\xfe\n", "cannot be read"),
        ("events.jsonl", b'{"event": "exploded"}\n', "cannot be read"),
        ("events.jsonl", b'{"event": "started", "plan": 3, "name": null, "views": 4, "conditions": {}}\n', "cannot"),
        ("frames/001.png", b"no picture", "cannot be read"),
    ],
)
def test_a_damaged_run_is_refused_in_words(saved, tmp_path, name, content, words):
    folder = tmp_path / "run"
    shutil.copytree(saved["ahbr"][0], folder)
    (folder / name).write_bytes(content)
    with pytest.raises(UsageError) as caught:
        check(load_run(folder))
    assert words in str(caught.value)
    assert caught.value.next_step


def test_what_is_no_run_or_taken_already_is_said(saved, tmp_path, simulated):
    with pytest.raises(UsageError, match="no saved run"):
        load_run(tmp_path)
    folder, _ = saved["ahbr"]
    bench = simulated().bench
    with pytest.raises(UsageError, match="not empty"):
        RunWriter(folder, bench, hbr.ViewIndex(hbr.Views.empty()))
    with pytest.raises(UsageError, match="cannot be saved"):
        RunWriter(Path("/proc/run"), bench, hbr.ViewIndex(hbr.Views.empty()))


def test_a_number_that_was_not_finite_comes_back_as_unknown(saved):
    accepted = next(e for e in saved["ahbr"][1] if isinstance(e, Accepted))
    values = event_dict(Rejected(0, 1, ("gyro",), accepted.evidence))
    values["evidence"]["stillness"]["peak_rate_dps"] = None
    again = event_of(values, None)
    assert isinstance(again, Rejected)
    assert np.isnan(again.evidence.stillness.peak_rate_dps)
    assert isinstance(event_of({**event_dict(saved["ahbr"][1][0]), "newer": 1}, None), Started)
