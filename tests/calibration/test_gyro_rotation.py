"""The uncertainty of a measured rotation, verified by repeated rotations."""

import numpy as np
import pytest

from calibration.gyro_rotation import SPEEDS, GyroRotation, TimedLeg, evaluate
from calibration.procedure import Evaluation
from rig.calibrations import RejectionCode
from sim.noise import NoiseModel
from tests.calibration.drawn import codes, in_sigmas, moves


def evaluated(some: list[TimedLeg]) -> Evaluation:
    return evaluate(some, resolution_deg=1e-6)


def test_true_sigma_passes_and_its_ratio_covers_one():
    results = [evaluated(moves(seed)) for seed in range(100)]
    assert all(result.passed for result in results)
    z = [in_sigmas(result, **dict.fromkeys((f"ratio_{speed}" for speed in SPEEDS), 1.0)) for result in results]
    assert 0.85 < np.mean(np.abs(z) < 1.96) <= 1.0


def test_too_much_and_too_little_scatter_are_rejected():
    for seed in range(20):
        assert codes(evaluated(moves(seed, true=2.5)))[0] is RejectionCode.SCATTER_TOO_LARGE
        assert codes(evaluated(moves(seed, true=0.1)))[0] is RejectionCode.SCATTER_TOO_SMALL
    some = [m if m.speed != "medium" else shaken for m, shaken in zip(moves(0), moves(0, true=4.0), strict=True)]
    (rejection,) = evaluated(some).rejections
    assert rejection.values["speed"] == "medium"


def test_lost_samples_are_rejected():
    result = evaluated(moves(0, invalid="samples were lost"))
    assert result.rejections[0].code is RejectionCode.TOO_FEW_MOVES
    assert "samples were lost" in str(result.rejections[0])
    assert not result.estimates


@pytest.mark.nightly
def test_simulated_sigma_is_true_and_a_noisy_encoder_is_rejected(simulated):
    s = simulated(seed=3)
    speed_before = s.bench.config.table.velocity_dps
    *_, result = GyroRotation(repeats=4).live(s.bench)
    assert s.bench.config.table.velocity_dps == speed_before
    assert result.passed, result.rejections
    by_duration = result.evidence["by_duration"]
    assert [row["stated_deg"] for row in by_duration] == sorted(row["stated_deg"] for row in by_duration)
    assert by_duration[-1]["seconds"] > 5 * by_duration[0]["seconds"]
    *_, noisy = GyroRotation(repeats=4).live(simulated(noise=NoiseModel(encoder_noise_deg=0.18), seed=3).bench)
    assert RejectionCode.SCATTER_TOO_LARGE in codes(noisy)
