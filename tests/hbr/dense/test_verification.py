"""A doubtful leader is compared with the views of the search: its enrolled views explain their pixels in any light."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import pytest

from hbr import Belief, DenseIndex, Views, update_belief
from hbr.core.angles import wrap180
from hbr.dense.pixel_fit import LocalView, Pixels, compare
from hbr.dense.session import answered, verify
from tests.hbr.dense.searches import catalog

SIDE = 160


def painted(
    seed: int, *, moved: tuple[float, float] = (0, 0), light: tuple[float, float, float] = (1, 1, 1)
) -> LocalView:
    """Return a box with coloured spots, the same for the same seed, on its own background."""
    rng = np.random.default_rng(seed)
    crop = np.full((SIDE, SIDE, 3), rng.integers(60, 120, 3), np.uint8)
    mask = np.zeros((SIDE, SIDE), np.uint8)
    cv2.rectangle(mask, (20, 10), (140, 150), 255, -1)
    crop[mask > 0] = 140
    for _ in range(25):
        x, y = (int(v) for v in rng.integers((30, 20), (130, 140)))
        cv2.circle(crop, (x, y), int(rng.integers(4, 12)), rng.integers(20, 230, 3).tolist(), -1)
    move = np.array([[1.04, 0, moved[0]], [0, 0.97, moved[1]]]) if any(moved) else np.eye(2, 3)
    crop = cv2.warpAffine(crop, move, (SIDE, SIDE), borderMode=cv2.BORDER_REPLICATE)
    mask = cv2.warpAffine(mask, move, (SIDE, SIDE))
    lit = np.clip(crop * np.array(light), 0, 255).astype(np.uint8)
    return LocalView(lit, mask, 0.0)


def test_fit_is_high_for_the_same_object_in_other_light_and_low_for_another_object() -> None:
    enrolled = Pixels.of(painted(1))
    same = compare(Pixels.of(painted(1, moved=(-6, 5), light=(0.7, 0.8, 1.05))), enrolled)
    other = compare(Pixels.of(painted(2)), enrolled)
    itself = compare(enrolled, enrolled)
    assert itself.fit > 0.95
    assert same.fit > 0.75
    assert other.fit < 0.5
    # the light: the mean of the three channels, and the ratios of red and blue to green
    assert same.light == pytest.approx(np.log([0.85, 1.05 / 0.8, 0.7 / np.sqrt(0.8 * 1.05)]), abs=0.05)
    assert itself.light == pytest.approx(np.zeros(3))


def test_fit_stays_high_where_a_shade_lies_across_the_object() -> None:
    view = painted(1)
    shade = np.linspace(1, 0.5, SIDE)[:, None]
    assert compare(Pixels.of(replace(view, crop=(view.crop * shade).astype(np.uint8))), Pixels.of(view)).fit > 0.75


@pytest.mark.parametrize("across", [False, True])
def test_no_scale_is_changed_where_only_the_colours_would_show_it(across: bool) -> None:
    half = np.where(np.arange(SIDE) < SIDE // 2, 0, 30)
    tint = np.random.default_rng(1).integers(-40, 41, 16).repeat(SIDE // 16) * np.ones((SIDE, 1), np.intp)
    tint = tint if across else tint.T
    bright = 100 + half + half[:, None]  # at any scale the same four quarters
    crop = np.dstack([bright + tint, bright, bright - tint]).astype(np.uint8)
    view = Pixels.of(LocalView(crop, np.full((SIDE, SIDE), 255, np.uint8), 0.0))
    assert compare(view, view).fit > 0.95


def test_nothing_is_explained_without_common_pixels() -> None:
    view = painted(1)
    nothing = LocalView(view.crop, np.zeros_like(view.mask), 0.0)
    assert compare(Pixels.of(view), Pixels.of(nothing)).fit == 0


@pytest.fixture(scope="module")
def index() -> DenseIndex:
    return DenseIndex(catalog())


def test_the_leader_is_compared_at_its_pose_with_the_better_segmentation(index: DenseIndex) -> None:
    views: Views = index.views
    rows = views.of(2)[[0, 6]]
    other = views.descriptors[views.of(5)[0]]
    so_far: DenseIndex | Belief = index
    for row in rows.tolist():  # the second segmentation of each view is the right one
        so_far = update_belief(np.stack([other, views.descriptors[row]]), float(views.azimuth_deg[row]), so_far)
    assert isinstance(so_far, Belief)
    asked: dict[int, list[float]] = {}

    def enrolled(leader: int, azimuths_deg: list[float]) -> list[LocalView]:
        asked[leader] = list(azimuths_deg)
        return [replace(painted(leader), azimuth_deg=azimuth_deg) for azimuth_deg in azimuths_deg]

    found = answered(verify(so_far, lambda _: [painted(9), painted(2)]), enrolled)
    assert found is not None
    assert len(asked) == 3  # the leader and the next two candidates
    assert np.allclose(wrap180(asked[2] - views.azimuth_deg[rows]), 0, atol=15)
    assert found.object_index == 2
    assert found.own > 0.4 > max(found.second, found.others)
    assert found.expected == pytest.approx(1, abs=0.05)  # all views of the object are the same here


def test_the_second_candidate_leads_if_it_fits_better_and_a_twin_is_no_other_candidate() -> None:
    views = catalog()
    own = views.of(2)
    twin = Views.of_object("twin", views.levels(own), views.azimuth_deg[own], views.descriptor)
    both = DenseIndex(Views.concatenate([views, twin]))
    belief = update_belief(views.levels(own[:1]), float(views.azimuth_deg[own[0]]), both)
    first, second = np.argsort(-belief.probability(), kind="stable")[:2].tolist()
    assert {first, second} == {2, len(both) - 1}

    def enrolled(leader: int, azimuths_deg: Sequence[float], shown_as: Mapping[int, int]) -> list[LocalView]:
        view = painted(shown_as.get(leader, leader))
        return [replace(view, azimuth_deg=azimuth_deg) for azimuth_deg in azimuths_deg]

    for better in (first, second):
        found = answered(verify(belief, lambda _: [painted(better)]), partial(enrolled, shown_as={}))  # noqa: B023
        assert found is not None
        assert found.object_index == better
        assert found.own > 0.9 > found.second
    same = answered(verify(belief, lambda _: [painted(first)]), partial(enrolled, shown_as={second: first}))
    assert same is not None
    assert same.second > 0.9 > same.others
