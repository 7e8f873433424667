"""A tray of objects, enrolled with two interruptions in real processes and then identified."""

import json
import signal
from pathlib import Path
from typing import Any

import pytest

from rig.catalog import Catalog
from rig.core.clock import SystemClock
from rig.search.replay import check
from rig.search.saved_run import load_run
from sim.objects.shelf import CONFUSABLE, shelf
from tests.programs import Program, stopping_after_view

VIEWS = 6
NAMES = [name for name in shelf() if name not in {twin for _, twin in CONFUSABLE}][:5]
SMALL = f"""\
default_bench = "sim"
[catalog]
path = "catalog"
[camera]
width = 320
height = 240
[view]
roi = [40, 0, 240, 240]
[enroll]
views = {VIEWS}
"""


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "rig.toml").write_text(SMALL, encoding="utf-8")
    lines = [
        "name,label,note",
        *(f'{name},tray 1,"object {number}, of the shelf"' for number, name in enumerate(NAMES)),
    ]
    (tmp_path / "tray.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return tmp_path


def enroll_until(folder: Path, views: int, number: int | None) -> tuple[list[dict[str, Any]], int, str]:
    """Enroll the tray and send a signal after a number of views; return the events, the exit code and stderr."""
    process = Program("enroll", "--list", "tray.csv", "--json", code=stopping_after_view(views), folder=folder)
    if number is not None:
        process.wait_until_stopped()
        process.send_signal(number)
        process.send_signal(signal.SIGCONT)
    output, errors = process.communicate()
    return [json.loads(line) for line in output.splitlines()], process.wait(), errors


def of_kind(events: list[dict[str, Any]], kind: str) -> list[dict[str, Any]]:
    return [event for event in events if event["event"] == kind]


@pytest.mark.timeout(300)  # four processes in a row, on a busy machine
def test_tray_is_enrolled_with_two_interruptions_and_identified(folder):
    first, code, errors = enroll_until(folder, 2 * VIEWS + 3, signal.SIGINT)
    assert code == 130
    assert "rig enroll --list tray.csv" in errors
    second, code, _ = enroll_until(folder, 2 * VIEWS + 2, signal.SIGKILL)
    assert code == -signal.SIGKILL
    third, code, errors = enroll_until(folder, 0, None)
    assert code == 0, errors

    done_at_first = [event["name"] for event in of_kind(first, "enrolled")]
    assert done_at_first == NAMES[:2]
    again = of_kind(second, "item")
    assert [(e["name"], e["action"]) for e in again[:3]] == [
        *((name, "skip") for name in NAMES[:2]),
        (NAMES[2], "resume"),
    ]
    last = of_kind(third, "item")
    assert [e["name"] for e in last] == NAMES
    killed = next(e for e in last if e["action"] != "skip")
    assert killed["action"] == "resume"
    assert killed["name"] == again[-1]["name"]

    # No view was taken twice and none is missing; a signal loses at most the view that was being taken.
    taken = sum(len(of_kind(events, "accepted")) for events in (first, second, third))
    assert len(NAMES) * VIEWS - 4 <= taken <= len(NAMES) * VIEWS
    with Catalog.open(folder / "catalog", clock=SystemClock(), read_only=True) as catalog:
        assert {(s.name, s.label, s.views, s.unfinished_views) for s in catalog.objects()} == {
            (name, "tray 1", VIEWS, None) for name in NAMES
        }
        for name in NAMES[2], killed["name"]:
            details = catalog.object(name)
            assert [view.index for view in details.views] == list(range(VIEWS))
            assert len({view.session for view in details.views}) == 2
            for view in details.views:
                catalog.read_image(view.image)  # raises if it is not the stored image

    things = f"bench.sim.object={json.dumps(NAMES)}"
    words = ("identify", "--watch", "--save-run", "runs", "--seed", "3", "--json")
    process = Program(*words, "--set", things, folder=folder)
    answers = []
    for event in map(json.loads, process.stdout):
        if event["event"] == "identified":
            answers.append(event["name"])
            if len(answers) == len(NAMES):
                process.send_signal(signal.SIGINT)
                break
    process.communicate()
    assert process.wait() == 130
    assert answers == NAMES

    runs = sorted((folder / "runs").iterdir())
    assert [path.name for path in runs[: len(NAMES)]] == [f"{number:04d}" for number in range(1, len(NAMES) + 1)]
    for path in runs[: len(NAMES) : 4]:
        found = check(load_run(path))
        assert found.differences == []
        assert found.decisions == found.views >= 1  # one decision after each view; one view can be enough
