"""Strategies of a search: their rotations, and their ends."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

import hbr
from hbr import StopReason
from hbr.core.angles import wrap180
from hbr.paper.hmm import CONFIDENT, PoseModel, update_poses
from rig.config import IdentifyConfig, RigConfig, TableConfig
from rig.core.errors import CatalogError, UsageError
from rig.events.events import Ranked, RotationReason
from rig.search.model import begin_search, model_of
from rig.search.session import Finish, Rotate, Search, Strategy
from rig.search.strategies import BUILT_IN, strategy
from rig.views.description import DESCRIPTORS, DescribedView
from tests.fuzzing import examples
from tests.rig.report.report_samples import moved

PAPERS = ["ahbr", "hbr", "sweep", "random"]


def model(objects: int = 4, views: int = 12) -> hbr.Views:
    rng = np.random.default_rng(1)
    return hbr.Views.concatenate(
        [
            hbr.Views.of_object(f"o{i}", rng.integers(0, 8, (views, 144), np.uint8), np.arange(views) * 360 / views)
            for i in range(objects)
        ]
    )


def searching(known: hbr.Views, chosen: Strategy | str, *, seed: int = 0, **config: float) -> Search:
    settings = RigConfig(identify=IdentifyConfig(**config))  # type: ignore[arg-type]
    return begin_search(model_of(known), settings, chosen, seed=seed)


def added(
    search: Search, levels: np.ndarray, azimuth_deg: float, *, table_deg: float
) -> tuple[Ranked, Rotate | Finish]:
    search.add(DescribedView(dict.fromkeys(DESCRIPTORS, levels), None), azimuth_deg, table_deg=table_deg)
    return search.decide()


def run(chosen: Strategy | str, *, seed: int = 0, **config: float) -> tuple[list[Rotate], Finish, list[float]]:
    """Search with random queries; return the rotations, the end, and the orientations of the views."""
    search = searching(model(), chosen, seed=seed, **config)
    rng = np.random.default_rng(2)
    here_deg, taken_deg, rotations = 0.0, [], []
    while True:
        taken_deg.append(here_deg)
        levels = rng.integers(0, 8, 144, np.uint8)
        _, step = added(search, levels, here_deg % 360, table_deg=-here_deg)
        if isinstance(step, Finish):
            return rotations, step, taken_deg
        rotations.append(step)
        here_deg += step.rotation_deg


@pytest.mark.parametrize("name", PAPERS)
@examples(6)
@given(max_views=st.integers(1, 12), seed=st.integers(0, 3))
def test_every_strategy_takes_all_allowed_views_without_a_margin(name, max_views, seed):
    rotations, end, _ = run(name, seed=seed, max_views=max_views, min_views=1, margin=1.0)
    assert len(rotations) == max_views - 1
    assert end == Finish(StopReason.MAX_VIEWS)
    again, *_ = run(name, seed=seed, max_views=max_views, min_views=1, margin=1.0)
    assert again == rotations


def test_each_strategy_takes_its_rotations():
    sweep, _, _ = run("sweep", max_views=6, margin=1.0)
    assert [rotation.rotation_deg for rotation in sweep] == [60.0] * 5
    for name in ("random", "hbr"):
        rotations, _, taken_deg = run(name, max_views=8, margin=1.0)
        assert len({rotation.rotation_deg for rotation in rotations}) == 7
        apart = np.abs(wrap180(np.subtract.outer(taken_deg, taken_deg)))[~np.eye(8, dtype=bool)]
        assert apart.min() > 10
        assert run(name, max_views=8, margin=1.0, seed=1)[0] != rotations
    active, _, _ = run("ahbr", max_views=4, margin=1.0, first_step_deg=70.0)
    assert active[0] == Rotate(70.0, RotationReason.FIRST_STEP)
    assert all(rotation.s_left is not None and rotation.candidates for rotation in active[1:])


@pytest.mark.parametrize(("name", "views"), [("ahbr", 2), ("sweep", 2), ("random", 2), ("hbr", 5)])
def test_large_margin_ends_all_but_the_passive_search(name, views):
    known = model()
    search = searching(known, name, max_views=5)
    for number in range(views):
        ranked, step = added(search, known.descriptors[0], 0.0, table_deg=0.0)
        assert isinstance(step, Finish) == (number == views - 1)
    assert ranked.candidates[0].name == "o0"


def test_score_below_min_score_ends_no_search_early():
    known = model()
    search = searching(known, "sweep", max_views=5, min_score=1.0, margin=0.0)
    other = np.roll(known.descriptors[0], 1)
    steps = [added(search, other, 0.0, table_deg=0.0)[1] for _ in range(5)]
    assert [isinstance(step, Finish) for step in steps] == [False] * 4 + [True]


def test_the_tree_gives_the_same_answers():
    known = model(objects=9)
    for row in known.descriptors[::7]:
        found = []
        for index in ("flat", "tree"):
            search = searching(known, "ahbr", index=index)
            found.append(added(search, row, 0.0, table_deg=0.0)[0])
            assert search.index.method == index
        assert found[0] == found[1]


def test_empty_catalog_and_an_unknown_strategy_are_rejected():
    with pytest.raises(CatalogError, match="empty"):
        searching(hbr.Views.empty(), "ahbr")
    with pytest.raises(UsageError) as caught:
        strategy("swep")
    assert "sweep" in caught.value.next_step


def test_search_notices_until_its_next_view_that_the_platter_may_have_moved():
    known = model()
    search = searching(known, "sweep")
    for event in (moved(1, 90.0, 90.0), replace(moved(1, 90.0, 90.0), agrees=False)):
        search.notice(event)
        assert search._disturbed is (not event.agrees)
    added(search, known.descriptors[0], 0.0, table_deg=0.0)
    assert not search._disturbed


def test_hmm_ends_when_one_object_is_probable_enough():
    known = model()
    search = searching(known, "hmm", max_views=5)
    ranked, step = added(search, known.descriptors[0], 0.0, table_deg=0.0)
    assert step == Finish(StopReason.CONFIDENT)
    answer = search.answer()
    assert (answer.name, answer.outcome, answer.possible) == ("o0", hbr.Outcome.FOUND, ("o0",))
    assert answer.confidence == ranked.candidates[0].probability
    assert CONFIDENT <= answer.confidence <= 1
    assert ranked.candidates[0].score == 1
    assert sum(candidate.probability for candidate in ranked.candidates) == pytest.approx(1)


def test_hmm_between_twins_takes_the_view_of_least_risk_and_ends_ambiguous():
    one = model(objects=1)
    names = ("one", "other", "far")
    twins = [hbr.Views.of_object(name, one.descriptors, one.azimuth_deg) for name in names[:2]]
    far = hbr.Views.of_object("far", 7 - one.descriptors, one.azimuth_deg)
    known = hbr.Views.concatenate([*twins, far])
    search = searching(known, "hmm", max_views=3)
    belief = PoseModel(known)
    for place in range(3):
        levels, azimuth_deg = known.descriptors[3 * place], 90.0 * place
        _, step = added(search, levels, azimuth_deg, table_deg=-azimuth_deg)
        belief = update_poses(hbr.tanimoto(levels[None], known.descriptors)[0], azimuth_deg, belief)
        if place < 2:
            assert step == Rotate(belief.next_view().rotation_deg, RotationReason.LEAST_RISK)
    assert step == Finish(StopReason.MAX_VIEWS)
    answer = search.answer()
    assert (answer.outcome, answer.possible, answer.confidence) == (hbr.Outcome.AMBIGUOUS, ("one", "other"), None)
    assert (answer.pose_deg, answer.yaw_deg) == (180, 0)


def test_hmm_calls_an_object_unknown_by_the_threshold_of_the_paper():
    known = model()
    search = searching(known, "hmm", max_views=3, min_score=0.9)
    other = np.random.default_rng(9).integers(0, 8, 144, np.uint8)
    steps = [added(search, other, 40.0 * n, table_deg=-40.0 * n)[1] for n in range(3)]
    assert steps[-1] == Finish(StopReason.MAX_VIEWS)
    assert all(isinstance(step, Rotate) for step in steps[:-1])  # a low score ends no search early
    similar = hbr.tanimoto(other[None], known.descriptors)[0]
    answer = search.answer()
    assert answer.score == pytest.approx(
        similar[known.object_index == known.object_names.index(answer.candidates[0].name)].max()
    )
    assert (answer.name, answer.outcome, answer.possible) == (None, hbr.Outcome.UNKNOWN, ())


def test_hmm_rotates_only_as_far_as_the_cable_allows():
    known = model(objects=1)
    twin = hbr.Views.of_object("twin", known.descriptors, known.azimuth_deg)
    config = RigConfig(table=TableConfig(mode="pan", limits_deg=(-10.0, 60.0)))
    search = begin_search(model_of(hbr.Views.concatenate([known, twin])), config, "hmm")
    _, step = added(search, known.descriptors[0], 0.0, table_deg=0.0)
    target_deg = config.table.orientation_sign * step.rotation_deg
    assert -10 <= target_deg <= 60
    narrow = RigConfig(table=TableConfig(mode="pan", limits_deg=(-1.0, 1.0)))
    search = begin_search(model_of(hbr.Views.concatenate([known, twin])), narrow, "hmm")
    _, step = added(search, known.descriptors[0], 0.0, table_deg=0.0)
    assert step == Finish(StopReason.NO_ROTATION_LEFT)


def test_configuration_accepts_every_strategy_and_no_other_name():
    for name in BUILT_IN:
        assert IdentifyConfig(strategy=name).strategy == name
    with pytest.raises(ValidationError, match="strategy"):
        IdentifyConfig(strategy="golden")
