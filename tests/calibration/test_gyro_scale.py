"""The gyro's scale: true within its uncertainty, or rejected; what every procedure does when it ends or is ended."""

from dataclasses import replace
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
from tests.calibration.drawn import COUNT_DEG, codes, in_sigmas, rests
from tests.rig.bench_parts import at_rest

SLIP_DELAY_NS = 4_000_000_000
"""After a move's end: beyond the rest, in the middle of the next leg."""


def true_scale(seed: int) -> float:
    """Return the true scale of the simulated sensor of this seed, from its gain and its tilt relative to the axis."""
    part = InertialModel(World(seed=seed), "imu-68")
    return 1 / float(part.gyro_gain[2] * part.up[2])


def fit(legs: list[Leg]) -> Evaluation:
    return evaluate(legs, resolution_deg=COUNT_DEG)


def drawn(rng: np.random.Generator, scale: float, legs: int = 4, more_deg: float = 0.0) -> list[Leg]:
    """Return legs as a bench with the stated errors measures them, and with ``more_deg`` of a further scatter."""
    true, read = rests(rng, np.arange(legs + 1) % 2 * 720.0)
    rotated = np.diff(true) / scale + rng.normal(0.0, 0.03, legs) + rng.normal(0.0, more_deg, legs)
    return [Leg(float(e), float(g), 0.03) for e, g in zip(np.diff(read), rotated, strict=True)]


def run(s, *, during=None) -> CalibrationResult:
    """Calibrate; ``during`` maps the index of a leg, from 1, to an action on the world in the middle of the leg."""
    for event in GyroScale(revolutions=4).live(s.bench):
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
        result = run(simulated(seed=seed))
        assert result.passed, result.rejections
        assert result.estimates["scale"].value == pytest.approx(true_scale(seed), rel=0.001)
        assert result.residual < result.limit
        assert result.estimates["scale"].uncertainty < 1.5e-4
        z += in_sigmas(result, scale=true_scale(seed))
    assert np.mean(np.abs(z) < 1.96) >= 0.85
    assert 0.3 < sqrt(np.mean(np.square(z))) < 1.3


@pytest.mark.parametrize(("legs", "more_deg"), [(4, 0.0), (12, 0.0), (12, 0.2)])
def test_error_over_uncertainty_has_a_standard_deviation_of_one(legs, more_deg):
    """Also with a scatter beyond the stated noise: it widens the uncertainty."""
    rng = np.random.default_rng(1)
    results = [(scale, fit(drawn(rng, scale, legs, more_deg))) for scale in rng.uniform(0.95, 1.05, 300)]
    z = [in_sigmas(result, scale=scale)[0] for scale, result in results]
    assert 0.85 < np.std(z) < (1.25 if more_deg else 1.1)
    assert abs(np.mean(z)) < 0.15
    assert more_deg or all(result.passed for _, result in results)


def test_slow_bias_drift_cancels_and_strong_drift_is_rejected():
    rng = np.random.default_rng(2)
    mild, strong = (
        fit([replace(leg, gyro_deg=leg.gyro_deg + by_deg) for leg in drawn(rng, 1.02)]) for by_deg in (0.08, 0.3)
    )
    assert mild.passed
    assert abs(in_sigmas(mild, scale=1.02)[0]) < 3
    assert RejectionCode.DIRECTIONS_DIFFER in codes(strong)


@pytest.mark.parametrize(
    ("slip_deg", "leg"), [(-0.6, 2), *(pytest.param(*one, marks=pytest.mark.nightly) for one in ((0.6, 1), (6.0, 3)))]
)
def test_slipping_platter_is_rejected(simulated, slip_deg, leg):
    s = simulated(seed=3)
    result = run(s, during={leg: lambda: s.world.slip(slip_deg, 0.2)})
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
    spoiled = [replace(legs[0], gyro_deg=17.0, invalid="the sensor lost 9 samples"), *legs[1:]]
    assert fit(spoiled).passed
    assert fit(spoiled).estimates["scale"].value == pytest.approx(1.01, abs=2e-4)
    (rejection,) = fit(spoiled[:4]).rejections
    assert (rejection.values["up"], rejection.values["down"]) == (1, 2)
    assert "lost 9 samples" in str(rejection)
    assert not fit([]).passed


@pytest.mark.parametrize("ratio", [0.0, -1.0, 0.5, 2.0])
def test_wrong_axis_sign_range_or_gear_is_rejected(ratio):
    result = fit([Leg(e, ratio * e, 0.03) for e in (360.0, -360.0) * 2])
    assert "scale" not in result.estimates
    assert codes(result) == [RejectionCode.GYRO_IMPLAUSIBLE]


def test_noisy_gyro_is_rejected():
    assert codes(fit([Leg(e, e, 1.0) for e in (360.0, -360.0) * 2])) == [RejectionCode.SCALE_UNCERTAIN]


def test_limits_are_never_exceeded(simulated):
    s = simulated("table.limits_deg=[-10, 354]", seed=5)
    *events, (result, _) = ((event, s.world.shaft()[0]) for event in GyroScale(revolutions=4).live(s.bench))
    assert result.passed
    assert result.estimates["scale"].value == pytest.approx(true_scale(5), rel=0.001)
    assert len(result.evidence["legs"]) == 4
    assert all(-10 <= shaft_deg <= 354 for _, shaft_deg in events)


@pytest.mark.parametrize("closed", [True, False])
def test_table_returns_at_the_end_and_when_closed_between_moves(simulated, closed):
    s = simulated(seed=1)
    with Turntable(s.bench) as table:
        table.goto(40.0)
    events = GyroScale(revolutions=4).live(s.bench)
    next(events)
    assert abs(s.world.shaft()[0] - 40.0) > 100
    if closed:
        events.close()
    else:
        assert list(events)[-1].passed
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


def test_calibrated_scale_narrows_the_agreement_bound(simulated):
    result = run(simulated(seed=6))
    in_force = [f"{key}={value}" for key, value in result.settings.items()]
    moves = []
    for settings in ([], in_force):
        with Turntable(simulated(*settings, seed=6).bench) as table:
            table.goto(5.0)
            moves.append(table.goto(95.0))
    before, after = (move.agreement for move in moves)
    backlash_deg = 0.5
    assert after.agrees
    assert after.bound_deg - backlash_deg < 0.2 * (before.bound_deg - backlash_deg)
    assert abs(after.difference_deg) < abs(before.difference_deg)


@pytest.mark.nightly
def test_scale_in_force_does_not_change_the_result(simulated):
    plain = run(simulated(seed=6)).estimates["scale"]
    again = run(simulated("imu.scale=1.05", "imu.scale_uncertainty=0.0", seed=6))
    assert abs(in_sigmas(again, scale=plain.value)[0]) < 1  # of 5 % nothing is left
    assert again.estimates["scale"].uncertainty == pytest.approx(plain.uncertainty, rel=0.02)
