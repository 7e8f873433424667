"""Rules of the dense search: rehearsed, kept beside the catalog, noticed when they are of another one."""

import json
from dataclasses import replace
from math import isfinite, nan

import numpy as np
import pytest

import hbr
from rig.catalog import Catalog
from rig.config import RigConfig
from rig.core.errors import CatalogError, DescriptorOutdated, UsageError
from rig.events.events import Ranked
from rig.events.wording import verdict_words
from rig.search.model import Model, load_model, model_of
from rig.search.session import begin_search, judged
from rig.search.stopping_rules import FILE, UNPROMISED, digest, read_rules, rehearse, rules_of, write_rules
from rig.search.strategies import DenseSearchState, Finish, Rotate, reachable_turns, strategy

KIND = hbr.descriptor("edges+colours")
NOW = "2026-01-02T03:04:05Z"


def views_of(name: str, count: int, *, seed: int, changing: float = 0.35) -> hbr.Views:
    """Views that change a little from one to the next, around an object of its own."""
    rng = np.random.default_rng(seed)
    base = rng.integers(0, 256, KIND.size_bytes)
    turning = rng.random((8, KIND.size_bytes))
    levels = []
    for i in range(count):
        phase = np.cos(2 * np.pi * (i / count - np.arange(8) / 8))
        packed = np.where(np.tensordot(np.maximum(phase, 0), turning < changing / 4, 1) > 0.6, 255 - base, base)
        levels.append(KIND.unpack(packed.astype(np.uint8).tobytes()))
    return hbr.Views.of_object(name, np.array(levels), np.arange(count) * 360 / count, KIND.name)


def shelf(*counts: int) -> hbr.DenseIndex:
    return hbr.DenseIndex(
        hbr.Views.concatenate([views_of(f"object {j}", count, seed=j) for j, count in enumerate(counts)])
    )


def look_for(
    index: hbr.DenseIndex, rules: hbr.Rules, other: hbr.Views, *, max_views: int = 8
) -> tuple[str | None, int]:
    """Search with every third view of ``other``; return the name that was found, and after how many views."""
    config = RigConfig.model_validate({"identify": {"max_views": max_views}})
    search, _ = begin_search(Model(index, rules), config)
    ranked: Ranked
    here_deg, taken = 0.0, 0
    while True:
        nearest = np.abs((other.azimuth_deg - here_deg + 180) % 360 - 180).argmin()
        ranked, step = search.look(other.descriptors[nearest], here_deg % 360, table_deg=-here_deg)
        taken += 1
        if isinstance(step, Finish):
            return search.answer(ranked, step.why).name, taken
        here_deg += step.rotation_deg


def test_enough_searches_promise_what_is_asked_for():
    found = rehearse(shelf(*[18] * 12))
    assert found.rules.promises == ()
    assert found.rules.searches >= 100
    assert (found.wrong + 1) / (found.ended + 1) <= 0.01
    assert found.rejected / found.rules.searches <= 0.02
    assert 0.9 <= found.rules.certainty <= 1
    assert all(map(isfinite, found.rules.familiar))


@pytest.mark.parametrize(
    ("counts", "words"),
    [
        ([8], "one object has no rival"),
        ([1, 1, 1], "single view"),
        ([8, 8], "fewer than three objects"),
        ([8, 8, 8], "an error rate of 1.0% takes 100 rehearsed searches"),
        ([4, 4, 4], "a false-reject rate of 2.0% takes 49 rehearsed searches"),
        ([12, 4, 3, 12], "an error rate"),
    ],
)
def test_little_data_goes_without_promise_and_finds_all_the_same(counts, words):
    index = shelf(*counts)
    rules = rehearse(index).rules
    assert any(words in promise for promise in rules.promises)
    assert rules.certainty == UNPROMISED
    for j, count in enumerate(counts):
        assert look_for(index, rules, views_of(f"object {j}", count, seed=j))[0] == f"object {j}"
    stranger = views_of("stranger", 24, seed=99)
    name, taken = look_for(index, rules, stranger)
    if max(counts) > 1:  # otherwise nothing is known of how alike an object's views are
        assert name is None
    assert taken <= 8


def test_a_quick_rehearsal_looks_for_a_sample_and_says_so():
    index = shelf(*[3] * 400)
    rules = rehearse(index, quick=True).rules
    assert rules.searches < 400
    assert "of 400 objects were looked for" in rules.promises[0]
    assert len(rules.usual) == 400


@pytest.mark.parametrize(
    ("kind", "probability", "familiarity", "words"),
    [
        ("found", 0.97, 1.0, "a probability of 97.0% reaches 95.0% and a familiarity of 1.000 the 0.900 of enrolled"),
        ("found", 0.6, 1.0, "the best after 3 views, with a probability of 60.0%; 95.0% is sure"),
        ("look", 0.6, 1.0, "not sure yet: a probability of 60.0%, and 95.0% ends the search"),
        ("look", 0.9999, 0.8, "not familiar yet: 0.800, and enrolled objects reach 0.900"),
        ("unknown", 0.9999, 0.8, "a familiarity of 0.800 stays below the 0.900 that enrolled objects reach"),
    ],
)
def test_what_the_rules_say_is_said_with_its_numbers(kind, probability, familiarity, words):
    verdict = hbr.Verdict(kind, 0, probability, familiarity, "")
    assert verdict_words(verdict, certainty=0.95, least=0.9, views=3).startswith(words)
    if kind == "found":
        assert "familiarity" not in verdict_words(verdict, certainty=0.95, least=float("-inf"), views=3)


def test_an_error_rate_that_look_alikes_forbid_is_not_promised():
    views = [views_of(f"object {j}", 18, seed=j) for j in range(6)]
    rng = np.random.default_rng(0)
    shuffled = hbr.Views.concatenate(views)  # each view says another object
    index = hbr.DenseIndex(
        hbr.Views(
            rng.permutation(shuffled.descriptors),
            shuffled.azimuth_deg,
            shuffled.object_index,
            shuffled.object_names,
            KIND.name,
        )
    )
    found = rehearse(index)
    assert found.rules.certainty == UNPROMISED
    assert any("look too much alike" in promise for promise in found.rules.promises)


def test_what_strangers_are_taken_for_is_named():
    alike = [views_of("one", 18, seed=1), views_of("two", 18, seed=1, changing=0.45), views_of("three", 18, seed=2)]
    found = rehearse(hbr.DenseIndex(hbr.Views.concatenate([*alike, views_of("four", 18, seed=3)])))
    assert set(found.taken_for) <= {("one", "two"), ("two", "one")}
    assert bool(found.taken_for) == bool(found.accepted)


def test_rules_come_back_as_they_were_kept(tmp_path):
    for number, counts in enumerate(([8], [8, 8], [18] * 6)):
        index = shelf(*counts)
        rules = rehearse(index).rules
        folder = tmp_path / str(number)
        folder.mkdir()
        assert read_rules(folder) is None
        write_rules(folder / FILE, rules, index, made_utc=NOW)
        stored = read_rules(folder)
        assert stored is not None
        assert (stored.sha256, stored.made_utc) == (digest(index), NOW)
        again = stored.adapted(index.views)
        np.testing.assert_array_equal(again.usual, rules.usual)
        for name in ("beta", "certainty", "familiar", "error_rate", "false_reject", "searches", "promises"):
            assert getattr(again, name) == getattr(rules, name)
        assert again.false_accept == pytest.approx(rules.false_accept, nan_ok=True)


@pytest.mark.parametrize(
    "content", [b"", b"[]", b'{"format": "other"}', b'{"format": "hbr-rig search rules"}', b"\xff"]
)
def test_damaged_rules_are_told_and_not_used(tmp_path, content):
    index = shelf(8, 8, 8)
    (tmp_path / FILE).write_bytes(content)
    with pytest.raises(CatalogError, match="cannot be read"):
        read_rules(tmp_path)
    rules, notes = rules_of(tmp_path, index)
    assert rules.searches
    assert "rig catalog calibrate makes them anew" in notes[0]


def test_rules_of_a_catalog_that_has_changed(tmp_path, monkeypatch):
    before, after = shelf(*[18] * 8), shelf(*[18] * 9)
    kept = rehearse(before, error_rate=0.05, false_reject=0.1).rules
    write_rules(tmp_path / FILE, kept, before, made_utc=NOW)
    assert rules_of(tmp_path, before)[1] == ()
    assert rules_of(tmp_path, before)[0].familiar == kept.familiar
    renewed, _ = rules_of(tmp_path, after)  # quick enough: rehearsed anew, for the rates that were asked for
    assert (renewed.error_rate, renewed.false_reject) == (0.05, 0.1)
    assert renewed.usual.shape[0] == 9
    assert renewed.familiar != kept.familiar
    monkeypatch.setattr("rig.search.stopping_rules._QUICK_S", 0.0)
    old, notes = rules_of(tmp_path, after)  # too many to rehearse while somebody waits
    assert old.familiar == kept.familiar
    np.testing.assert_array_equal(old.usual[:8], kept.usual)
    np.testing.assert_array_equal(old.usual[8], np.median(kept.usual, axis=0))
    assert "1 object more" in notes[0]
    assert "rig catalog calibrate renews them" in notes[0]
    others = hbr.DenseIndex(hbr.Views.concatenate([views_of(f"thing {j}", 18, seed=j) for j in range(9)]))
    own, _ = rules_of(tmp_path, others)  # the rules are of another catalog
    assert own.familiar != kept.familiar
    assert (own.error_rate, own.false_reject) == (0.05, 0.1)


def test_a_digest_is_of_all_that_decides():
    index = shelf(8, 8)
    views = index.views
    moved = hbr.Views(views.descriptors, views.azimuth_deg + 1, views.object_index, views.object_names, KIND.name)
    renamed = hbr.Views(views.descriptors, views.azimuth_deg, views.object_index, ("a", "b"), KIND.name)
    others = [hbr.DenseIndex(moved), hbr.DenseIndex(renamed), hbr.DenseIndex(views, power=1.0), shelf(8, 9)]
    assert len({digest(one) for one in (index, *others)}) == 5
    assert digest(shelf(8, 8)) == digest(index)


def test_turns_stay_within_the_cable_and_take_the_time_of_the_way_they_go():
    config = RigConfig()
    turns, seconds = reachable_turns(config, 0.0)
    np.testing.assert_array_equal(turns, np.delete(np.arange(-175.0, 181.0, 5.0), 35))
    assert seconds.min() > 0
    wound, long = reachable_turns(config, 390.0)  # + turns the camera's way lead beyond 400°: the long way round
    left, right = (np.flatnonzero(wound == turn)[0] for turn in (-90.0, 90.0))
    assert len(wound) == 71
    assert long[left] == pytest.approx(long[right] + 2)  # 270° against 90°, at 90° a second
    pan = RigConfig.model_validate({"table": {"mode": "pan", "limits_deg": [-60, 60]}})
    few, _ = reachable_turns(pan, 60.0)
    assert few.min() >= 0
    assert few.max() <= 120
    assert set(few) == set(np.arange(5.0, 121.0, 5.0))


class Around:
    """Somebody else's, on the dense search: to the far side, always."""

    name = "around"
    descriptor = "edges+colours"

    def next(self, look: DenseSearchState) -> Rotate | Finish:
        return Finish("enough") if look.views == 3 else Rotate(180.0, f"the far side; {look.verdict.words}")


def test_a_strategy_of_ones_own_decides_on_the_dense_search():
    index = shelf(12, 12, 12)
    model = Model(index, rehearse(index).rules)
    search, chosen = begin_search(model, RigConfig(), Around())
    assert chosen.name == "around"
    for number in range(3):
        ranked, step = search.look(index.views.descriptors[6 * (number % 2)], 180.0 * number % 360, table_deg=0.0)
    assert isinstance(step, Finish)
    assert search.answer(ranked, step.why).name == "object 0"
    assert sum(c.probability or nan for c in ranked.candidates) == pytest.approx(1)


def test_a_strategy_and_a_model_that_do_not_go_together_are_said():
    index = shelf(8, 8)
    dense, papers = Model(index, rehearse(index).rules), hbr.ViewIndex(hbr.Views.of_object("a", *_cedd()))
    for model, name in ((dense, "ahbr"), (papers, "dense"), (papers, Around())):
        with pytest.raises(UsageError, match="compares views by") as caught:
            begin_search(model, RigConfig(), name)
        assert "load_model" in caught.value.next_step
    assert begin_search(dense, RigConfig())[1].name == "dense"
    assert begin_search(papers, RigConfig())[1].name == "ahbr"
    with pytest.raises(ValueError, match="needs rules"):
        Model(index)
    with pytest.raises(CatalogError, match="empty"):
        begin_search(model_of(hbr.Views.empty()), RigConfig(), strategy("dense"))


def _cedd() -> tuple[np.ndarray, np.ndarray]:
    return np.random.default_rng(0).integers(0, 8, (4, 144), np.uint8), np.arange(4) * 90.0


def test_a_cable_that_leaves_no_turn_ends_the_search():
    index = shelf(8, 8, 8)
    config = RigConfig.model_validate({"table": {"mode": "pan", "limits_deg": [-1, 1]}})
    search, _ = begin_search(Model(index, rehearse(index).rules), config)
    stranger = views_of("stranger", 8, seed=5)
    _, step = search.look(stranger.descriptors[0], 0.0, table_deg=0.0)
    assert step == Finish("the cable leaves no other view")


def test_unknown_is_said_after_the_rehearsed_views_and_looking_goes_on_where_it_is_likely():
    index = shelf(*[18] * 8)
    rules = rehearse(index).rules
    assert len(rules.familiar) == 4
    assert look_for(index, rules, views_of("stranger", 18, seed=77), max_views=8) == (None, 4)
    assert look_for(index, rules, views_of("stranger", 18, seed=77), max_views=2) == (None, 2)


@pytest.mark.parametrize(
    ("familiar", "views", "max_views", "kind"),
    [
        ((0.0, 0.0, 0.0), 1, 8, "found"),
        ((0.0, 9.0, 9.0), 1, 8, "look"),  # familiar enough for one view, and not for three
        ((0.0, 9.0, 9.0), 1, 1, "found"),  # but no more views are allowed
        ((0.0, 9.0, 9.0), 2, 8, "look"),
        ((0.0, 9.0, 9.0), 3, 8, "unknown"),
        ((0.0, 0.0, 0.0), 3, 8, "found"),
        ((9.0,), 1, 8, "unknown"),
    ],
)
def test_a_first_glance_must_be_as_familiar_as_all_rehearsed_views(familiar, views, max_views, kind):
    index = shelf(12, 12, 12)
    rules = replace(rehearse(index).rules, familiar=familiar, usual=np.zeros((3, len(familiar))))
    belief: hbr.Belief | hbr.DenseIndex = index
    for number in range(views):
        belief = hbr.update_belief(index.views.descriptors[4 * number], 120.0 * number, belief)
    assert isinstance(belief, hbr.Belief)
    verdict, _ = judged(belief, rules, max_views=max_views)
    assert verdict.kind == kind


def test_a_catalog_is_searched_by_the_paper_where_objects_lack_the_descriptor(sim_catalog_of_both):
    catalog, lacking = sim_catalog_of_both
    model = load_model(catalog)
    assert isinstance(model.index, hbr.DenseIndex)
    assert model.rules is not None
    lacking()
    model = load_model(catalog)
    assert isinstance(model.index, hbr.ViewIndex)
    assert "rig catalog redescribe --descriptor edges+colours" in model.notes[0]
    with pytest.raises(DescriptorOutdated) as caught:
        load_model(catalog, descriptor="edges+colours")
    assert "redescribe" in caught.value.next_step
    assert load_model(catalog, descriptor="cedd").notes == ()


@pytest.fixture
def sim_catalog_of_both(tmp_path, simulated):
    """Return a catalog of two objects by both descriptors, and what takes the bench's own from one view."""
    import sqlite3
    from contextlib import closing

    from rig.plans.enroll import enroll

    s = simulated("camera.width=320", "camera.height=240", "view.roi=[40, 0, 240, 240]")
    with Catalog.open(tmp_path / "catalog", clock=s.bench.clock) as catalog:
        for name in ("lamp", "dice"):
            list(enroll(s.bench, catalog, name, views=6))

        def lacking() -> None:
            with closing(sqlite3.connect(tmp_path / "catalog" / "catalog.sqlite")) as database, database:
                database.execute("DELETE FROM descriptors WHERE name != 'cedd' AND view_id = 1")

        yield catalog, lacking


def test_stored_rules_are_readable(tmp_path):
    index = shelf(8, 8, 8)
    write_rules(tmp_path / FILE, rehearse(index).rules, index, made_utc=NOW)
    values = json.loads((tmp_path / FILE).read_text(encoding="utf-8"))
    assert values["model"]["objects"] == 3
    assert list(values["usual"]) == ["object 0", "object 1", "object 2"]
    assert values["made_utc"] == NOW
