"""The numbers that tell an enrolled object from one that only resembles it."""

import numpy as np
import pytest

from hbr import DenseIndex, Views
from hbr.dense.evidence import COMMON, numbers
from tests.hbr.dense.searches import LIGHT, belief_after, catalog, view

QUERIES_DEG = (30.0, 150.0, 270.0)
LEAD, SECOND, BETWEEN, EXPECTED, EXPECTED_OVER_BEST, UNSEEN, APART, QUERIES = range(COMMON)


def search(index: DenseIndex, share: float, j: int = 2) -> np.ndarray:
    """Return the numbers of a search for an object of which other objects' levels replace a share."""
    rng = np.random.default_rng(3)
    others = catalog(3, seed=9)
    queries = [
        np.where(rng.random(len(own)) < share, view(others, 1, deg), own)
        for deg, own in ((deg, view(index.views, j, deg)) for deg in QUERIES_DEG)
    ]
    belief = belief_after(queries, QUERIES_DEG, index)
    return numbers(belief, int(belief.probability().argmax()))


@pytest.mark.parametrize("kind", ["cedd", LIGHT, "edges+colours+cedd+network"])
@pytest.mark.parametrize("objects", [1, 2, 12])
@pytest.mark.parametrize("step_deg", [90.0, 360.0])
def test_numbers_are_finite_and_there_are_two_for_each_use_of_a_part(kind: str, objects: int, step_deg: float) -> None:
    index = DenseIndex(catalog(objects, kind=kind, step_deg=step_deg))
    belief = belief_after(index.views.descriptors[[0, 0]], (0.0, 90.0), index)
    for leader in range(objects):
        found = numbers(belief, leader)
        assert found.shape == (COMMON + 2 * len(index.space.begin),)
        assert np.isfinite(found).all()


def test_a_more_similar_object_has_a_larger_lead() -> None:
    index = DenseIndex(catalog(10))
    found = np.array([search(index, share) for share in (0.5, 0.3, 0.1, 0.0)])
    for number in (LEAD, BETWEEN):
        assert (np.diff(found[:, number]) > 0).all()
    assert (np.diff(found[:, COMMON:], axis=0) > 0).all()
    assert ((found[:, SECOND] > 0) & (found[:, SECOND] <= 1)).all()
    assert found[-1, BETWEEN] > 1 > found[0, BETWEEN]  # its enrolled views themselves, and a view that resembles them


def test_the_expected_leads_hardly_depend_on_the_query() -> None:
    index = DenseIndex(catalog(10))
    own, changed = (search(index, share) for share in (0.0, 0.3))
    np.testing.assert_allclose(own[[EXPECTED, EXPECTED_OVER_BEST]], changed[[EXPECTED, EXPECTED_OVER_BEST]], atol=0.1)
    assert own[EXPECTED_OVER_BEST] < own[EXPECTED]


@pytest.mark.parametrize("step_deg", [5.0, 30.0, 90.0])
def test_spacing_of_the_views_and_number_of_queries_count_within_those_of_the_fit(step_deg: float) -> None:
    index = DenseIndex(catalog(4, step_deg=step_deg))
    for count in (1, 3, 6):
        found = numbers(belief_after(index.views.descriptors[[0] * count], [60.0 * n for n in range(count)], index), 0)
        assert np.exp(found[[APART, QUERIES]]) == pytest.approx([max(step_deg, 10.0), min(count, 4)])


def test_the_second_object_has_a_negative_margin() -> None:
    index = DenseIndex(catalog(10))
    belief = belief_after([view(index.views, 2, deg) for deg in QUERIES_DEG], QUERIES_DEG, index)
    order = np.argsort(-belief.support.max(axis=1))
    first, second = (numbers(belief, int(place)) for place in order[:2])
    assert first[SECOND] > 0 > second[SECOND]
    assert first[LEAD] > second[LEAD]


def test_one_object_alone_is_compared_with_nothing() -> None:
    index = DenseIndex(catalog(1))
    found = search(index, 0.0, j=0)
    z = belief_after([view(index.views, 0, deg) for deg in QUERIES_DEG], QUERIES_DEG, index).support.max() / 3
    assert found[LEAD] == pytest.approx(z)
    leads, each_z = np.split(found[COMMON:], 2)
    np.testing.assert_array_equal(leads, each_z)
    assert leads.sum() == pytest.approx(z, rel=0.05)
    assert found[SECOND] == 1
    assert found[EXPECTED] == found[EXPECTED_OVER_BEST]


def test_a_side_unlike_the_sides_that_were_seen_counts_until_it_is_seen() -> None:
    """An object with a mark on one side: without that side, its twin without the mark would look the same."""
    views = catalog(4, step_deg=15.0)
    levels = views.descriptors.copy()
    own = views.of(0)
    levels[own] = levels[own[0]]
    levels[own[12:14]] = view(catalog(1, seed=5), 0, 0.0)
    index = DenseIndex(Views(levels, views.azimuth_deg, views.object_index, views.object_names, views.descriptor))
    before, after = (
        numbers(belief_after([levels[own[n]] for n in seen], [15.0 * n for n in seen], index), 0)[UNSEEN]
        for seen in ((0, 4), (0, 4, 12))
    )
    assert before < 0.5
    assert after > 0.9
