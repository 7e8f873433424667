"""The backlash of the gears: true within its uncertainty; other errors are rejected."""

from dataclasses import replace

import numpy as np
import pytest

from calibration.backlash import Backlash, evaluate
from calibration.legs import Leg
from calibration.procedure import Evaluation
from rig.calibrations import RejectionCode
from rig.events.events import Moved
from sim.noise import NoiseModel
from tests.calibration.drawn import COUNT_DEG, codes, in_sigmas, rests


def fit(legs: list[Leg]) -> Evaluation:
    return evaluate(legs, resolution_deg=COUNT_DEG)


def drawn(seed: int, backlash_deg: float = 0.3) -> list[Leg]:
    """Return 24 legs as a bench measures them, with a ratio of 1.01."""
    rng = np.random.default_rng(seed)
    lengths_deg = np.where(np.arange(25) % 2 == 0, 0.0, np.where((np.arange(25) - 1) // 2 % 2 == 0, 6.0, 60.0))
    true, read = rests(rng, lengths_deg)
    shaft = np.diff(true)
    gyro = (shaft - backlash_deg * np.sign(shaft)) / 1.01 + rng.normal(0.0, 0.01, 24)
    return [Leg(float(e), float(g), 0.01) for e, g in zip(np.diff(read), gyro, strict=True)]


def test_true_values_lie_within_the_stated_uncertainty():
    backlashes = np.random.default_rng(1).uniform(0.0, 1.0, 200).tolist()
    z = [in_sigmas(fit(drawn(seed, true)), backlash=true)[0] for seed, true in enumerate(backlashes)]
    assert 0.85 < np.std(z) < 1.15
    assert abs(np.mean(z)) < 0.2


@pytest.mark.parametrize("backlash_deg", [0.45, *(pytest.param(n, marks=pytest.mark.nightly) for n in (0.0, 0.1, 1.2))])
def test_simulated_backlash_is_found_to_hundredths_of_a_degree(simulated, backlash_deg):
    s = simulated("table.limits_deg=[-200, 200]", noise=NoiseModel(backlash_deg=backlash_deg), seed=1)
    *_, result = Backlash(24).live(s.bench)
    assert result.passed, result.rejections
    assert result.estimates["backlash"].value == pytest.approx(backlash_deg, abs=0.04)
    assert result.estimates["backlash"].uncertainty < 0.03
    assert result.settings["table.backlash_deg"] >= result.estimates["backlash"].value
    assert abs(s.world.table_deg()) < 2.0, "the table returned"
    assert s.bench.config.table.approach_deg == 3.0


@pytest.mark.parametrize(
    ("change", "code"),
    [
        (lambda leg: {"gyro_deg": -leg.gyro_deg}, RejectionCode.WRONG_DIRECTION),
        (lambda leg: {"gyro_deg": leg.gyro_deg / 3}, RejectionCode.WRONG_GEAR_RATIO),
        (lambda leg: {"gyro_deg": leg.gyro_deg - 4 * np.sign(leg.encoder_deg)}, RejectionCode.BACKLASH_TOO_LARGE),
        (lambda leg: {"gyro_deg": leg.gyro_deg + np.sign(leg.encoder_deg)}, RejectionCode.BACKLASH_NEGATIVE),
        (lambda _: {"sigma_deg": 0.3}, RejectionCode.BACKLASH_UNCERTAIN),
        (lambda _: {"invalid": "the sensor lost 3 samples"}, RejectionCode.TOO_FEW_REVERSALS),
    ],
)
def test_wrong_legs_are_rejected(change, code):
    result = fit([replace(leg, **change(leg)) for leg in drawn(2)])
    assert code in codes(result)
    assert not result.settings


def test_slipping_platter_is_rejected(simulated):
    s = simulated(seed=3)
    for event in Backlash(10).live(s.bench):
        if isinstance(event, Moved) and event.index == 9:
            s.world.slip(0.8, 0.2)
    assert RejectionCode.LEG_SLIPPED in codes(event)
