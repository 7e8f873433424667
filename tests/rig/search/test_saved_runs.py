"""Saved runs: stored in open formats, read, and computed again to the same decisions."""

import json
import os
import shutil
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

import hbr
from hbr.dense import stopping
from rig.cli.main import app
from rig.core.errors import UsageError
from rig.events.events import (
    Accepted,
    Decided,
    Identified,
    Ranked,
    Started,
    event_dict,
)
from rig.search.model import model_of
from rig.search.replay import check
from rig.search.saved_run import load_run, save_run
from rig.views.description import BENCH_DESCRIPTOR
from tests.rig.search.run_samples import saved_runs


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        for least in ("MIN_CONFIDENCE", "LAST_CONFIDENCE"):
            patch.setattr(stopping, least, 1.0)  # no search is sure
        yield saved_runs(tmp_path_factory.mktemp("runs"))


def changed(saved, tmp_path: Path, line: int, **values: object) -> Path:
    """Return a copy of the first run with a changed event."""
    folder = tmp_path / "changed"
    shutil.copytree(saved["ahbr"][0], folder)
    lines = (folder / "events.jsonl").read_text().splitlines()
    lines[line] = json.dumps(json.loads(lines[line]) | values)
    (folder / "events.jsonl").write_text("\n".join(lines) + "\n")
    return folder


def place(saved, kind: type) -> int:
    """Return the number of the last event of a kind in the first run."""
    return max(i for i, event in enumerate(saved["ahbr"][1]) if isinstance(event, kind))


def test_saved_run_has_open_formats(saved):
    folder, _ = saved["ahbr"]
    assert sorted(path.name for path in folder.iterdir()) == ["events.jsonl", "frames", "model.jsonl", "run.json"]
    assert [path.name for path in sorted((folder / "frames").iterdir())] == [f"{i:03d}.png" for i in range(4)]
    model = [json.loads(line) for line in (folder / "model.jsonl").read_text().splitlines()]
    assert [line["object"] for line in model] == ["mug-white", "mug-star", "lamp"]
    assert len(bytes.fromhex(model[0]["descriptors"][0])) == 54
    assert json.loads((folder / "run.json").read_text())["devices"]["servo"]["model"] == "xl430_w250"


def test_dense_search_is_computed_again_from_its_folder(saved, tmp_path):
    folder, events = saved["dense"]
    run = load_run(folder)
    found = check(run)
    assert found.differences == []
    assert found.views == found.decisions == len([e for e in events if isinstance(e, Accepted)])
    assert run.views.descriptor == events[0].descriptor == BENCH_DESCRIPTOR
    assert run.model.is_dense
    assert run.empty_table is not None
    assert all(e.segmentation["agreement"] > 0.9 for e in events if isinstance(e, Accepted))
    again = list(run.events())
    assert [event_dict(event) for event in again] == [event_dict(event) for event in events]
    other = shutil.copytree(folder, tmp_path / "without")
    (other / "empty_table.png").unlink()
    assert "segmentation.agreement" in {difference.what for difference in check(load_run(other)).differences}


def test_replay_reports_a_changed_frame(saved, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(saved["ahbr"][0], folder)
    frame = folder / "frames" / "002.png"
    image = cv2.imread(str(frame))
    assert image is not None
    cv2.imwrite(str(frame), image // 3)
    differences = check(load_run(folder)).differences
    assert differences
    assert all(d.view >= 3 for d in differences)


def test_replay_reports_a_changed_decision(saved, tmp_path):
    folder = changed(saved, tmp_path, place(saved, Decided), rotation_deg=12.0)
    (difference,) = check(load_run(folder)).differences
    assert (difference.view, difference.what, difference.saved) == (3, "rotation_deg", 12.0)


def test_interrupted_run_is_read_to_its_last_event(saved, tmp_path):
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
        ("run.json", b'{"format": "other"}', "run.json: format: "),
        ("run.json", b'{"format": "hbr-rig run", "version": 99}', "version 99"),
        ("model.jsonl", b'{"object": "a", "azimuth_deg": [0], "descriptors": ["00"]}\n', "cannot be read"),
        ("events.jsonl", b"\xff\xfe\n", "cannot be read"),
        ("events.jsonl", b'{"code": 1}\n', "the error at the end of events.jsonl: title: "),
        ("events.jsonl", b'{"event": "exploded"}\n', "cannot be read"),
        ("events.jsonl", b'{"event": "started", "plan": 3, "name": null, "views": 4, "conditions": {}}\n', "cannot"),
        ("frames/001.png", b"no picture", "cannot be read"),
    ],
)
def test_damaged_run_is_rejected(saved, tmp_path, name, content, words):
    folder = tmp_path / "run"
    shutil.copytree(saved["ahbr"][0], folder)
    (folder / name).write_bytes(content)
    with pytest.raises(UsageError) as caught:
        check(load_run(folder))
    assert words in f"{caught.value} {caught.value.evidence}"
    assert caught.value.next_step


def spoiled(saved, tmp_path: Path, strategy: str = "ahbr") -> Path:
    """Return a copy of a run."""
    return Path(shutil.copytree(saved[strategy][0], tmp_path / "spoiled"))


def png(width: int, height: int) -> bytes:
    return cv2.imencode(".png", np.zeros((height, width, 3), np.uint8))[1].tobytes()


def huge_png(side: int) -> bytes:
    """Return a PNG whose header promises more pixels than the file has."""
    content = bytearray(png(4, 4))
    content[16:24] = struct.pack(">II", side, side)
    content[29:33] = struct.pack(">I", zlib.crc32(content[12:29]))
    return bytes(content)


@pytest.mark.parametrize("frame", [b"", png(1, 1), png(320, 1), png(239, 239), huge_png(60_000), huge_png(19_000)])
@pytest.mark.parametrize(("strategy", "name"), [("ahbr", "frames/000.png"), ("dense", "empty_table.png")])
def test_frame_of_another_size_is_reported_as_damage(saved, tmp_path, frame, strategy, name):
    folder = spoiled(saved, tmp_path, strategy)
    (folder / name).write_bytes(frame)
    try:
        assert check(load_run(folder)).differences
    except UsageError as error:
        assert error.next_step  # noqa: PT017


SPOILED_EVENTS = {
    "negative seed": (Started, {"seed": -1}),
    "seed of text": (Started, {"seed": "1"}),
    "azimuth unknown": (Accepted, {"azimuth_deg": None}),
    "azimuth beyond numbers": (Accepted, {"azimuth_deg": 10**400}),
    "azimuth is true": (Accepted, {"azimuth_deg": True}),
    "index is a path": (Accepted, {"index": "../../frames/000"}),
    "evidence is a list": (Accepted, {"evidence": []}),
    "no candidates": (Identified, {"candidates": []}),
    "candidates of lists": (Ranked, {"candidates": [[]]}),
    "candidates is a number": (Ranked, {"candidates": 3}),
    "conditions is a list": (Started, {"strategy": []}),
}


@pytest.mark.parametrize(("kind", "values"), SPOILED_EVENTS.values(), ids=SPOILED_EVENTS)
def test_invalid_event_is_reported_as_damage(saved, tmp_path, kind, values):
    with pytest.raises(UsageError) as caught:
        check(load_run(changed(saved, tmp_path, place(saved, kind), **values)))
    assert caught.value.evidence["reason"]
    assert "Error" not in caught.value.evidence["reason"]


@pytest.mark.parametrize("name", ["run.json", "model.jsonl", "events.jsonl"])
@pytest.mark.parametrize(
    "content", [b"[]\n", b"3\n", b"null\n", b"[" * 100_000, b'{"event": NaN}\n', b"9" * 5000 + b"\n"]
)
def test_json_of_another_kind_is_damage(saved, tmp_path, name, content):
    folder = spoiled(saved, tmp_path)
    (folder / name).write_bytes(content)
    try:
        assert not check(load_run(folder)).is_complete
    except UsageError as error:
        assert error.evidence["reason"]  # noqa: PT017
        assert "Error" not in error.evidence["reason"]  # noqa: PT017


def test_run_opens_no_file_outside_its_folder(saved, tmp_path):
    folder = spoiled(saved, tmp_path)
    secret = tmp_path / "secret.png"
    shutil.copy(folder / "frames/000.png", secret)
    (folder / "frames/000.png").unlink()
    (folder / "frames/000.png").symlink_to(secret)
    with pytest.raises(UsageError) as caught:
        check(load_run(folder))
    assert "outside" in caught.value.evidence["reason"]
    (folder / "frames/000.png").unlink()
    os.mkfifo(folder / "frames/000.png")
    with pytest.raises(UsageError) as caught:
        check(load_run(folder))
    assert "not a regular file" in caught.value.evidence["reason"]


def test_descriptor_of_a_run_opens_no_file(saved, tmp_path):
    folder = spoiled(saved, tmp_path)
    about = json.loads((folder / "run.json").read_text())
    os.mkfifo(tmp_path / "pipe")
    for name in (str(tmp_path / "pipe"), "/dev/zero"):
        about["descriptor"] = {"name": name, "version": 1}
        (folder / "run.json").write_text(json.dumps(about))
        with pytest.raises(UsageError) as caught:
            load_run(folder)
        assert "is unknown" in caught.value.evidence["reason"]


def test_name_with_a_line_separator_is_read_again(saved, tmp_path):
    folder = spoiled(saved, tmp_path)
    for name in ("model.jsonl", "events.jsonl"):
        text = (folder / name).read_text(encoding="utf-8").replace("mug-star", "mug\u2028star")
        (folder / name).write_text(text, encoding="utf-8")
    found = check(load_run(folder))
    assert (found.differences, found.is_complete) == ([], True)


def test_replay_reports_a_run_without_its_end(saved, tmp_path):
    folder = spoiled(saved, tmp_path)
    assert check(load_run(folder)).is_complete
    events = folder / "events.jsonl"
    whole = events.read_bytes()
    lines = whole.splitlines(keepends=True)
    for content in (whole[:-1], whole[:-20], b"".join(lines[:-1]), whole + b'{"event"', lines[0]):
        events.write_bytes(content)
        found = check(load_run(folder))
        assert (found.differences, found.is_complete) == ([], False)
        done = CliRunner().invoke(app, ["replay", str(folder), "--check"])
        assert done.exit_code == 6, done.output
        assert "Error 604" in done.stderr
    events.write_bytes(whole + json.dumps({"code": 1, "title": "a", "detail": "b", "steps": []}).encode() + b"\n")
    assert load_run(folder).error is not None


def test_folder_without_a_run_or_not_empty_is_rejected(saved, tmp_path, simulated):
    with pytest.raises(UsageError, match="no saved run"):
        load_run(tmp_path)
    folder, _ = saved["ahbr"]
    bench = simulated().bench
    for wrong, words in ((folder, "not empty"), (Path("/proc/run"), "cannot be saved")):
        with pytest.raises(UsageError, match=words), save_run(wrong, bench, model_of(hbr.Views.empty())):
            pass
