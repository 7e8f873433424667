"""Symmetry of objects, and objects that can be confused."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import hbr
from hbr.model.symmetry import _arcs, similar_objects, symmetry

COUNT = 36
STEP_DEG = 360.0 / COUNT


def ring(period: int, seed: int = 0, spread: int = 3) -> np.ndarray:
    """Return descriptors, uint8 (36, 144), that change smoothly around the object and repeat after ``period`` views."""
    rng = np.random.default_rng(seed)
    keys = rng.integers(0, 8, (period, 144)).astype(float)
    smooth = sum(np.roll(keys, shift, axis=0) for shift in range(-spread, spread + 1)) / (2 * spread + 1)
    return np.tile(np.rint(smooth).astype(np.uint8), (COUNT // period, 1))


def views_of(*objects: np.ndarray) -> hbr.Views:
    return hbr.Views.concatenate(
        [hbr.Views.of_object(f"o{i}", d, np.arange(len(d)) * 360.0 / len(d)) for i, d in enumerate(objects)]
    )


@pytest.mark.parametrize(("period", "expected_deg"), [(36, 360), (18, 180), (12, 120), (9, 90)])
def test_period_is_found(period, expected_deg):
    found = symmetry(views_of(ring(period)), 0)
    assert found is not None
    assert found.period_deg == pytest.approx(expected_deg)
    if expected_deg < 360:
        assert found.similarity == pytest.approx(1.0)


def test_round_object_has_period_0_and_few_views_have_none():
    same = np.tile(np.arange(144, dtype=np.uint8) % 8, (COUNT, 1))
    found = symmetry(views_of(same), 0)
    assert found is not None
    assert (found.period_deg, found.neighbours, found.similarity) == (0.0, 1.0, 1.0)
    assert symmetry(views_of(same[:17]), 0) is None


@given(rotation=st.integers(0, COUNT - 1), period=st.sampled_from([36, 18, 12]), order=st.randoms())
def test_symmetry_is_independent_of_start_and_order_of_views(rotation, period, order):
    descriptors = ring(period)
    rows = list(range(COUNT))
    order.shuffle(rows)
    azimuth_deg = (np.array(rows) + rotation) % COUNT * STEP_DEG
    shuffled = symmetry(hbr.Views.of_object("a", descriptors[rows], azimuth_deg), 0)
    straight = symmetry(views_of(descriptors), 0)
    assert shuffled is not None
    assert straight is not None
    assert shuffled.period_deg == straight.period_deg
    assert shuffled.similarity == pytest.approx(straight.similarity)


@given(start=st.integers(0, COUNT - 1), length=st.integers(1, COUNT - 8))
def test_arc_of_a_partly_equal_object_is_found_to_two_steps(start, length):
    """Views start .. start + length - 1 of both objects are equal; their neighbours are similar."""
    mine, other = ring(36), ring(36, seed=1)
    same = (start + np.arange(length)) % COUNT
    other[same] = mine[same]
    (twin,) = similar_objects(views_of(mine, other), 0, 3)
    assert twin.name == "o1"
    assert twin.similarity == 1.0
    assert length / COUNT <= twin.share <= (length + 4) / COUNT
    ((begin_deg, end_deg),) = twin.arcs_deg
    assert 0 <= (start - begin_deg / STEP_DEG) % COUNT <= 2
    assert 0 <= (end_deg / STEP_DEG - (start + length - 1)) % COUNT <= 2


def test_most_similar_objects_come_first_and_others_are_left_out():
    mine, half, other_object = ring(36), ring(36, seed=1), ring(36, seed=2)
    half[:18] = mine[:18]
    found = similar_objects(views_of(mine, other_object, half, mine), 0, 3)
    assert [one.name for one in found] == ["o3", "o2"]
    assert similar_objects(views_of(mine, other_object, half, mine), 0, 1) == found[:1]
    assert found[0].arcs_deg == ((0.0, 360.0),)
    assert found[0].differs_deg == found[0].other_differs_deg == ()
    assert similar_objects(views_of(mine), 0, 3) == ()
    assert similar_objects(views_of(mine[:2], mine), 0, 3) == ()


def test_a_different_side_of_either_object_is_named():
    """Two objects that differ on one side only; each looks like the other one from all other sides."""
    plain = np.tile(np.arange(144, dtype=np.uint8) % 8, (COUNT, 1))
    marked = plain.copy()
    marked[4:7] = 7 - marked[4:7]
    (seen,) = similar_objects(views_of(marked, plain), 0, 3)
    assert (seen.differs_deg, seen.other_differs_deg) == (((40.0, 60.0),), ())
    assert seen.arcs_deg == ((70.0, 30.0),)
    (other,) = similar_objects(views_of(marked, plain), 1, 3)
    assert (other.share, other.arcs_deg, other.differs_deg) == (1.0, ((0.0, 360.0),), ())
    assert other.other_differs_deg == ((40.0, 60.0),)


@given(st.lists(st.booleans(), min_size=3, max_size=40))
def test_arcs_contain_exactly_the_views_that_are_held(marks):
    held = np.array(marks)
    azimuth_deg = np.arange(len(held)) * 360.0 / len(held)
    arcs = _arcs(azimuth_deg, held)
    covered = np.zeros(len(held), bool)
    for begin_deg, end_deg in () if held.all() else arcs:
        begin, end = round(begin_deg / 360 * len(held)), round(end_deg / 360 * len(held))
        rows = (begin + np.arange((end - begin) % len(held) + 1)) % len(held)
        assert not covered[rows].any()
        covered[rows] = True
    assert arcs == ((0.0, 360.0),) if held.all() else (covered == held).all()
