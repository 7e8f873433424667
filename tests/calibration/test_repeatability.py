"""What similarity the same view keeps, and what becomes of it."""

from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest

import hbr
from calibration.repeatability import AZIMUTHS, Sitting, from_data, live, needed_placements
from rig.calibrations import CalibrationResult, put_in_force
from rig.core.errors import UsageError
from rig.events.events import Accepted

SMALL = ("camera.width=320", "camera.height=240", "view.roi=[40, 0, 240, 240]")


def drawn(rng: np.random.Generator, placements: int, *, flips: int = 4, drift: int = 0) -> list[Sitting]:
    """Return placings whose views differ in some levels, more with every placing where the light drifts."""
    truth = rng.integers(0, 8, (AZIMUTHS, 144))

    def seen(drifted: int) -> np.ndarray:
        levels = truth.copy()
        for row in levels:
            columns = rng.choice(144, flips, replace=False)
            row[columns] = rng.integers(0, 8, flips)
        levels[:, :drifted] = 7 - levels[:, :drifted]
        return levels

    return [Sitting(np.array([seen(drift * k) for _ in range(2)], np.uint8)) for k in range(placements)]


def fit(sittings: list[Sitting], error_rate: float = 0.02) -> CalibrationResult:
    when = datetime(2026, 3, 1, tzinfo=UTC)
    return from_data(sittings, error_rate=error_rate, views=2, when_utc=when, device={})


def test_the_promised_share_of_later_placings_falls_below():
    rng = np.random.default_rng(1)
    below, n = 0, 0
    for _ in range(30):
        truth_rng = np.random.default_rng(rng.integers(1 << 32))
        sittings = drawn(truth_rng, needed_placements(0.05) + 2)
        *known, late = sittings
        fact = fit(known, 0.05)
        assert fact.passed, fact.refusals
        later = np.array([np.diag(hbr.tanimoto(s.descriptors[0], late.descriptors[0])) for s in known])
        decided = (later + np.roll(later, -3, axis=1)) / 2  # the shortest decision: two views, 90° apart
        below += int((decided < fact.settings["identify.repeatability"]).sum())
        n += decided.size
    assert 0.02 < below / n < 0.08


def test_too_few_placements_promise_nothing(simulated):
    assert needed_placements(0.02) == 4
    fact = fit(drawn(np.random.default_rng(2), 3))
    assert "3 placements are too few to promise an error rate of 2.0%" in fact.refusals[0]
    assert not fact.settings
    with pytest.raises(UsageError, match="too few") as caught:
        next(live(simulated().bench, "bowl", placements=2, error_rate=0.01))
    assert "--placements 5" in caught.value.next_step


def test_drifting_light_and_another_object_are_refused():
    assert any("the light drifts" in r for r in fit(drawn(np.random.default_rng(3), 5, flips=2, drift=3)).refusals)
    sittings = drawn(np.random.default_rng(4), 4)
    others = [replace(s, descriptors=np.roll(s.descriptors, i, axis=2)) for i, s in enumerate(sittings)]
    assert any("not put back at its mark" in r for r in fit(others).refusals)


def test_on_the_simulated_bench_and_put_in_force(simulated):
    s = simulated(*SMALL, seed=1)
    *_, fact = live(s.bench, "teapot", placements=3, error_rate=0.05)
    assert fact.passed, fact.refusals
    repeat, again, low = (fact.estimates[name].value for name in ("repeat", "placed_again", "repeatability"))
    assert 0.9 < low < again <= repeat + 0.005 < 1.005
    steps = [row["median"] for row in fact.evidence["by_step"]]
    assert steps[0] > max(steps[1:])
    config, _ = put_in_force(s.bench.config, [fact])
    assert config.identify.repeatability == pytest.approx(low, abs=1e-4)
    assert 0 < config.identify.margin < 0.1


def test_light_that_drifts_while_it_measures_is_refused(simulated):
    s = simulated(*SMALL, seed=1)
    light = 1.0
    for event in live(s.bench, "teapot", placements=3, error_rate=0.05):
        if isinstance(event, Accepted):
            light *= 0.99
            s.world.change(light=(light, light, light**1.5))
    assert isinstance(event, CalibrationResult)
    assert not event.passed
