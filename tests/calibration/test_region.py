"""The region of interest follows the object: on a bench whose camera was moved, from calibration to identification."""

import json
from pathlib import Path

import pytest

from calibration import camera_model, table_axis
from rig.bench import open_bench
from rig.calibrations import CalibrationStore
from rig.config import load_config

MOVED = "bench.sim.noise={camera_mount=1.0}"
BEFORE = [80, 0, 480, 480]


@pytest.fixture
def rig(rig, monkeypatch):
    # Fewer sides: other tests show what the procedures find.
    monkeypatch.setattr(camera_model, "ANGLES_DEG", camera_model.ANGLES_DEG[::3])
    monkeypatch.setattr(table_axis, "ANGLES_DEG", table_axis.ANGLES_DEG[::4])
    return lambda *words, seed=2: rig(*words, "--seed", seed, "--set", MOVED)


def region(rig, name: str) -> list[int]:
    """Return the region that the object's first view is described within."""
    reported = json.loads(rig("catalog", "show", name, "--json").stdout)
    return reported["views"][0]["region"]


@pytest.mark.nightly
def test_region_follows_the_object_after_the_camera_moved(rig):
    assert rig("enroll", "mug-star", "--views", "4").exit_code == 0
    assert region(rig, "mug-star") == BEFORE
    config = load_config(Path("rig.toml"), [MOVED])
    with open_bench("sim", config, seed=2) as bench:  # the axis needs the camera's calibration
        *_, intrinsics = camera_model.CameraModel().live(bench)
    CalibrationStore(config.calibration_path("sim")).add(intrinsics)
    done = rig("calibrate", "table", "--lens-mm", "490")
    assert done.exit_code == 0, done.output
    assert "if it was moved" in " ".join(done.stderr.split()).lower(), "what is enrolled already"
    assert "its middle 75 mm above the platter" in done.stderr
    (result,) = json.loads(rig("calibrate", "history", "table.axis", "--json").stdout)["calibrations"]
    follows = result["settings"]["view.roi"]
    x, _, width, _ = follows
    assert x + width / 2 == pytest.approx(result["estimates"]["px"]["value"], abs=12), "it holds the axis in its middle"

    note = " ".join(rig("enroll", "mug-dots", "--views", "8").stderr.split())
    assert region(rig, "mug-dots") == follows
    assert f"enrolled with view.roi = {BEFORE}; now it is {follows} (axis calibration)" in note
    assert f"rig config set view.roi '{BEFORE}'" in note
    assert "--replace" in note
    assert rig("enroll", "mug-star", "--views", "4", "--replace").exit_code == 0
    found = rig("identify", "--set", "bench.sim.object=mug-dots", "--json")
    assert "enrolled with view.roi" not in found.stderr
    assert json.loads(found.stdout.splitlines()[-2])["name"] == "mug-dots"

    assert f"    sets view.roi = {follows}" in rig("calibrate", "show").stdout
    written = rig("identify", "--set", "bench.sim.object=mug-dots", "--set", f"view.roi={BEFORE}").stderr
    assert "of the configuration takes precedence over" in written
    assert f"enrolled with view.roi = {follows}; now it is {BEFORE}" in " ".join(written.split())
    other = rig("identify", "--set", "bench.sim.object=mug-dots", seed=3).stderr
    assert "table.axis was calibrated on another device: conditions.seed was 2, is 3" in " ".join(other.split())

    taller = rig("calibrate", "table", "--height-mm", "120")
    assert taller.exit_code == 0, taller.output
    assert "enrolled with view.roi" not in rig("identify").stderr, (
        "regions that followed the objects then and follow them now"
    )
