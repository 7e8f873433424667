"""The margin is a lower bound of the margin over all objects by enumeration."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import hbr
from tests.fuzzing import examples


def random_views(rng, objects, per_object):
    n = objects * per_object
    descriptors = rng.integers(0, 3, (n, 144)).astype(np.uint8)
    return hbr.Views(
        descriptors,
        rng.uniform(0, 360, n),
        np.repeat(np.arange(objects), per_object),
        tuple(f"object {j}" for j in range(objects)),
    )


@examples(10)
@given(seed=st.integers(0, 2**32 - 1), objects=st.integers(2, 6), n=st.integers(1, 3), list_length=st.integers(1, 8))
def test_no_object_has_a_smaller_margin_even_off_the_lists(seed, objects, n, list_length):
    rng = np.random.default_rng(seed)
    views = random_views(rng, objects, 4)
    queries = views.descriptors[rng.integers(0, len(views), n)]
    orientation = rng.uniform(0, 360, n)
    index = hbr.ViewIndex(views)
    ranking = hbr.retrieve(queries, orientation, index, list_length=list_length)
    # With lists as long as the catalog every object is listed, with all of its views.
    everything = hbr.retrieve(queries, orientation, index, list_length=len(views))
    best = ranking.object_index[0]
    others = everything.scores[everything.object_index != best]
    assert hbr.score_margin(ranking, queries) <= ranking.scores[0] - others.max() + 1e-9
    assert hbr.score_margin(ranking, queries) <= ranking.margin + 1e-9


def test_twin_outside_the_lists_has_no_margin():
    rng = np.random.default_rng(1)
    face = rng.integers(0, 8, 144).astype(np.uint8)
    round_one = hbr.Views.of_object("round", np.tile(face, (12, 1)), np.arange(12) * 30.0)
    twin = hbr.Views.of_object("twin", np.tile(face, (12, 1)), np.arange(12) * 30.0)
    index = hbr.ViewIndex(hbr.Views.concatenate([round_one, twin]))
    ranking = hbr.retrieve(face[None], [0.0], index)
    assert ranking.names == ("round",)
    assert ranking.margin == 1.0
    assert hbr.score_margin(ranking, face[None]) == 0.0


def test_margin_of_a_single_object_is_its_score_and_wrong_queries_are_rejected():
    rng = np.random.default_rng(2)
    views = random_views(rng, 1, 4)
    ranking = hbr.retrieve(views.descriptors[:2], [0.0, 10.0], hbr.ViewIndex(views))
    assert hbr.score_margin(ranking, views.descriptors[:2]) == ranking.scores[0]
    with pytest.raises(ValueError, match="3 queries for a ranking of 2"):
        hbr.score_margin(ranking, views.descriptors[:3])
