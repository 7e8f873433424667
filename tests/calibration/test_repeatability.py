"""The similarity of repeated views, and the settings that follow from it."""

import numpy as np
import pytest

import hbr
from calibration.procedure import Evaluation
from calibration.repeatability import AZIMUTHS, Repeatability, evaluate, needed_placements
from rig.calibrations import RejectionCode, apply_results
from rig.core.errors import UsageError
from rig.core.next_steps import Do
from rig.events.events import Accepted
from tests.calibration.drawn import codes


def drawn(rng: np.random.Generator, placements: int, *, flips: int = 4, drift: int = 0) -> np.ndarray:
    """Return placements whose views differ in some levels; with a drifting light the differences grow."""
    truth = rng.integers(0, 8, (AZIMUTHS, 144))

    def seen(drifted: int) -> np.ndarray:
        levels = truth.copy()
        for row in levels:
            columns = rng.choice(144, flips, replace=False)
            row[columns] = rng.integers(0, 8, flips)
        levels[:, :drifted] = 7 - levels[:, :drifted]
        return levels

    return np.array([[seen(drift * k) for _ in range(2)] for k in range(placements)], np.uint8)


def fit(placements: np.ndarray, error_rate: float = 0.02) -> Evaluation:
    return evaluate(placements, error_rate=error_rate, views=2)


def test_stated_share_of_later_placements_is_below_the_threshold():
    rng = np.random.default_rng(1)
    below, n = 0, 0
    for _ in range(30):
        truth_rng = np.random.default_rng(rng.integers(1 << 32))
        placements = drawn(truth_rng, needed_placements(0.05) + 2)
        known, late = placements[:-1], placements[-1]
        result = fit(known, 0.05)
        assert result.passed, result.rejections
        later = np.array([np.diag(hbr.tanimoto(one[0], late[0])) for one in known])
        decided = (later + np.roll(later, -3, axis=1)) / 2  # the shortest decision: two views, 90° apart
        below += int((decided < result.settings["identify.repeatability"]).sum())
        n += decided.size
    assert 0.02 < below / n < 0.08


def test_too_few_placements_are_rejected(simulated):
    assert needed_placements(0.02) == 4
    result = fit(drawn(np.random.default_rng(2), 3))
    assert codes(result) == [RejectionCode.TOO_FEW_PLACEMENTS]
    assert not result.settings
    with pytest.raises(UsageError, match="too few") as caught:
        next(Repeatability("bowl", placements=2, error_rate=0.01).live(simulated().bench))
    assert Do.RUN_AGAIN(placements=5) in caught.value.steps


def test_drifting_light_and_another_object_are_rejected():
    assert RejectionCode.LIGHT_DRIFTS_BETWEEN_PLACEMENTS in codes(
        fit(drawn(np.random.default_rng(3), 5, flips=2, drift=3))
    )
    placements = drawn(np.random.default_rng(4), 4)
    others = np.array([np.roll(one, i, axis=2) for i, one in enumerate(placements)])
    assert RejectionCode.SIMILARITY_TOO_LOW in codes(fit(others))


@pytest.mark.nightly
def test_simulated_result_is_applied_and_drifting_light_is_rejected(simulated):
    s = simulated(seed=1)
    *_, result = Repeatability("teapot", placements=3, error_rate=0.05).live(s.bench)
    assert result.passed, result.rejections
    repeat, again, low = (result.estimates[name].value for name in ("repeat", "placed_again", "repeatability"))
    assert 0.9 < low < again <= repeat + 0.005 < 1.005
    steps = [row["median"] for row in result.evidence["by_step"]]
    assert steps[0] > max(steps[1:])
    config, _ = apply_results(s.bench.config, [result])
    assert config.identify.repeatability == pytest.approx(low, abs=1e-4)
    assert 0 < config.identify.margin < 0.1
    s, light = simulated(seed=1), 1.0
    for event in Repeatability("teapot", placements=3, error_rate=0.05).live(s.bench):
        if isinstance(event, Accepted):
            light *= 0.99
            s.world.change(light=(light, light, light**1.5))
    assert not event.passed
