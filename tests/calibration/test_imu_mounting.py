"""Tilt, level and delay of the IMU on the platter."""

from math import degrees

import numpy as np
import pytest

from calibration.imu_mounting import ImuMounting, evaluate
from calibration.procedure import Evaluation
from rig.calibrations import RejectionCode
from tests.calibration.drawn import AXIS, codes, in_sigmas, measured


def fit(moves, levels, *, column=2, sign=1) -> Evaluation:
    return evaluate(moves, levels, column=column, sign=sign)


def test_noiseless_data_are_fitted_exactly():
    estimates = fit(*measured(table_axis_deg=(1.0, -0.5))).estimates
    for name, true in {
        "tilt_x": degrees(AXIS[0]),
        "tilt_y": degrees(AXIS[1]),
        "accel_zero_x": 0.01,
        "accel_zero_y": -0.02,
        "accel_zero_z": 0.03,
        "axis_x": 1.0,
        "axis_y": -0.5,
        "delay": 0.002,
    }.items():
        assert estimates[name].value == pytest.approx(true, abs=1e-6), name


@pytest.mark.parametrize("sensors", [1, pytest.param(5, marks=pytest.mark.nightly)])
def test_simulated_sensor_lies_within_the_stated_uncertainty(simulated, sensors):
    z = []
    for seed in range(sensors):
        s = simulated(seed=seed)
        servo, imu = s.bench.servo, s.bench.imu
        *_, result = ImuMounting().live(s.bench)
        assert result.passed, result.rejections
        assert (s.bench.servo, s.bench.imu) == (servo, imu), "a recorder is left on the bench"
        part = s.operator.devices.imu.inertial
        z += in_sigmas(result, **{f"accel_zero_{name}": part.accel_bias_g[i] for i, name in enumerate("xyz")})
        z += in_sigmas(result, **{f"tilt_{name}": degrees(part.up[i]) for i, name in enumerate("xy")})
        z += in_sigmas(result, axis_x=0.0, axis_y=0.0)
        # The servo reads its encoder 2.0 ms before the middle of a transaction at 57,600 baud; the low-pass of 42 Hz
        # and the dating by whole samples make the gyro 2.8 ms late.
        delay = result.estimates["delay"]
        assert delay.value == pytest.approx(0.8e-3, abs=3 * delay.uncertainty)
    assert np.sqrt(np.mean(np.square(z))) < 1.5
    assert (np.abs(z) < 1.96).mean() >= 0.85


@pytest.mark.parametrize(
    ("axis", "expected"),
    [
        ((0.0, 0.3, 0.95), "tilted by 17.5°"),
        ((0.0, 0.0, -1.0), 'imu.axis = "z" and imu.sign = -1'),
        ((-1.0, 0.0, 0.05), 'imu.axis = "x" and imu.sign = -1'),
    ],
)
def test_wrong_mounting_is_rejected(axis, expected):
    axis = np.array(axis) / np.linalg.norm(axis)
    (rejection,) = fit(*measured(axis)).rejections
    assert expected in str(rejection)


def test_slanting_table_and_lost_samples_are_rejected():
    moves, levels = measured(table_axis_deg=(7.0, 0.0))
    assert codes(fit(moves, levels)) == [RejectionCode.NOT_LEVEL]
    assert codes(fit(moves[:3], levels)) == [RejectionCode.TOO_FEW_RECORDED_MOVES]
