"""docs/how-to/add-a-calibration.md"""

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from rig.calibrations import RejectionCode
from tests.docs.pages import blocks, run


@pytest.fixture(scope="module")
def page():
    return run("\n".join(blocks("add-a-calibration")))


def test_new_calibration_measures_on_the_simulated_bench(page, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    app = typer.Typer()
    app.command("step-time")(page["step_time"])
    done = CliRunner().invoke(app, ["--bench", "sim"])
    assert done.exit_code == 0, done.output
    assert "servo.step_time" in done.output
    assert len(list(tmp_path.rglob("*-servo.step_time-*.json"))) == 1


def test_new_calibration_states_its_uncertainty_and_rejects_an_obstructed_rotation(page):
    rng = np.random.default_rng(1)
    found = [page["evaluate"](0.9 + rng.normal(0, 0.01, 10)).estimates["duration"] for _ in range(200)]
    deviations = np.array([(estimate.value - 0.9) / estimate.uncertainty for estimate in found])
    assert 0.9 < deviations.std() < 1.4
    (rejection,) = page["evaluate"]([0.9] * 9 + [1.9]).rejections
    assert rejection.code is RejectionCode.MOVE_HINDERED
