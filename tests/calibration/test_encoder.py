"""The encoder's error over its revolution: true within its uncertainty, applied, and wrong steps rejected."""

from dataclasses import replace

import numpy as np
import pytest

from calibration.encoder import NAMES, Encoder, Step, evaluate
from calibration.legs import Leg
from calibration.procedure import Evaluation
from rig.bench import calibrate
from rig.calibrations import CalibrationStore, RejectionCode
from rig.motion.turntable import Turntable
from sim.noise import NoiseModel
from tests.calibration.drawn import COUNT_DEG, codes, in_sigmas, rests


def drawn(seed: int, harmonics=(0.1, 0.1, 0.0, 0.0), direction: int = 1) -> list[Step]:
    """Return the steps of two revolutions."""
    rng = np.random.default_rng(seed)
    true, _ = rests(rng, np.arange(25) * 30.0)
    shaft = direction * true
    angle = np.radians(shaft)
    error = np.array([np.cos(angle), np.sin(angle), np.cos(2 * angle), np.sin(2 * angle)]).T @ harmonics
    read = np.round((shaft + error) / COUNT_DEG) * COUNT_DEG
    gyro = np.diff(true) / 1.01 + rng.normal(0.0, 0.01, 24)
    return [
        Step(float(a), float(b), Leg(direction * float(b - a), float(g), 0.01))
        for a, b, g in zip(read[:-1], read[1:], gyro, strict=True)
    ]


def fit(steps: list[Step], direction: int = 1) -> Evaluation:
    return evaluate(steps, direction=direction, revolution_deg=360.0, resolution_deg=COUNT_DEG)


def test_true_values_lie_within_the_stated_uncertainty():
    rng = np.random.default_rng(1)
    z = []
    for seed in range(100):
        harmonics, direction = rng.normal(0.0, 0.2, 4), int(rng.choice([-1, 1]))
        found = fit(drawn(seed, harmonics, direction), direction)
        z += in_sigmas(found, **dict(zip(NAMES, harmonics, strict=True)))
    assert 0.8 < np.std(z) < 1.15
    assert abs(np.mean(z)) < 0.15


@pytest.mark.nightly
def test_applied_result_corrects_the_table_angle(simulated, tmp_path):
    s = simulated(noise=NoiseModel(encoder_harmonic_deg=0.3, backlash_deg=0.0), seed=11)

    def errors() -> list[float]:
        with Turntable(s.bench) as table:
            return [table.goto(angle).encoder_deg - s.world.table_deg() for angle in (10.0, 100.0, 190.0, 280.0)]

    before = np.ptp(errors())
    *_, result = Encoder(2).live(s.bench)
    assert result.passed, result.rejections
    CalibrationStore(tmp_path).add(result)
    calibrate(s.bench, CalibrationStore(tmp_path))
    assert before > 0.3
    assert np.ptp(errors()) < 0.15
    *_, again = Encoder(2).live(s.bench)  # the result in force does not hide the error
    assert np.abs(in_sigmas(again, **{name: result.estimates[name].value for name in NAMES})).max() < 4


@pytest.mark.parametrize(
    ("changed", "code"),
    [
        ({"sigma_deg": 0.5}, RejectionCode.ENCODER_UNCERTAIN),
        ({"invalid": "lost 3 samples"}, RejectionCode.TOO_FEW_STEPS),
    ],
)
def test_noisy_and_invalid_steps_are_rejected(changed, code):
    result = fit([replace(step, leg=replace(step.leg, **changed)) for step in drawn(3)])
    assert code in codes(result)
    assert not result.settings


def test_excessive_error_and_slip_are_rejected():
    assert RejectionCode.ENCODER_ERROR_TOO_LARGE in codes(fit(drawn(4, (3.0, 0.0, 0.0, 0.0))))
    steps = drawn(5)
    steps[7] = replace(steps[7], leg=replace(steps[7].leg, gyro_deg=steps[7].leg.gyro_deg + 1.0))
    rejection = fit(steps).rejections[0]
    assert (rejection.code, rejection.values["leg"]) == (RejectionCode.LEG_SLIPPED, 8)
