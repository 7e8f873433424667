"""`rig replay` and `rig report` on saved runs."""

import json
import shutil
from pathlib import Path


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
    assert f"and {count - 3} more: --json" in short
    assert rig("replay", run, "--check", "--json").stderr.count("    view ") == count


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
