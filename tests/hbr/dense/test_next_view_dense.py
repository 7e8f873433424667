"""The next view: the rotation with the best balance of expected information and time within the cable budget."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hbr import DenseIndex, Views, next_best_view
from hbr.dense.filter import update_belief
from hbr.dense.index import BINS
from hbr.dense.next_view import SHARPNESS, strongest
from hbr.evaluation.trials import most_informative_rotation
from tests.fuzzing import examples

STEP = 15


def twins() -> Views:
    """Return two objects that differ only from 180 to 210 degrees, and a third one that is different."""
    rng = np.random.default_rng(0)
    azimuth = np.arange(0, 360, STEP, dtype=float)
    rotation = np.radians(azimuth)[:, None]
    parts = []
    base = rng.uniform(1, 6, 144) * (rng.random(144) < 0.3)
    swing, phase = rng.uniform(0, 2, 144) * (base > 0), rng.uniform(0, 7, 144)
    plain = np.rint(np.clip(base + swing * np.sin(rotation + phase), 0, 7)).astype(np.uint8)
    marked = plain.copy()
    marked[(azimuth >= 180) & (azimuth <= 210), 60:110] = 5
    parts = [Views.of_object("plain", plain, azimuth), Views.of_object("marked", marked, azimuth)]
    other = np.where(rng.random((24, 144)) < 0.2, 6, 0).astype(np.uint8)
    return Views.concatenate([*parts, Views.of_object("other", other, azimuth)])


VIEWS = twins()
INDEX = DenseIndex(VIEWS)


def viewed(azimuth: float) -> np.ndarray:
    return VIEWS.descriptors[VIEWS.of(0)[int(azimuth // STEP)]]


@pytest.mark.parametrize(("azimuth", "low", "high"), [(30.0, 145, 185), (300.0, -125, -85)])
def test_twins_are_distinguished_at_the_azimuth_of_their_difference(azimuth: float, low: float, high: float) -> None:
    see = next_best_view(update_belief(viewed(azimuth), 0.0, INDEX))
    assert low <= see.rotation_deg <= high
    assert see.pair in ((0, 1), (1, 0))
    assert see.orientation_deg == see.rotation_deg % 360
    # the baseline finds the difference, too
    assert low <= most_informative_rotation(update_belief(viewed(azimuth), 0.0, INDEX)) <= high


def test_an_object_that_may_not_be_enrolled_is_viewed_where_the_leader_looks_different() -> None:
    """A twin without the mark is not enrolled: only the marked side can show that."""
    belief = update_belief(viewed(30.0), 0.0, DenseIndex(VIEWS.select(np.concatenate([VIEWS.of(1), VIEWS.of(2)]))))
    assert 145 <= next_best_view(belief, not_enrolled=0.3).rotation_deg <= 185
    assert not 145 <= next_best_view(belief).rotation_deg <= 185


def test_only_rotations_that_the_cable_allows_are_chosen() -> None:
    belief = update_belief(viewed(30.0), 0.0, INDEX)
    allowed = np.array([-90.0, -40.0, 20.0, 70.0])
    see = next_best_view(belief, rotations_deg=allowed)
    assert see.rotation_deg in allowed
    assert len(see.confusion) == len(see.cost) == 4


def test_next_view_weighs_information_against_motion_time() -> None:
    belief = update_belief(viewed(30.0), 0.0, INDEX)
    revolutions = np.arange(-175.0, 181.0, 5)
    quick = next_best_view(belief, rotations_deg=revolutions, seconds=np.zeros(len(revolutions)))
    slow = next_best_view(belief, rotations_deg=revolutions, seconds=np.abs(revolutions) / 2)
    assert abs(slow.rotation_deg) < abs(quick.rotation_deg)


def test_visited_view_has_no_expected_gain() -> None:
    first = update_belief(viewed(30.0), 0.0, INDEX)
    second = update_belief(viewed(180.0), 150.0, first)
    see = next_best_view(second, seconds=np.zeros(BINS - 1))
    landing = (150 + see.rotations_deg) % 360
    visited = np.isin(landing, [0.0, 150.0])
    assert see.confusion[visited].min() >= see.confusion.max() - 1e-9


@examples(5)
@given(st.integers(0, 23))
def test_expected_confusion_equals_the_formula(start: int) -> None:
    """The expected values are computed from the posterior of single hypotheses, with explicit loops."""
    belief = update_belief(viewed(start * STEP), 20.0, INDEX)
    revolutions = np.array([-120.0, 33.0, 90.0])
    see = next_best_view(belief, rotations_deg=revolutions)
    probability, place, bins = strongest(belief.posterior)
    for rotation, confusion in zip(revolutions, see.confusion, strict=True):
        novelty = 1 - np.exp(-0.5 * (min(abs(rotation), 360 - abs(rotation)) / 15) ** 2)
        away = [
            np.abs((VIEWS.azimuth_deg[VIEWS.of(j)] - b * 5 - rotation + 180) % 360 - 180)
            for j, b in zip(place.tolist(), bins.tolist(), strict=True)
        ]
        shown = [VIEWS.descriptors[VIEWS.of(j)[own.argmin()]] for j, own in zip(place.tolist(), away, strict=True)]
        known = np.exp(-0.5 * (np.array([own.min() for own in away]) / 15) ** 2)
        vectors = INDEX.space.vectors(np.array(shown)).astype(np.float64)
        similar = vectors @ vectors.T / INDEX.space.largest.sum()
        pairs = np.outer(probability, probability) * (place[:, None] != place)
        assert confusion == pytest.approx(
            np.log((pairs * np.exp(-SHARPNESS * novelty * np.sqrt(np.outer(known, known)) * (1 - similar))).sum()),
            abs=1e-3,
        )


def test_single_object_is_viewed_from_a_new_side() -> None:
    alone = DenseIndex(VIEWS.select(VIEWS.of(0)))
    see = next_best_view(update_belief(viewed(30.0), 0.0, alone))
    assert see.pair is None
    assert abs(see.rotation_deg) >= 50


def test_invalid_choice_is_rejected() -> None:
    belief = update_belief(viewed(0.0), 0.0, INDEX)
    with pytest.raises(ValueError, match="the cable's limits"):
        next_best_view(belief, rotations_deg=[])
    with pytest.raises(ValueError, match="one finite time each"):
        next_best_view(belief, rotations_deg=[10.0, 20.0], seconds=[1.0])
