"""The backlash of the gears: true within its uncertainty; other errors are rejected."""

import numpy as np
import pytest

from calibration.backlash import Backlash, evaluate
from calibration.legs import Leg
from calibration.procedure import Evaluation
from rig.calibrations import CalibrationResult, RejectionCode
from rig.events.events import Moved
from sim.noise import NoiseModel
from tests.calibration.rejected import codes

COUNT_DEG = 360 / 4096


def fit(legs: list[Leg]) -> Evaluation:
    return evaluate(legs, resolution_deg=COUNT_DEG)


def drawn(
    rng: np.random.Generator, backlash_deg: float = 0.3, *, ratio: float = 1.01, reversals: int = 24
) -> list[Leg]:
    """Return legs as a bench measures them: rests anywhere in a count, shared by neighbours, and a gyro with noise."""
    lengths = np.where(np.arange(reversals) // 2 % 2 == 0, 6.0, 60.0)
    stops = np.where(np.arange(reversals + 1) % 2 == 0, 0.0, 1.0) * np.append(0.0, lengths)
    rests = stops + rng.uniform(-COUNT_DEG / 2, COUNT_DEG / 2, reversals + 1)
    read = np.round(rests / COUNT_DEG) * COUNT_DEG
    shaft = np.diff(rests)
    gyro = (shaft - backlash_deg * np.sign(shaft)) / ratio + rng.normal(0.0, 0.01, reversals)
    return [Leg(float(e), float(g), 0.01) for e, g in zip(np.diff(read), gyro, strict=True)]


def run(s, *, during=None) -> CalibrationResult:
    for event in Backlash(24).live(s.bench):
        if isinstance(event, Moved) and during and (happens := during.get(event.index)):
            happens()
    assert isinstance(event, CalibrationResult)
    return event


def test_true_values_lie_within_the_stated_uncertainty():
    rng = np.random.default_rng(1)
    backlashes = rng.uniform(0.0, 1.0, 200)
    found = [fit(drawn(rng, backlash)).estimates["backlash"] for backlash in backlashes]
    z = np.array([(e.value - backlash) / e.uncertainty for e, backlash in zip(found, backlashes, strict=True)])
    assert 0.85 < z.std() < 1.15
    assert abs(z.mean()) < 0.2


@pytest.mark.parametrize("backlashes_deg", [(0.0, 0.45), pytest.param((0.1, 1.2), marks=pytest.mark.nightly)])
def test_simulated_backlash_is_found_to_hundredths_of_a_degree(simulated, backlashes_deg):
    for seed, backlash_deg in enumerate(backlashes_deg):
        s = simulated("table.limits_deg=[-200, 200]", noise=NoiseModel(backlash_deg=backlash_deg), seed=seed)
        result = run(s)
        assert result.passed, result.rejections
        assert result.estimates["backlash"].value == pytest.approx(backlash_deg, abs=0.04)
        assert result.estimates["backlash"].uncertainty < 0.03
        assert result.settings["table.backlash_deg"] >= result.estimates["backlash"].value
        assert abs(s.world.table_deg()) < 2.0, "the table returned"
        assert s.bench.config.table.approach_deg == 3.0


@pytest.mark.parametrize(
    ("change", "code"),
    [
        (lambda leg: Leg(leg.encoder_deg, -leg.gyro_deg, leg.sigma_deg), RejectionCode.WRONG_DIRECTION),
        (lambda leg: Leg(leg.encoder_deg, leg.gyro_deg / 3, leg.sigma_deg), RejectionCode.WRONG_GEAR_RATIO),
        (
            lambda leg: Leg(leg.encoder_deg, leg.gyro_deg - np.sign(leg.encoder_deg) * 4, leg.sigma_deg),
            RejectionCode.BACKLASH_TOO_LARGE,
        ),
        (
            lambda leg: Leg(leg.encoder_deg, leg.gyro_deg + np.sign(leg.encoder_deg), leg.sigma_deg),
            RejectionCode.BACKLASH_NEGATIVE,
        ),
        (lambda leg: Leg(leg.encoder_deg, leg.gyro_deg, 0.3), RejectionCode.BACKLASH_UNCERTAIN),
        (
            lambda leg: Leg(leg.encoder_deg, leg.gyro_deg, leg.sigma_deg, "the sensor lost 3 samples"),
            RejectionCode.TOO_FEW_REVERSALS,
        ),
    ],
)
def test_wrong_legs_are_rejected(change, code):
    result = fit([change(leg) for leg in drawn(np.random.default_rng(2))])
    assert code in codes(result)
    assert not result.settings


def test_slipping_platter_is_rejected(simulated):
    s = simulated(seed=3)
    result = run(s, during={9: lambda: s.world.slip(0.8, 0.2)})
    assert RejectionCode.LEG_SLIPPED in codes(result)
