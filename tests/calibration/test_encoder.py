"""The encoder's error over its revolution: true within its uncertainty, applied, and wrong steps rejected."""

import numpy as np
import pytest

from calibration.encoder import Encoder, Step, evaluate
from calibration.legs import Leg
from calibration.procedure import Evaluation
from rig.bench import calibrate
from rig.calibrations import CalibrationStore, RejectionCode
from rig.motion.turntable import Turntable
from sim.noise import NoiseModel
from tests.calibration.rejected import codes

COUNT_DEG = 360 / 4096
NAMES = ("cos1", "sin1", "cos2", "sin2")


def error_deg(harmonics, position_deg):
    rotation = np.radians(position_deg)
    a1, b1, a2, b2 = harmonics
    return a1 * np.cos(rotation) + b1 * np.sin(rotation) + a2 * np.cos(2 * rotation) + b2 * np.sin(2 * rotation)


def drawn(rng: np.random.Generator, harmonics, *, direction: int = 1, revolutions: int = 2) -> list[Step]:
    true = np.arange(12 * revolutions + 1) * 30.0 + rng.uniform(-COUNT_DEG / 2, COUNT_DEG / 2, 12 * revolutions + 1)
    shaft = direction * true
    read = np.round((shaft + error_deg(harmonics, shaft)) / COUNT_DEG) * COUNT_DEG
    gyro = np.diff(true) / 1.01 + rng.normal(0.0, 0.01, 12 * revolutions)
    return [
        Step(float(a), float(b), Leg(direction * float(b - a), float(g), 0.01))
        for a, b, g in zip(read[:-1], read[1:], gyro, strict=True)
    ]


def fit(steps: list[Step], direction: int = 1) -> Evaluation:
    return evaluate(
        steps,
        direction=direction,
        revolution_deg=360.0,
        resolution_deg=COUNT_DEG,
    )


def test_true_values_lie_within_the_stated_uncertainty():
    rng = np.random.default_rng(1)
    z = []
    for _ in range(100):
        harmonics, direction = rng.normal(0.0, 0.2, 4), int(rng.choice([-1, 1]))
        found = fit(drawn(rng, harmonics, direction=direction), direction).estimates
        z += [(found[name].value - true) / found[name].uncertainty for name, true in zip(NAMES, harmonics, strict=True)]
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
    after = np.ptp(errors())
    assert before > 0.3
    assert after < 0.15
    *_, again = Encoder(2).live(s.bench)  # the result in force does not hide the error
    for name in NAMES:
        difference = again.estimates[name].value - result.estimates[name].value
        assert abs(difference) < 4 * result.estimates[name].uncertainty


@pytest.mark.parametrize(
    ("change", "code"),
    [
        (
            lambda step: Step(step.from_deg, step.to_deg, Leg(step.leg.encoder_deg, step.leg.gyro_deg, 0.5)),
            RejectionCode.ENCODER_UNCERTAIN,
        ),
        (
            lambda step: Step(step.from_deg, step.to_deg, Leg(step.leg.encoder_deg, 30.0, 0.01, "lost 3 samples")),
            RejectionCode.TOO_FEW_STEPS,
        ),
    ],
)
def test_noisy_and_invalid_steps_are_rejected(change, code):
    result = fit([change(step) for step in drawn(np.random.default_rng(3), (0.1, 0.1, 0.0, 0.0))])
    assert code in codes(result)
    assert not result.settings


def test_excessive_error_and_slip_are_rejected():
    far = fit(drawn(np.random.default_rng(4), (3.0, 0.0, 0.0, 0.0)))
    assert RejectionCode.ENCODER_ERROR_TOO_LARGE in codes(far)
    steps = drawn(np.random.default_rng(5), (0.1, 0.0, 0.0, 0.0))
    slipped = steps[7]
    steps[7] = Step(
        slipped.from_deg,
        slipped.to_deg,
        Leg(slipped.leg.encoder_deg, slipped.leg.gyro_deg + 1.0, slipped.leg.sigma_deg),
    )
    rejection = fit(steps).rejections[0]
    assert (rejection.code, rejection.values["leg"]) == (RejectionCode.LEG_SLIPPED, 8)
