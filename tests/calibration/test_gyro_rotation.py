"""The uncertainty of a measured rotation, verified by repeated rotations."""

import numpy as np
import pytest

from calibration.gyro_rotation import SPEEDS, GyroRotation, TimedLeg, evaluate
from calibration.procedure import Evaluation
from rig.calibrations import RejectionCode
from rig.core.errors import LimitExceeded, UsageError
from sim.noise import NoiseModel
from tests.calibration.drawn import moves
from tests.calibration.rejected import codes


def evaluated(some: list[TimedLeg]) -> Evaluation:
    return evaluate(some, resolution_deg=1e-6)


def test_true_sigma_passes_and_its_ratio_covers_one():
    results = [evaluated(moves(seed)) for seed in range(100)]
    assert all(result.passed for result in results)
    z = [
        (result.estimates[f"ratio_{speed}"].value - 1) / result.estimates[f"ratio_{speed}"].uncertainty
        for result in results
        for speed in SPEEDS
    ]
    assert 0.85 < np.mean(np.abs(z) < 1.96) <= 1.0


def test_too_much_and_too_little_scatter_are_rejected():
    for seed in range(20):
        assert codes(evaluated(moves(seed, true=2.5)))[0] is RejectionCode.SCATTER_TOO_LARGE
        assert codes(evaluated(moves(seed, true=0.1)))[0] is RejectionCode.SCATTER_TOO_SMALL


def test_rejection_names_the_speed_that_shakes_the_bench():
    some = [m if m.speed != "medium" else shaken for m, shaken in zip(moves(0), moves(0, true=4.0), strict=True)]
    (rejection,) = evaluated(some).rejections
    assert rejection.values["speed"] == "medium"


def test_lost_samples_are_rejected():
    result = evaluated(moves(0, invalid="samples were lost"))
    assert result.rejections[0].code is RejectionCode.TOO_FEW_MOVES
    assert "samples were lost" in str(result.rejections[0])
    assert not result.estimates


@pytest.mark.nightly
def test_simulated_sigma_is_true(simulated):
    s = simulated(seed=3)
    speed_before = s.bench.config.table.velocity_dps
    *_, result = GyroRotation(repeats=4).live(s.bench)
    assert s.bench.config.table.velocity_dps == speed_before
    assert result.passed, result.rejections
    by_duration = result.evidence["by_duration"]
    assert [row["stated_deg"] for row in by_duration] == sorted(row["stated_deg"] for row in by_duration)
    assert by_duration[-1]["seconds"] > 5 * by_duration[0]["seconds"]


@pytest.mark.nightly
def test_noisy_encoder_is_rejected(simulated):
    s = simulated(noise=NoiseModel(encoder_noise_deg=0.25), seed=3)
    *_, result = GyroRotation(repeats=4).live(s.bench)
    assert RejectionCode.SCATTER_TOO_LARGE in codes(result)


def test_too_few_repeats_and_short_cable_are_rejected_before_moving(simulated):
    with pytest.raises(UsageError, match="too few"):
        next(GyroRotation(repeats=3).live(simulated().bench))
    with pytest.raises(LimitExceeded):
        next(GyroRotation(10).live(simulated("table.limits_deg=[-20, 20]", 'table.mode="pan"').bench))
