"""The gyro at rest: Allan deviation, noise and slope found within what is stated, and disturbances refused."""

from datetime import UTC, datetime
from math import sqrt

import numpy as np
import pytest

from calibration.gyro_noise import Rest, allan, from_data, live, rotation_sigma_deg
from rig.calibrations import CalibrationResult
from rig.core.errors import UsageError

ARW, WALK, SLOPE = 0.0035, 0.0003, 0.02
WHEN = datetime(2026, 3, 1, tzinfo=UTC)


def drawn(rng: np.random.Generator, minutes: float = 20.0, *, warm_up_c: float = 5.0) -> Rest:
    n = round(minutes * 60)
    temperature_c = 25 + warm_up_c * (1 - np.exp(-np.arange(n) / 300))
    walk = np.cumsum(rng.standard_normal((n, 3)), axis=0) * WALK
    rate = 3.0 + ARW * rng.standard_normal((n, 3)) + walk + SLOPE * (temperature_c - 25)[:, None]
    return Rest(rate, temperature_c, 1.0)


def fit(rest: Rest) -> CalibrationResult:
    return from_data(rest, column=2, when_utc=WHEN, device={})


def test_the_allan_deviation_is_the_one_of_its_definition():
    rate = np.random.default_rng(1).standard_normal(64)
    taus, deviation, _ = allan(rate, 0.5)
    for tau, found in zip(taus, deviation, strict=True):
        m = round(tau / 0.5)
        means = np.array([rate[i : i + m].mean() for i in range(64 - m + 1)])
        pairs = [(means[i + m] - means[i]) ** 2 for i in range(64 - 2 * m + 1)]
        assert found == pytest.approx(sqrt(np.mean(pairs) / 2))


def test_the_truth_lies_within_the_stated_uncertainty():
    truth = {"angle_random_walk": ARW, "rate_random_walk": WALK, "bias_slope": SLOPE}
    facts = [fit(drawn(np.random.default_rng(seed))) for seed in range(24)]
    for name, true in truth.items():
        z = np.array([(f.estimates[name].value - true) / f.estimates[name].uncertainty for f in facts])
        assert (np.abs(z) < 1.96).mean() >= 0.83, name
        assert 0.6 < np.sqrt((z**2).mean()) < 1.5, name
    assert all(fact.passed for fact in facts)


def test_without_a_change_of_temperature_no_slope_is_claimed():
    fact = fit(drawn(np.random.default_rng(3), warm_up_c=0.0))
    assert "bias_slope" not in fact.estimates
    assert "angle_random_walk" in fact.estimates


def test_a_bump_lost_samples_and_a_shaking_bench_are_refused():
    rest = drawn(np.random.default_rng(4))
    bumped = rest.gyro_dps.copy()
    bumped[600] += 0.3
    assert "After 600 s the rate jumped by 0." in fit(Rest(bumped, rest.temperature_c, 1.0)).refusals[0]
    assert "lost 7 samples" in fit(Rest(rest.gyro_dps, rest.temperature_c, 1.0, lost=7)).refusals[0]
    shaken = rest.gyro_dps + 0.05 * np.random.default_rng(5).standard_normal(rest.gyro_dps.shape)
    assert "shakes" in fit(Rest(shaken, rest.temperature_c, 1.0)).refusals[0]


def test_on_the_simulated_bench(simulated):
    s = simulated(seed=2)
    *progress, fact = live(s.bench, minutes=6)
    assert [p.share for p in progress] == sorted(p.share for p in progress)
    assert progress[-1].share == 1.0
    assert fact.passed, fact.refusals
    noise = s.world.noise
    for name, true in (
        ("angle_random_walk", noise.gyro_noise_dps_rthz / sqrt(2)),
        ("bias_slope", float(s.operator.parts.imu.inertial.gyro_slope_dps_c[2])),
    ):
        estimate = fact.estimates[name]
        assert abs(estimate.value - true) < 3 * estimate.uncertainty, name
    assert rotation_sigma_deg(fact, 4.0) == pytest.approx(2 * fact.estimates["angle_random_walk"].value, rel=0.1)


def test_too_short_a_rest_is_a_mistake_of_usage(simulated):
    with pytest.raises(UsageError, match="too few"):
        next(live(simulated().bench, minutes=1))
