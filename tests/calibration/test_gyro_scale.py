"""The gyro's scale: true within its uncertainty, or rejected."""

from math import sqrt

import numpy as np
import pytest

from calibration.gyro_scale import GyroScale, evaluate
from calibration.legs import Leg
from calibration.procedure import Evaluation
from rig.calibrations import CalibrationResult, RejectionCode
from rig.core.errors import DeviceSilent
from rig.events.events import Moved
from rig.motion.turntable import Turntable
from sim.imu.inertial import InertialModel
from sim.world import World
from tests.calibration.rejected import codes
from tests.rig.bench_parts import at_rest

COUNT_DEG = 360 / 4096
SLIP_DELAY_NS = 4_000_000_000
"""After a move's end: beyond the rest, in the middle of the next leg."""


def true_scale(seed: int) -> float:
    """Return the true scale of the simulated sensor of this seed, from its gain and its tilt relative to the axis."""
    part = InertialModel(World(seed=seed), "imu-68")
    return 1 / float(part.gyro_gain[2] * part.up[2])


def fit(legs: list[Leg]) -> Evaluation:
    return evaluate(legs, resolution_deg=COUNT_DEG)


def drawn(rng: np.random.Generator, scale: float, legs: int = 4, revolution_deg: float = 720.0) -> list[Leg]:
    """Return legs as a bench with the stated errors measures them: rests anywhere in a count, a gyro with noise."""
    rests = np.arange(legs + 1) % 2 * revolution_deg + rng.uniform(-COUNT_DEG / 2, COUNT_DEG / 2, legs + 1)
    read = np.round(rests / COUNT_DEG) * COUNT_DEG
    sigma = 0.03
    rotated = np.diff(rests) / scale + rng.normal(0.0, sigma, legs)
    return [Leg(float(e), float(g), sigma) for e, g in zip(np.diff(read), rotated, strict=True)]


def run(s, *, revolutions: int = 4, during=None) -> CalibrationResult:
    """Calibrate; ``during`` maps the index of a leg, from 1, to an action on the world in the middle of the leg."""
    events = GyroScale(revolutions=revolutions).live(s.bench)
    for event in events:
        if isinstance(event, Moved) and during and (happens := during.get(event.index + 1)):
            s.world.clock.call_at(s.world.clock.now_ns() + SLIP_DELAY_NS, happens)
    assert isinstance(event, CalibrationResult)
    return event


def torque(s) -> int:
    return s.bench.servo._read("Torque Enable")


@pytest.mark.parametrize("benches", [3, pytest.param(20, marks=pytest.mark.nightly)])
def test_true_scale_lies_within_the_stated_uncertainty(simulated, benches):
    """The simulated servo rests in the middle of its counts, a real one anywhere: the errors may be the smaller."""
    z = []
    for seed in range(benches):
        s = simulated(seed=seed)
        result = run(s)
        assert result.passed, result.rejections
        assert result.estimates["scale"].value == pytest.approx(true_scale(seed), rel=0.001)
        assert result.residual < result.limit
        assert result.estimates["scale"].uncertainty < 1.5e-4
        z.append((result.estimates["scale"].value - true_scale(seed)) / result.estimates["scale"].uncertainty)
    assert np.mean(np.abs(z) < 1.96) >= 0.85
    assert 0.3 < sqrt(np.mean(np.square(z))) < 1.3


@pytest.mark.parametrize("legs", [4, 12])
def test_error_over_uncertainty_has_a_standard_deviation_of_one(legs):
    rng = np.random.default_rng(1)
    results = [(scale, fit(drawn(rng, scale, legs))) for scale in rng.uniform(0.95, 1.05, 500)]
    z = np.array(
        [(result.estimates["scale"].value - scale) / result.estimates["scale"].uncertainty for scale, result in results]
    )
    assert 0.85 < z.std() < 1.1
    assert abs(z.mean()) < 0.15
    assert sum(result.passed for _, result in results) == len(results)


def test_scatter_beyond_the_stated_noise_widens_the_uncertainty():
    rng = np.random.default_rng(3)
    modest = [
        [Leg(leg.encoder_deg, leg.gyro_deg + rng.normal(0, 0.2), leg.sigma_deg) for leg in drawn(rng, 1.0, legs=12)]
        for _ in range(200)
    ]
    z = [(result.estimates["scale"].value - 1.0) / result.estimates["scale"].uncertainty for result in map(fit, modest)]
    assert 0.8 < np.std(z) < 1.25


def test_slow_bias_drift_cancels_and_strong_drift_is_rejected():
    rng = np.random.default_rng(2)

    def drifting(by_deg: float) -> Evaluation:
        return fit([Leg(leg.encoder_deg, leg.gyro_deg + by_deg, leg.sigma_deg) for leg in drawn(rng, 1.02)])

    mild = drifting(0.08)
    assert mild.passed
    assert mild.estimates["scale"].value == pytest.approx(1.02, abs=3 * mild.estimates["scale"].uncertainty)
    strong = drifting(0.3)
    assert not strong.passed
    assert RejectionCode.DIRECTIONS_DIFFER in codes(strong)


@pytest.mark.parametrize(
    ("slip_deg", "leg"), [(-0.6, 2), *(pytest.param(*one, marks=pytest.mark.nightly) for one in ((0.6, 1), (6.0, 3)))]
)
def test_slipping_platter_is_rejected(simulated, slip_deg, leg):
    s = simulated(seed=3)
    result = run(s, during={leg: lambda: s.world.slip(slip_deg, 0.2)})
    assert not result.passed
    assert (result.rejections[0].code, result.rejections[0].values["leg"]) == (RejectionCode.LEG_SLIPPED, leg)
    assert result.residual > result.limit
    assert not result.settings


def test_saturated_gyro_is_rejected_without_estimates(simulated):
    s = simulated(seed=3)

    def whirl():
        s.world.slip(75.0, 0.2)
        s.world.clock.call_at(s.world.clock.now_ns() + 400_000_000, lambda: s.world.slip(-75.0, 0.2))

    result = run(s, during=dict.fromkeys(range(1, 5), whirl))
    assert "scale" not in result.estimates
    assert codes(result) == [RejectionCode.TOO_FEW_REVOLUTIONS]
    assert "exceeded the gyro's range" in str(result.rejections[0])


def test_one_lost_leg_is_left_out_and_too_few_legs_are_rejected():
    legs = drawn(np.random.default_rng(4), 1.01, legs=6)
    spoiled = [Leg(legs[0].encoder_deg, 17.0, 0.03, "the sensor lost 9 samples"), *legs[1:]]
    assert fit(spoiled).passed
    assert fit(spoiled).estimates["scale"].value == pytest.approx(1.01, abs=2e-4)
    few = fit(spoiled[:4])
    (rejection,) = few.rejections
    assert (rejection.values["up"], rejection.values["down"]) == (1, 2)
    assert "lost 9 samples" in str(rejection)
    assert not fit([]).passed


@pytest.mark.parametrize("ratio", [0.0, -1.0, 0.5, 2.0])
def test_wrong_axis_sign_range_or_gear_is_rejected(ratio):
    result = fit([Leg(e, ratio * e, 0.03) for e in (360.0, -360.0) * 2])
    assert "scale" not in result.estimates
    assert codes(result) == [RejectionCode.GYRO_IMPLAUSIBLE]


def test_noisy_gyro_is_rejected():
    result = fit([Leg(e, e, 1.0) for e in (360.0, -360.0) * 2])
    assert codes(result) == [RejectionCode.SCALE_UNCERTAIN]


def test_limits_are_never_exceeded(simulated):
    s = simulated("table.limits_deg=[-10, 354]", seed=5)
    events, shaft_deg = zip(
        *((event, s.world.shaft()[0]) for event in GyroScale(revolutions=4).live(s.bench)), strict=True
    )
    assert events[-1].passed
    assert len(events[-1].evidence["legs"]) == 4
    assert -10 <= min(shaft_deg) < max(shaft_deg) <= 354


def test_table_returns_at_the_end_and_when_closed_between_moves(simulated):
    for seed in (1, 2):
        s = simulated(seed=seed)
        with Turntable(s.bench) as table:
            table.goto(40.0)
        events = GyroScale(revolutions=4).live(s.bench)
        if seed == 1:
            assert list(events)[-1].passed
        else:
            next(events)
            assert abs(s.world.shaft()[0] - 40.0) > 100
            events.close()
        assert s.world.shaft()[0] == at_rest(s.operator.devices.servo, 40.0)
        assert torque(s) == 0


@pytest.mark.parametrize("after_s", [1.0, 4.0])  # during a rest, and in the middle of a leg
def test_nothing_moves_after_an_interruption(simulated, after_s):
    s = simulated()

    def interrupt():
        raise KeyboardInterrupt

    events = GyroScale(revolutions=4).live(s.bench)
    next(events)
    before = s.world.shaft()[0]
    s.world.clock.call_at(s.world.clock.now_ns() + round(after_s * 1e9), interrupt)
    with pytest.raises(KeyboardInterrupt):
        next(events)
    assert torque(s) == 0
    s.world.clock.sleep(1.0)
    stopped = s.world.shaft()
    assert stopped[1] == 0
    assert abs(stopped[0] - before) == (pytest.approx(0, abs=0.2) if after_s < 2 else pytest.approx(180, abs=100))


def test_silent_servo_ends_the_calibration(simulated):
    s = simulated()
    events = GyroScale(revolutions=4).live(s.bench)
    next(events)
    s.bench.servo.bus.port.ser.unplug()
    with pytest.raises(DeviceSilent):
        next(events)
    with pytest.raises(DeviceSilent):
        s.bench.close()  # says that the torque could not be taken off


@pytest.mark.nightly
def test_scale_in_force_does_not_change_the_result(simulated):
    plain = run(simulated(seed=6)).estimates["scale"]
    scaled = run(simulated("imu.scale=1.05", "imu.scale_uncertainty=0.0", seed=6)).estimates["scale"]
    assert scaled.value == pytest.approx(plain.value, abs=plain.uncertainty)  # of 5 % nothing is left
    assert scaled.uncertainty == pytest.approx(plain.uncertainty, rel=0.02)


def test_calibrated_scale_narrows_the_agreement_bound(simulated):
    result = run(simulated(seed=6))
    moves = []
    for settings in ([], [f"{key}={value}" for key, value in result.settings.items()]):
        with Turntable(simulated(*settings, seed=6).bench) as table:
            table.goto(5.0)
            moves.append(table.goto(95.0))
    before, after = (move.agreement for move in moves)
    backlash_deg = 0.5
    assert after.agrees
    assert after.bound_deg - backlash_deg < 0.2 * (before.bound_deg - backlash_deg)
    assert abs(after.difference_deg) < abs(before.difference_deg)
