"""The play of the gears: found with an honest uncertainty, and what is no play refused with the reason."""

from datetime import UTC, datetime

import numpy as np
import pytest

from calibration.backlash import from_data, live
from calibration.legs import Leg
from rig.calibrations import CalibrationResult
from rig.core.errors import LimitExceeded, UsageError
from rig.events.events import Moved
from sim.noise import NoiseModel

COUNT_DEG = 360 / 4096


def fit(legs: list[Leg]) -> CalibrationResult:
    return from_data(legs, resolution_deg=COUNT_DEG, when_utc=datetime(2026, 3, 1, tzinfo=UTC), device={})


def drawn(rng: np.random.Generator, play_deg: float = 0.3, *, ratio: float = 1.01, reversals: int = 24) -> list[Leg]:
    """Return legs as a bench measures them: rests anywhere in a count, shared by neighbours, and a gyro with noise."""
    lengths = np.where(np.arange(reversals) // 2 % 2 == 0, 6.0, 60.0)
    stops = np.where(np.arange(reversals + 1) % 2 == 0, 0.0, 1.0) * np.append(0.0, lengths)
    rests = stops + rng.uniform(-COUNT_DEG / 2, COUNT_DEG / 2, reversals + 1)
    read = np.round(rests / COUNT_DEG) * COUNT_DEG
    shaft = np.diff(rests)
    gyro = (shaft - play_deg * np.sign(shaft)) / ratio + rng.normal(0.0, 0.01, reversals)
    return [Leg(float(e), float(g), 0.01) for e, g in zip(np.diff(read), gyro, strict=True)]


def run(s, *, during=None) -> CalibrationResult:
    for event in live(s.bench):
        if isinstance(event, Moved) and during and (happens := during.get(event.index)):
            happens()
    assert isinstance(event, CalibrationResult)
    return event


def test_the_truth_lies_within_the_stated_uncertainty():
    rng = np.random.default_rng(1)
    plays = rng.uniform(0.0, 1.0, 200)
    found = [fit(drawn(rng, play)).estimates["backlash"] for play in plays]
    z = np.array([(e.value - play) / e.uncertainty for e, play in zip(found, plays, strict=True)])
    assert 0.85 < z.std() < 1.15
    assert abs(z.mean()) < 0.2


def test_the_play_of_the_simulated_gears_is_found_to_a_few_hundredths_of_a_degree(simulated):
    for seed, play_deg in enumerate([0.0, 0.1, 0.45, 1.2]):
        s = simulated("table.limits_deg=[-200, 200]", noise=NoiseModel(backlash_deg=play_deg), seed=seed)
        fact = run(s)
        assert fact.passed, fact.refusals
        assert fact.estimates["backlash"].value == pytest.approx(play_deg, abs=0.04)
        assert fact.estimates["backlash"].uncertainty < 0.03
        assert fact.settings["table.backlash_deg"] >= fact.estimates["backlash"].value
        assert abs(s.world.table_deg()) < 2.0, "back where it was"
        assert s.bench.config.table.approach_deg == 3.0


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda leg: Leg(leg.encoder_deg, -leg.gyro_deg, leg.sigma_deg), "table.direction"),
        (lambda leg: Leg(leg.encoder_deg, leg.gyro_deg / 3, leg.sigma_deg), "servo.gear_ratio to 3.0"),
        (lambda leg: Leg(leg.encoder_deg, leg.gyro_deg - np.sign(leg.encoder_deg) * 4, leg.sigma_deg), "is loose"),
        (lambda leg: Leg(leg.encoder_deg, leg.gyro_deg + np.sign(leg.encoder_deg), leg.sigma_deg), "negative"),
        (lambda leg: Leg(leg.encoder_deg, leg.gyro_deg, 0.3), "give more --reversals"),
        (lambda leg: Leg(leg.encoder_deg, leg.gyro_deg, leg.sigma_deg, "the sensor lost 3 samples"), "lost 3 samples"),
    ],
)
def test_what_is_no_play_is_refused_with_the_reason(change, reason):
    fact = fit([change(leg) for leg in drawn(np.random.default_rng(2))])
    assert any(reason in refusal for refusal in fact.refusals), fact.refusals
    assert not fact.settings


def test_a_platter_that_slips_once_is_refused(simulated):
    s = simulated(seed=3)
    fact = run(s, during={9: lambda: s.world.slip(0.8, 0.2)})
    assert any("slipped or was touched" in refusal for refusal in fact.refusals)


def test_a_cable_too_short_and_too_few_reversals_are_told_before_anything_moves(simulated):
    s = simulated('table.mode="pan"', "table.limits_deg=[-20, 20]")
    with pytest.raises(LimitExceeded):
        next(live(s.bench))
    with pytest.raises(UsageError):
        next(live(s.bench, reversals=2))
    assert abs(s.world.table_deg()) < 1.0
