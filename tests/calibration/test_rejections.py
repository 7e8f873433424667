"""Rejected calibrations on the bench: nothing of them is in force."""

import json

import pytest
from typer.testing import CliRunner

from calibration import camera_light, camera_model
from rig.calibrations import CalibrationStore, RejectionCode
from rig.cli.main import app


@pytest.fixture
def rig(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rig.toml").write_text('default_bench = "sim"\ncalibration_dir = "calibrations"\n', encoding="utf-8")
    monkeypatch.setattr(camera_model, "ANGLES_DEG", (-40.0, 0.0, 40.0))
    for other in (camera_light.CameraNoise, camera_light.CameraCard):
        monkeypatch.setattr(other, "measure", lambda *_: (event for event in ()))

    def run(*arguments: str):
        return CliRunner().invoke(app, list(arguments))

    return run


@pytest.mark.parametrize(
    ("stands", "arguments", "code"),
    [
        (1, ("--columns", "10", "--rows", "7"), RejectionCode.WRONG_BOARD_LAYOUT),
        (1, ("--columns", "6", "--rows", "4"), RejectionCode.FOREIGN_MARKERS),
        (4, ("--set", 'bench.sim.faults=["slip:angle=6@move5"]'), RejectionCode.BOARD_LOOSE),
    ],
    ids=["larger board", "smaller board", "moving table"],
)
def test_wrong_board_and_moving_table_are_rejected(rig, tmp_path, monkeypatch, stands, arguments, code):
    monkeypatch.setattr(camera_model, "STANDS", dict(list(camera_model.STANDS.items())[:stands]))
    done = rig("calibrate", "camera", *arguments)
    assert done.exit_code == 6, done.output
    (result,) = CalibrationStore(tmp_path / "calibrations" / "sim").history()
    assert code in [rejection.code for rejection in result.rejections]
    assert not result.settings
    (told,) = json.loads(rig("calibrate", "show", "--json").stdout)["calibrations"]
    assert told["state"] != "in force"
