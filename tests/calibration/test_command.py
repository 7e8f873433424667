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
    done = rig("calibrate", "imu", "--turns", "4", "--seed", "6")
    assert done.exit_code == 0, done.output
    assert done.stdout.count("by the gyro") == 5
    assert "PASS imu.scale" in done.stdout
    (path,) = (tmp_path / "facts" / "sim").iterdir()
    assert path.name in "".join(done.stdout.split())
    assert Fact.from_file(path).device["imu"]["range_dps"] == 250
    told = json.loads(rig("goto", "90", "--seed", "6", "--json").stdout)
    assert told["agrees"] is True
    assert told["bound_deg"] < 1.5
    other = json.loads(rig("goto", "90", "--seed", "7", "--json").stdout)
    assert other["bound_deg"] > 1.5, "another world has another gyro"


def test_json_is_one_object_a_line_and_ends_with_the_fact(rig):
    done = rig("calibrate", "imu", "--turns", "4", "--seed", "6", "--json")
    *moves, fact = [json.loads(line) for line in done.stdout.splitlines()]
    assert {event["event"] for event in moves} == {"moved"}
    assert (fact["event"], fact["passed"], fact["refusals"]) == ("calibrated", True, [])
    assert fact["estimates"]["scale"]["uncertainty"] < 1.5e-4


def test_a_failure_says_why_ends_with_6_and_leaves_what_is_in_force(rig, tmp_path):
    assert rig("calibrate", "imu", "--turns", "4").exit_code == 0
    done = rig("calibrate", "imu", "--turns", "4", "--set", "imu.axis=x")
    assert done.exit_code == 6
    assert "FAIL imu.scale" in done.stdout
    assert "imu.axis" in done.stdout
    passed = [Fact.from_file(path).passed for path in sorted((tmp_path / "facts" / "sim").iterdir())]
    assert passed == [True, False]
    assert json.loads(rig("goto", "90", "--json").stdout)["bound_deg"] < 1.5


def test_too_few_turns_are_a_mistake_of_usage(rig):
    assert rig("calibrate", "imu", "--turns", "3").exit_code == 2
