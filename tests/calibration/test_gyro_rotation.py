"""Whether the σ of a measured rotation is true, by repeated moves."""

from datetime import UTC, datetime

import numpy as np
import pytest

from calibration.gyro_rotation import SPEEDS, Timed, from_data, live
from calibration.legs import Leg
from rig.calibrations import CalibrationResult
from rig.core.errors import LimitExceeded, UsageError
from sim.noise import NoiseModel

WHEN = datetime(2026, 3, 1, tzinfo=UTC)


def moves(seed: int, *, true: float = 1.0, repeats: int = 10, play_deg: float = 0.4, trouble: str = "") -> list[Timed]:
    """Return moves whose scatter is ``true`` times the stated σ, with a play and a scale that no mean may mistake."""
    rng = np.random.default_rng(seed)
    made = []
    for number, speed in enumerate(SPEEDS):
        for index in range(2 * repeats):
            way = 1 - 2 * (index % 2)
            sigma = 0.02 * 3.0**number
            gyro = way * 60 / 1.03 - way * play_deg + true * sigma * float(rng.standard_normal())
            made.append(Timed(speed, 1.7 * 3.0**number, Leg(way * 60.0, gyro, sigma, trouble)))
    return made


def fitted(some: list[Timed]) -> CalibrationResult:
    return from_data(some, resolution_deg=1e-6, when_utc=WHEN, device={})


def test_a_true_sigma_passes_and_its_ratio_covers_one():
    facts = [fitted(moves(seed)) for seed in range(100)]
    assert all(fact.passed for fact in facts)
    z = [
        (fact.estimates[f"ratio_{speed}"].value - 1) / fact.estimates[f"ratio_{speed}"].uncertainty
        for fact in facts
        for speed in SPEEDS
    ]
    assert 0.85 < np.mean(np.abs(z) < 1.96) <= 1.0


def test_more_scatter_than_stated_is_refused_and_so_is_far_less():
    for seed in range(20):
        assert "scatter by" in fitted(moves(seed, true=2.5)).refusals[0]
        assert "stated too large" in fitted(moves(seed, true=0.1)).refusals[0]


def test_one_speed_that_shakes_the_bench_is_named():
    some = [m if m.speed != "medium" else shaken for m, shaken in zip(moves(0), moves(0, true=4.0), strict=True)]
    (refusal,) = fitted(some).refusals
    assert "Rotations of 5.1 s" in refusal


def test_a_gyro_that_lost_its_rotations_is_refused():
    fact = fitted(moves(0, trouble="samples were lost"))
    assert "samples were lost" in fact.refusals[0]
    assert not fact.estimates


def test_the_simulated_bench_states_its_sigma_truly(simulated):
    s = simulated(seed=3)
    *_, fact = live(s.bench, repeats=4)
    assert fact.passed, fact.refusals
    by_duration = fact.evidence["by_duration"]
    assert [row["stated_deg"] for row in by_duration] == sorted(row["stated_deg"] for row in by_duration)
    assert by_duration[-1]["seconds"] > 5 * by_duration[0]["seconds"]


def test_an_encoder_that_flutters_is_refused(simulated):
    s = simulated(noise=NoiseModel(encoder_noise_deg=0.25), seed=3)
    speed_before = s.bench.config.table.velocity_dps
    *_, fact = live(s.bench, repeats=4)
    assert any("times what is stated" in refusal for refusal in fact.refusals)
    assert s.bench.config.table.velocity_dps == speed_before


def test_too_few_repeats_and_too_short_a_cable_are_told_before_anything_moves(simulated):
    with pytest.raises(UsageError, match="too few"):
        next(live(simulated().bench, repeats=3))
    with pytest.raises(LimitExceeded):
        next(live(simulated("table.limits_deg=[-20, 20]", 'table.mode="pan"').bench))
