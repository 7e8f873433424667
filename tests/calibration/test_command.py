"""`rig calibrate imu` as its users call it."""

import json

import pytest
from typer.testing import CliRunner

from rig.cli.main import app
from rig.facts import Fact


@pytest.fixture
def rig(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rig.toml").write_text('default_bench = "sim"\ncalibration_dir = "facts"\n', encoding="utf-8")

    def run(*arguments: str):
        return CliRunner().invoke(app, list(arguments))

    return run


def test_the_help_has_an_example_and_the_group_lists_the_procedure(rig):
    assert "Example: rig calibrate imu" in " ".join(rig("calibrate", "imu", "--help").output.split())
    assert "imu" in rig("calibrate", "--help").output


def test_what_passed_is_kept_and_in_force_from_then_on(rig, tmp_path):
    done = rig("calibrate", "imu", "--turns", "4", "--minutes", "3", "--seed", "6")
    assert done.exit_code == 0, done.output
    paths = sorted((tmp_path / "facts" / "sim").iterdir())
    facts = [Fact.from_file(path) for path in paths]
    assert [fact.name for fact in facts] == ["imu.scale", "imu.mounting", "imu.noise"]
    for path, fact in zip(paths, facts, strict=True):
        assert f"PASS {fact.name}" in done.stdout
        assert path.name in "".join(done.stdout.split())
    assert facts[0].device["imu"]["range_dps"] == 250
    told = json.loads(rig("goto", "90", "--seed", "6", "--json").stdout)
    assert told["agrees"] is True
    assert told["bound_deg"] < 1.5
    other = json.loads(rig("goto", "90", "--seed", "7", "--json").stdout)
    assert other["bound_deg"] > 1.5, "another world has another gyro"


def test_json_is_one_object_a_line_and_ends_with_the_fact(rig):
    done = rig("calibrate", "imu", "--turns", "4", "--minutes", "3", "--seed", "6", "--json")
    events = [json.loads(line) for line in done.stdout.splitlines()]
    assert {event["event"] for event in events} == {"moved", "progress", "calibrated"}
    scale, *_, noise = [event for event in events if event["event"] == "calibrated"]
    assert (scale["passed"], scale["refusals"]) == (True, [])
    assert scale["estimates"]["scale"]["uncertainty"] < 1.5e-4
    assert noise == events[-1]


def test_a_failure_says_why_ends_with_6_and_leaves_what_is_in_force(rig, tmp_path):
    assert rig("calibrate", "imu", "--turns", "4", "--minutes", "3").exit_code == 0
    done = rig("calibrate", "imu", "--turns", "4", "--set", "imu.axis=x")
    assert done.exit_code == 6
    assert "FAIL imu.scale" in done.stdout
    assert "imu.axis" in done.stdout
    passed = [Fact.from_file(path).passed for path in sorted((tmp_path / "facts" / "sim").iterdir())]
    assert passed == [True, True, True, False]
    assert json.loads(rig("goto", "90", "--json").stdout)["bound_deg"] < 1.5


def test_too_few_turns_are_a_mistake_of_usage(rig):
    assert rig("calibrate", "imu", "--turns", "3").exit_code == 2


def test_the_servo_is_calibrated_in_a_row_and_each_result_counts_for_the_next(rig, tmp_path):
    done = rig("calibrate", "servo", "--reversals", "8", "--turns", "1", "--rounds", "2")
    assert done.exit_code == 0, done.output
    facts = [Fact.from_file(path) for path in sorted((tmp_path / "facts" / "sim").iterdir())]
    assert [fact.name for fact in facts] == ["servo.backlash", "servo.encoder", "servo.motion"]
    again = rig("calibrate", "servo", "--reversals", "8", "--turns", "1", "--rounds", "2")
    assert again.exit_code == 0, "a newer result takes the place of an older one"
    assert "of the configuration wins" not in again.output


def test_what_is_in_force_and_what_was_kept_can_be_looked_up(rig):
    assert "Nothing is calibrated yet" in rig("calibrate", "show").output
    assert "No calibration of imu.scale was kept" in rig("calibrate", "history", "imu.scale").output
    rig("calibrate", "imu", "--turns", "4", "--set", "imu.axis=x")
    assert "imu.scale never passed" in rig("calibrate", "show").output
    rig("calibrate", "imu", "--turns", "4", "--minutes", "3")
    assert "✓ imu.scale was calibrated 0 days ago" in rig("calibrate", "show").output
    assert "conditions.seed was 0, is 9" in rig("calibrate", "show", "--seed", "9").output
    failed, passed = rig("calibrate", "history", "imu.scale").output.splitlines()
    assert "FAIL" in failed
    assert "scale " in passed
    told = json.loads(rig("calibrate", "history", "--json").stdout)
    assert [fact["name"] for fact in told["calibrations"]] == ["imu.scale", "imu.scale", "imu.mounting", "imu.noise"]
