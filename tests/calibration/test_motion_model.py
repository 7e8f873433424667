"""The duration of rotations: true within its uncertainty, predicts new rotations, and rejects an obstructed one."""

from dataclasses import replace

import numpy as np
import pytest

from calibration.motion_model import DISTANCES_DEG, PARAMETERS, MotionModel, TimedMove, evaluate, seconds_of
from calibration.procedure import Evaluation
from rig.calibrations import RejectionCode
from rig.core.errors import UsageError
from rig.devices.servo import MotionProfile
from rig.motion.turntable import Turntable
from tests.calibration.rejected import codes


def drawn(rng: np.random.Generator, pace: float, wind_up: float, delay: float) -> list[TimedMove]:
    distances = np.array([d * sign for _ in range(3) for d in DISTANCES_DEG for sign in (1, -1)])
    reach = np.abs(distances)
    seconds = np.where(reach * pace < wind_up, 2 * np.sqrt(reach * pace * wind_up), reach * pace + wind_up) + delay
    seconds += rng.normal(0, 0.03, seconds.size)
    return [TimedMove(float(d), float(t)) for d, t in zip(distances, seconds, strict=True)]


def fit(moves: list[TimedMove]) -> Evaluation:
    return evaluate(moves, MotionProfile(70.0, 220.0))


def test_true_values_lie_within_the_stated_uncertainty():
    rng = np.random.default_rng(1)
    z = {"pace": [], "wind_up": [], "delay": []}
    for _ in range(60):
        truth = {
            "pace": rng.uniform(0.008, 0.025),
            "wind_up": max(rng.normal(0.318, 0.095), 0.1),
            "delay": rng.uniform(0.3, 0.6),
        }
        for name, estimate in fit(drawn(rng, **truth)).estimates.items():
            z[name].append((estimate.value - truth[name]) / estimate.uncertainty)
    for name, values in z.items():
        assert 0.8 < np.sqrt(np.mean(np.square(values))) < 1.25, name
        assert (np.abs(values) < 1.96).mean() >= 0.85, name


def test_new_rotations_are_predicted(simulated):
    s = simulated("table.velocity_dps=60", "table.acceleration_dps2=150", seed=4)
    *_, result = MotionModel(3).live(s.bench)
    assert result.passed, result.rejections
    assert result.estimates["pace"].value == pytest.approx(1 / 60, rel=0.05)
    assert s.bench.config.table.approach_deg == 3.0
    model = np.array([result.estimates[name].value for name in PARAMETERS])
    with Turntable(s.bench) as table:
        table.goto(5.0)
        for goal_deg in (35.0, 170.0, 178.0):
            predicted_s = seconds_of(model, np.array([goal_deg - table.rest_deg]))[0]
            assert table.goto(goal_deg).seconds == pytest.approx(predicted_s, abs=0.25)


def test_obstructed_rotation_is_rejected():
    moves = drawn(np.random.default_rng(2), 0.012, 0.3, 0.4)
    moves[5] = replace(moves[5], seconds=moves[5].seconds + 1.0)
    result = fit(moves)
    assert codes(result) == [RejectionCode.MOVE_HINDERED]
    assert not result.settings
    # One bad rotation does not change the fit.
    assert result.estimates["pace"].value == pytest.approx(0.012, rel=0.05)


def test_too_few_rounds_are_a_usage_error(simulated):
    with pytest.raises(UsageError):
        next(MotionModel(rounds=1).live(simulated().bench))
