"""The simulated bench takes after the real one beside it."""

from math import sqrt

import pytest

from calibration.procedures import Backlash, GyroNoise
from sim.noise import NoiseModel, from_calibration


def test_noise_model_from_calibrations_equals_the_benchs(simulated):
    true = NoiseModel(backlash_deg=0.7, gyro_noise_dps_rthz=0.012, gyro_bias_walk_dps_rts=0.0)
    bench = simulated(noise=true, seed=5).bench
    results = [[*Backlash().live(bench)][-1], [*GyroNoise(minutes=5).live(bench)][-1]]
    assert all(result.passed for result in results)
    found = from_calibration(results)
    assert found.backlash_deg == pytest.approx(0.7, abs=0.05)
    assert found.gyro_noise_dps_rthz == pytest.approx(0.012, rel=0.1)
    assert found.vignetting == NoiseModel().vignetting, "what no result tells stays"
    assert found.gyro_bias_slope_dps_c == abs(results[1].estimates["bias_slope"].value)
    perfect = from_calibration([], NoiseModel.none())
    assert perfect == NoiseModel.none()
    assert sqrt(2) * results[1].estimates["angle_random_walk"].value == found.gyro_noise_dps_rthz
