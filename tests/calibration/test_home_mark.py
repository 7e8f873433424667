"""The home mark: its card shows the table's angle, and `rig home` needs only the revolution of the cable."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from calibration import camera_model
from calibration.home_mark import HomeMark
from calibration.procedure import Evaluation
from rig.calibrations import CalibrationResult, CalibrationStore
from rig.core.clock import SystemClock
from rig.safety.saved_state import FileStore
from rig.views.charuco_board import CharucoBoard, detect_board, mark_angle_deg
from sim.calibration_board import home_mark
from sim.optics import Optics

CARD = CharucoBoard(4, 3)


def intrinsics(optics: Optics) -> CalibrationResult:
    """Return the camera's calibration as true as it can be."""
    values = (*optics.focal_px, *optics.centre_px, *optics.distortion[:4])
    names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
    found = Evaluation(name=camera_model.NAME)
    for name, value in zip(names, values, strict=True):
        found.estimate(name, value, 0.01)
    return found.result(when_utc=SystemClock().utc())


def measured(s) -> CalibrationResult:
    *_, found = HomeMark(CARD).live(s.bench, intrinsics(s.operator.optics))
    return found


def test_card_shows_the_angle_from_all_sides_that_it_faces(simulated):
    s = simulated("camera.width=640", "camera.height=480", "view.roi=[80, 0, 480, 480]", seed=5)
    found = measured(s)
    assert found.passed, found.rejections
    assert abs(found.estimates["angle"].value) < 0.5
    mark = type(s.bench.config.mark)(**{key.removeprefix("mark."): value for key, value in found.settings.items()})
    for angle_deg in (-40.0, -7.0, 0.0, 12.0, 45.0, 400.0):
        image = s.bench.camera.capture(s.bench.clock.now_ns()).image_bgr.copy() * 0 + 90
        home_mark(s.operator.optics).draw(image, angle_deg)
        seen_deg = mark_angle_deg(detect_board(CARD, image), mark)
        assert seen_deg == pytest.approx((angle_deg + 180) % 360 - 180, abs=1.5)
    leaning = home_mark(s.operator.optics).put(tilt_deg=25.0)  # it was bumped
    image[:] = 90
    leaning.draw(image, 0.0)
    assert mark_angle_deg(detect_board(CARD, image), mark) is None


def test_home_after_a_power_loss_needs_only_the_revolution(rig, tmp_path, simulated):
    (tmp_path / "rig.toml").write_text('default_bench = "sim"\nstate_dir = "state"\ncalibration_dir = "calibrations"\n')
    s = simulated("camera.width=640", "camera.height=480", "view.roi=[80, 0, 480, 480]")
    CalibrationStore(Path("calibrations/sim")).add(replace(measured(s), when_utc=SystemClock().utc()))
    rig("goto", "35")
    store = FileStore(Path("state/sim"))
    kept = store.load()
    store.save(kept.model_copy(update={"table": kept.table.model_copy(update={"path_deg": (500.0, 600.0)})}))
    unseen = rig("home")
    assert unseen.exit_code == 5
    assert "does not see the home mark" in unseen.stderr
    assert "Rotate the table by hand" in " ".join(unseen.stderr.split())
    asked = rig("home", "--set", "bench.sim.mark=true")  # standard input has ended: no answer
    assert asked.exit_code == 2
    assert "wound up by 0 revolutions" in " ".join(asked.stderr.split())
    assert json.loads(rig("status", "--json").stdout)["state"] == "unreferenced"
    moved = rig("home", "--yes", "--json", "--set", "bench.sim.mark=true")
    assert moved.exit_code == 0, moved.stderr
    assert json.loads(moved.stdout.splitlines()[-1])["rotation_encoder_deg"] == pytest.approx(-35, abs=1.5)
    assert json.loads(rig("status", "--json").stdout)["state"] == "ready"
