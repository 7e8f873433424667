"""Strategies of a search: what they do, how they stop, and how others plug in."""

from importlib.metadata import EntryPoint

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import hbr
from hbr.core.angles import wrap180
from rig.config import IdentifyConfig, RigConfig
from rig.core.errors import CatalogError, UsageError
from rig.search import strategies
from rig.search.session import Search, begin_search
from rig.search.strategies import Finish, Rotate, SearchState, Strategy, enough, strategy

PAPERS = ["ahbr", "hbr", "sweep", "random"]


def model(objects: int = 4, views: int = 12) -> hbr.Views:
    rng = np.random.default_rng(1)
    return hbr.Views.concatenate(
        [
            hbr.Views.of_object(f"o{i}", rng.integers(0, 8, (views, 144), np.uint8), np.arange(views) * 360 / views)
            for i in range(objects)
        ]
    )


def searching(known: hbr.Views, chosen: Strategy | str, *, seed: int = 0, top: int = 5, **config: float) -> Search:
    settings = RigConfig(identify=IdentifyConfig(**config))  # type: ignore[arg-type]
    return begin_search(hbr.ViewIndex(known), settings, chosen, seed=seed, top=top)[0]


def run(chosen: Strategy | str, *, seed: int = 0, **config: float) -> tuple[list[Rotate], Finish, list[float]]:
    """Search with queries that fit nothing; return the turns, the stop, and where the views were taken."""
    search = searching(model(), chosen, seed=seed, **config)
    rng = np.random.default_rng(2)
    here_deg, taken_deg, turns = 0.0, [], []
    while True:
        taken_deg.append(here_deg)
        levels = rng.integers(0, 8, 144, np.uint8)
        _, step = search.look(levels, here_deg % 360, table_deg=-here_deg)
        if isinstance(step, Finish):
            return turns, step, taken_deg
        turns.append(step)
        here_deg += step.rotation_deg


@pytest.mark.parametrize("name", PAPERS)
@settings(max_examples=25)
@given(max_views=st.integers(1, 12), seed=st.integers(0, 3))
def test_every_strategy_takes_all_views_that_are_allowed_where_nothing_is_clear(name, max_views, seed):
    turns, stop, _ = run(name, seed=seed, max_views=max_views, min_views=1, margin=1.0)
    assert len(turns) == max_views - 1
    assert stop.why == f"{max_views} views were taken"
    assert all(turn.why for turn in turns)
    again, *_ = run(name, seed=seed, max_views=max_views, min_views=1, margin=1.0)
    assert again == turns


def test_what_each_strategy_does():
    sweep, _, _ = run("sweep", max_views=6, margin=1.0)
    assert [turn.rotation_deg for turn in sweep] == [60.0] * 5
    for name in ("random", "hbr"):
        turns, _, taken_deg = run(name, max_views=8, margin=1.0)
        assert len({turn.rotation_deg for turn in turns}) == 7
        apart = np.abs(wrap180(np.subtract.outer(taken_deg, taken_deg)))[~np.eye(8, dtype=bool)]
        assert apart.min() > 10
        assert run(name, max_views=8, margin=1.0, seed=1)[0] != turns
    active, _, _ = run("ahbr", max_views=4, margin=1.0, first_step_deg=70.0)
    assert active[0] == Rotate(70.0, "the first turn is fixed")
    assert all(turn.s_left is not None and turn.rivals for turn in active[1:])


@pytest.mark.parametrize(("name", "views"), [("ahbr", 2), ("sweep", 2), ("random", 2), ("hbr", 5)])
def test_a_clear_answer_ends_all_but_the_passive_search(name, views):
    known = model()
    search = searching(known, name, max_views=5)
    for number in range(views):
        ranked, step = search.look(known.descriptors[0], 0.0, table_deg=0.0)
        assert isinstance(step, Finish) == (number == views - 1)
    assert ranked.candidates[0].name == "o0"


def test_an_unknown_object_is_not_clear_however_far_it_leads():
    known = model()
    search = searching(known, "sweep", max_views=5, min_score=1.0, margin=0.0)
    other = np.roll(known.descriptors[0], 1)
    steps = [search.look(other, 0.0, table_deg=0.0)[1] for _ in range(5)]
    assert [isinstance(step, Finish) for step in steps] == [False] * 4 + [True]


def test_only_so_many_candidates_are_named_as_asked():
    known = model(objects=9)
    for top in (1, 3, 9):
        search = searching(known, "ahbr", list_length=200, top=top)
        ranked, _ = search.look(known.descriptors[0], 0.0, table_deg=0.0)
        assert len(ranked.candidates) == top


def test_an_empty_catalog_and_an_unknown_strategy_are_said():
    with pytest.raises(CatalogError, match="empty"):
        searching(hbr.Views.empty(), "ahbr")
    with pytest.raises(UsageError) as caught:
        strategy("swep")
    assert "sweep" in caught.value.next_step


class Once:
    """Somebody else's: one view is enough."""

    name = "once"

    def next(self, look: SearchState) -> Rotate | Finish:
        return enough(look) or Finish(f"one view says it: {look.ranking.names[0]}, {look.table_deg:g}")


def test_others_plug_in_by_an_entry_point(monkeypatch):
    broken = EntryPoint("broken", "no.such.module:Thing", strategies.GROUP)
    mine = EntryPoint("once", f"{__name__}:Once", strategies.GROUP)
    monkeypatch.setattr(strategies, "entry_points", lambda **_: [broken, mine])
    assert strategies.names() == ["dense", "ahbr", "hbr", "sweep", "random", "broken", "once"]
    turns, stop, _ = run("once")
    assert turns == []
    assert stop.why.startswith("one view says it")
    with pytest.raises(UsageError, match="cannot be loaded"):
        strategy("broken")
