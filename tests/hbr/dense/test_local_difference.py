"""The pixel comparison of near twins."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

import hbr
from hbr.dense.local_difference import (
    MAX_MISFIT,
    MOST_VIEWS,
    LocalView,
    chosen_views,
    compare_objects,
    pixel_difference,
)
from hbr.dense.pose import poses_of

STEP_DEG = 10.0


def shown(azimuth_deg: float, *, sticker: bool, noise: int = 0, moved: tuple[float, float] = (0.0, 0.0)) -> LocalView:
    """Draw a patterned cylinder from a side; one kind has a sticker on its front."""
    pattern = np.random.default_rng(5).integers(60, 200, (5, 10, 3), dtype=np.uint8)
    sheet = cv2.resize(pattern, (720, 120), interpolation=cv2.INTER_LINEAR)
    if sticker:
        cv2.circle(sheet, (360, 60), 14, (20, 20, 240), -1)
    crop = np.full((160, 160, 3), 30, np.uint8)
    mask = np.zeros((160, 160), np.uint8)
    across = (np.arange(100) - 49.5) / 50
    columns = ((np.rad2deg(np.arcsin(across)) + 180 - azimuth_deg) * 2 % 720).astype(int)
    crop[20:140, 30:130], mask[20:140, 30:130] = sheet[:, columns], 255
    move = np.array([[1, 0, moved[0]], [0, 1, moved[1]]], np.float64)
    crop, mask = cv2.warpAffine(crop, move, (160, 160)), cv2.warpAffine(mask, move, (160, 160))
    noisy = crop + np.random.default_rng(noise).normal(0, 3, crop.shape)
    return LocalView(np.clip(noisy, 0, 255).astype(np.uint8), mask, azimuth_deg % 360)


@pytest.fixture(scope="module")
def objects() -> tuple[list[LocalView], list[LocalView]]:
    sides = np.arange(-20.0, 41.0, STEP_DEG).tolist()
    plain, marked = ([shown(side, sticker=kind, noise=n) for n, side in enumerate(sides)] for kind in (False, True))
    return plain, marked


@pytest.mark.parametrize("sticker", [False, True])
def test_views_of_a_twin_are_recognised_by_its_sticker(objects, sticker: bool) -> None:
    query = shown(14.0, sticker=sticker, noise=90, moved=(2.5, -1.5))
    query = replace(query, azimuth_deg=(query.azimuth_deg + 100) % 360)
    found = compare_objects([query], objects, ([-100.0], [-98.0]))
    assert found.winner == int(sticker)
    assert found.score * (-1 if sticker else 1) > 0.6
    assert found.error_bound <= 0.01
    assert found.misfit <= MAX_MISFIT
    y, x = np.unravel_index(int(found.views[0].difference.argmax()), found.views[0].difference.shape)
    away = (abs(x / 0.8 - 82.5), abs(y / 0.8 - 78.5))  # from the middle; the sticker is 14 px wide and 14 degrees aside
    assert away[0] < 30
    assert away[1] < 16


def test_enrolled_views_of_twins_score_as_their_own_object(objects) -> None:
    queries = [shown(side, sticker=True, noise=90) for side in (4.0, 24.0)]
    found = compare_objects(queries, objects, ([0.0], [0.0]))
    assert found.expected == pytest.approx((1, -1), abs=0.2)


def test_comparison_names_no_winner_if_it_is_unclear_or_its_error_rate_is_too_high(objects) -> None:
    plain, marked = (shown(14.0, sticker=kind, noise=90) for kind in (False, True))
    pale = replace(plain, crop=cv2.addWeighted(plain.crop, 0.5, marked.crop, 0.5, 0))
    between = compare_objects([pale], objects, ([0.0], [0.0]))
    assert between.misfit <= MAX_MISFIT
    assert between.error_bound <= 0.01
    assert abs(between.score) < 0.3
    assert between.winner is None
    for max_error, winner in ((0.01, 1), (0.0001, None)):
        assert compare_objects([marked], objects, ([0.0], [0.0]), max_error=max_error).winner == winner


def test_comparison_decides_nothing_if_twins_look_the_same(objects) -> None:
    plain, _ = objects
    found = compare_objects([shown(4.0, sticker=False, noise=91)], (plain, plain[::-1]), ([0.0], [0.0]))
    assert found.winner is None
    assert found.expected is None
    assert found.misfit <= MAX_MISFIT


def test_another_object_fits_neither_twin(objects) -> None:
    query = shown(14.0, sticker=True)
    other = LocalView(np.ascontiguousarray(query.crop[::-1]), query.mask, query.azimuth_deg)
    found = compare_objects([other], objects, ([0.0], [0.0]))
    assert found.winner is None
    assert found.misfit > MAX_MISFIT


def test_small_displacements_are_no_difference_but_missing_details_are() -> None:
    image = np.full((40, 40, 3), 90, np.uint8)
    image[:, 20:22] = 220
    assert pixel_difference(image, np.roll(image, 2, axis=1))[:, 4:36].max() < 12
    for one, other in ((image, np.full_like(image, 90)), (np.full_like(image, 90), image)):
        assert pixel_difference(one, other)[:, 20:22].min() > 60


def test_last_views_that_are_far_apart_are_compared() -> None:
    assert chosen_views([0.0, 5.0, 90.0, 359.0]) == [2, 3]
    assert len(chosen_views(np.arange(0.0, 360.0, 3.0).tolist())) == MOST_VIEWS


def test_a_symmetric_object_has_several_poses() -> None:
    rng = np.random.default_rng(0)
    kind = hbr.descriptor("edges")
    half = rng.integers(0, 2, (9, kind.length)).astype(np.uint8)
    rows = np.concatenate([half, half])
    index = hbr.DenseIndex(hbr.Views.of_object("twice", rows, np.arange(18) * 20.0, kind.name))
    belief = hbr.update_belief(rows[3], 0.0, index)
    assert sorted(poses_of(belief, 0)[:2]) == pytest.approx([60.0, 240.0], abs=10)


def test_a_comparison_needs_views(objects) -> None:
    with pytest.raises(ValueError, match="needs a view"):
        compare_objects([], objects, ([0.0], [0.0]))
