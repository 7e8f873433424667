"""`rig calibrate imu` as its users call it."""

import json
import tomllib

import pytest
from typer.testing import CliRunner

from calibration.fact import Fact
from rig.cli.main import app


@pytest.fixture
def rig(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rig.toml").write_text('default_bench = "sim"\n', encoding="utf-8")

    def run(*arguments: str):
        return CliRunner().invoke(app, list(arguments))

    return run


def test_the_help_has_an_example_and_the_group_lists_the_procedure(rig):
    assert "Example: rig calibrate imu" in " ".join(rig("calibrate", "imu", "--help").output.split())
    assert "imu" in rig("calibrate", "--help").output


def test_the_lines_it_prints_work_in_the_configuration(rig, tmp_path):
    done = rig("calibrate", "imu", "--turns", "4", "--seed", "6", "--out", "scale.json")
    assert done.exit_code == 0, done.output
    assert done.stdout.count("by the gyro") == 5
    assert "PASS imu.scale = " in done.stdout
    lines = done.stdout[done.stdout.index("[imu]") :]
    fact = Fact.from_file(tmp_path / "scale.json")
    assert tomllib.loads(lines)["imu"]["scale"] == pytest.approx(fact.value, abs=1e-6)
    assert fact.device["bench"] == "sim"
    assert fact.device["imu"]["range_dps"] == 250
    with (tmp_path / "rig.toml").open("a", encoding="utf-8") as file:
        file.write(lines)
    told = json.loads(rig("goto", "90", "--seed", "6", "--json").stdout)
    assert told["agrees"] is True
    assert told["bound_deg"] < 1.5


def test_json_is_one_object_a_line_and_ends_with_the_fact(rig):
    done = rig("calibrate", "imu", "--turns", "4", "--seed", "6", "--json")
    *moves, fact = [json.loads(line) for line in done.stdout.splitlines()]
    assert {event["event"] for event in moves} == {"moved"}
    assert (fact["event"], fact["passed"], fact["refusals"]) == ("calibrated", True, [])
    assert fact["uncertainty"] < 1.5e-4


def test_a_failure_says_why_ends_with_6_and_leaves_the_old_file_alone(rig, tmp_path):
    (tmp_path / "scale.json").write_text("yesterday's", encoding="utf-8")
    done = rig("calibrate", "imu", "--turns", "4", "--set", "imu.axis=x", "--out", "scale.json")
    assert done.exit_code == 6
    assert "FAIL imu.scale" in done.stdout
    assert "imu.axis" in done.stdout
    assert (tmp_path / "scale.json").read_text(encoding="utf-8") == "yesterday's"


def test_too_few_turns_are_a_mistake_of_usage(rig):
    assert rig("calibrate", "imu", "--turns", "3").exit_code == 2
