"""Rejected calibrations on the bench: nothing of them is in force, and what cannot be measured moves nothing."""

import json

import pytest

from calibration import camera_model
from calibration.procedures import Backlash, Encoder, GyroRotation, GyroScale, ImuMounting
from rig.calibrations import CalibrationStore, RejectionCode
from rig.core.errors import LimitExceeded

PAN = 'table.mode="pan"'


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
    monkeypatch.setattr(camera_model, "ANGLES_DEG", (-40.0, 0.0, 40.0))
    monkeypatch.setattr(camera_model, "STANDS", dict(list(camera_model.STANDS.items())[:stands]))
    done = rig("calibrate", "camera", *arguments)
    assert done.exit_code == 6, done.output
    (result,) = CalibrationStore(tmp_path / "calibrations" / "sim").history()
    assert code in [rejection.code for rejection in result.rejections]
    assert not result.settings
    (reported,) = json.loads(rig("calibrate", "show", "--json").stdout)["calibrations"]
    assert reported["state"] != "in force"


@pytest.mark.parametrize(
    ("procedure", "settings"),
    [
        (Encoder(2), (PAN, "table.limits_deg=[-90, 90]")),
        (Backlash(24), (PAN, "table.limits_deg=[-20, 20]")),
        (ImuMounting(), (PAN, "table.limits_deg=[-90, 90]")),
        (GyroScale(8), ("table.limits_deg=[-180, 181]",)),
        (GyroRotation(10), (PAN, "table.limits_deg=[-20, 20]")),
    ],
)
def test_short_cable_is_rejected_before_moving(simulated, procedure, settings):
    s = simulated(*settings)
    with pytest.raises(LimitExceeded):
        next(procedure.live(s.bench))
    assert s.world.shaft()[0] == pytest.approx(0, abs=0.2)


@pytest.mark.parametrize(
    "words",
    [
        ("servo", "--revolutions", "0"),
        ("servo", "--reversals", "2"),
        ("imu", "--revolutions", "3"),
        ("imu", "--repeats", "3"),
        ("shaper", "--stops", "3"),
    ],
)
def test_too_few_moves_are_a_usage_error(rig, words):
    assert rig("calibrate", *words).exit_code == 2
