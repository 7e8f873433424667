"""The gyro at rest: Allan deviation, noise and slope are true within their uncertainty; disturbances are rejected."""

from math import sqrt

import numpy as np
import pytest

from calibration.gyro_noise import GyroNoise, RestRecord, allan, evaluate
from calibration.procedure import Evaluation
from rig.calibrations import RejectionCode
from rig.core.errors import UsageError
from tests.calibration.rejected import codes

ARW, WALK, SLOPE = 0.0035, 0.0003, 0.02


def drawn(rng: np.random.Generator, minutes: float = 20.0, *, warm_up_c: float = 5.0) -> RestRecord:
    n = round(minutes * 60)
    temperature_c = 25 + warm_up_c * (1 - np.exp(-np.arange(n) / 300))
    walk = np.cumsum(rng.standard_normal((n, 3)), axis=0) * WALK
    rate = 3.0 + ARW * rng.standard_normal((n, 3)) + walk + SLOPE * (temperature_c - 25)[:, None]
    return RestRecord(rate, temperature_c, 1.0)


def fit(rest: RestRecord) -> Evaluation:
    return evaluate(rest, column=2)


def test_allan_deviation_matches_its_definition():
    rate = np.random.default_rng(1).standard_normal(64)
    taus, deviation, _ = allan(rate, 0.5)
    for tau, found in zip(taus, deviation, strict=True):
        m = round(tau / 0.5)
        means = np.array([rate[i : i + m].mean() for i in range(64 - m + 1)])
        pairs = [(means[i + m] - means[i]) ** 2 for i in range(64 - 2 * m + 1)]
        assert found == pytest.approx(sqrt(np.mean(pairs) / 2))


def test_true_values_lie_within_the_stated_uncertainty():
    truth = {"angle_random_walk": ARW, "rate_random_walk": WALK, "bias_slope": SLOPE}
    results = [fit(drawn(np.random.default_rng(seed))) for seed in range(24)]
    for name, true in truth.items():
        z = np.array([(f.estimates[name].value - true) / f.estimates[name].uncertainty for f in results])
        assert (np.abs(z) < 1.96).mean() >= 0.83, name
        assert 0.6 < np.sqrt((z**2).mean()) < 1.5, name
    assert all(result.passed for result in results)


def test_constant_temperature_yields_no_slope():
    result = fit(drawn(np.random.default_rng(3), warm_up_c=0.0))
    assert "bias_slope" not in result.estimates
    assert "angle_random_walk" in result.estimates


def test_bump_lost_samples_and_shaking_bench_are_rejected():
    rest = drawn(np.random.default_rng(4))
    bumped = rest.gyro_dps.copy()
    bumped[600] += 0.3
    (jump,) = fit(RestRecord(bumped, rest.temperature_c, 1.0)).rejections
    assert (jump.code, jump.values["at_s"]) == (RejectionCode.RATE_JUMPED, 600)
    assert codes(fit(RestRecord(rest.gyro_dps, rest.temperature_c, 1.0, lost=7))) == [RejectionCode.SAMPLES_LOST]
    shaken = rest.gyro_dps + 0.05 * np.random.default_rng(5).standard_normal(rest.gyro_dps.shape)
    assert RejectionCode.GYRO_NOISY in codes(fit(RestRecord(shaken, rest.temperature_c, 1.0)))


def test_simulated_noise_is_found(simulated):
    s = simulated(seed=2)
    *progress, result = GyroNoise(minutes=6).live(s.bench)
    assert [p.share for p in progress] == sorted(p.share for p in progress)
    assert progress[-1].share == 1.0
    assert result.passed, result.rejections
    noise = s.world.noise
    for name, true in (
        ("angle_random_walk", noise.gyro_noise_dps_rthz / sqrt(2)),
        ("bias_slope", float(s.operator.devices.imu.inertial.gyro_slope_dps_c[2])),
    ):
        estimate = result.estimates[name]
        assert abs(estimate.value - true) < 3 * estimate.uncertainty, name


def test_short_recording_is_a_usage_error(simulated):
    with pytest.raises(UsageError, match="too few"):
        next(GyroNoise(minutes=1).live(simulated().bench))
