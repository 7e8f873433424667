"""What spoils a calibration on the bench: each is refused with its reason, and nothing of it is in force."""

import json

import pytest
from typer.testing import CliRunner

from calibration import camera_light, camera_model
from rig.calibrations import CalibrationStore
from rig.cli.main import app


@pytest.fixture
def rig(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rig.toml").write_text('default_bench = "sim"\ncalibration_dir = "facts"\n', encoding="utf-8")
    monkeypatch.setattr(camera_model, "ANGLES_DEG", (-40.0, 0.0, 40.0))
    for other in ("live_scene", "live_card"):
        monkeypatch.setattr(camera_light, other, lambda _: (event for event in ()))

    def run(*arguments: str):
        return CliRunner().invoke(app, list(arguments))

    return run


@pytest.mark.parametrize(
    ("stands", "arguments", "reason"),
    [
        (1, ("--columns", "10", "--rows", "7"), "not where a board of 10 columns and 7 rows has them"),
        (1, ("--columns", "6", "--rows", "4"), "that are not on a board of 6 columns and 4 rows"),
        (4, ("--set", 'bench.sim.faults=["slip:angle=6@move5"]'), "the table moves while it is looked at"),
    ],
    ids=["larger board", "smaller board", "moving table"],
)
def test_it_is_refused_with_the_reason_and_nothing_is_in_force(rig, tmp_path, monkeypatch, stands, arguments, reason):
    monkeypatch.setattr(camera_model, "STANDS", dict(list(camera_model.STANDS.items())[:stands]))
    done = rig("calibrate", "camera", *arguments)
    assert done.exit_code == 6, done.output
    assert reason in done.stdout
    (fact,) = CalibrationStore(tmp_path / "facts" / "sim").history()
    assert not fact.passed
    assert not fact.settings
    (told,) = json.loads(rig("calibrate", "show", "--json").stdout)["calibrations"]
    assert told["state"] != "in force"
