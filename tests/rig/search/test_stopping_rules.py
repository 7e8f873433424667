"""The stopping rule of a catalog: fitted, stored beside it, and renewed when the catalog changes."""

import json
from dataclasses import replace
from math import isfinite, nan

import numpy as np
import pytest
from sqlalchemy import delete

import hbr
from hbr.dense.fitting import UNFITTED_MIN_CONFIDENCE
from hbr.dense.leave_one_out import leave_one_out
from hbr.dense.stopping import LimitationCode
from rig.catalog import Catalog
from rig.catalog.facts import Derived
from rig.config import RigConfig
from rig.core.errors import CatalogError, UsageError
from rig.core.next_steps import Do
from rig.events.events import NoteCode
from rig.plans.enroll import enroll
from rig.search.model import Model, begin_search, load_model, model_of
from rig.search.stopping_rules import (
    FILE,
    digest,
    quick_stopping_rule,
    read_stopping_rule,
    stopping_rule_of,
    write_stopping_rule,
)
from rig.search.strategies import DenseSearchState, Finish, Rotate, reachable_rotations, strategy
from tests.rig.search.views import seen

KIND = hbr.descriptor("edges+colours")
NOW = "2026-01-02T03:04:05Z"


def views_of(name: str, count: int, *, seed: int, changing: float = 0.35) -> hbr.Views:
    """Return views of an object that change a little from one to the next."""
    rng = np.random.default_rng(seed)
    base = rng.integers(0, 256, KIND.size_bytes)
    rotating = rng.random((8, KIND.size_bytes))
    levels = []
    for i in range(count):
        phase = np.cos(2 * np.pi * (i / count - np.arange(8) / 8))
        packed = np.where(np.tensordot(np.maximum(phase, 0), rotating < changing / 4, 1) > 0.6, 255 - base, base)
        levels.append(KIND.unpack(packed.astype(np.uint8).tobytes()))
    return hbr.Views.of_object(name, np.array(levels), np.arange(count) * 360 / count, KIND.name)


def shelf(*counts: int) -> hbr.DenseIndex:
    return hbr.DenseIndex(
        hbr.Views.concatenate([views_of(f"object {j}", count, seed=j) for j, count in enumerate(counts)])
    )


def search_for(
    index: hbr.DenseIndex, rule: hbr.StoppingRule, other: hbr.Views, *, max_views: int = 8
) -> tuple[str | None, int]:
    """Search with the nearest views of ``other``; return the name that was found, and the number of views."""
    config = RigConfig.model_validate({"identify": {"max_views": max_views}})
    search = begin_search(Model(index, rule), config)
    here_deg, taken = 0.0, 0
    while True:
        nearest = np.abs((other.azimuth_deg - here_deg + 180) % 360 - 180).argmin()
        _, step = search.add(seen(other.descriptors[nearest]), here_deg % 360, table_deg=-here_deg)
        taken += 1
        if isinstance(step, Finish):
            return search.answer().name, taken
        here_deg += step.rotation_deg


def codes(rule: hbr.StoppingRule) -> list[LimitationCode]:
    return [one.code for one in rule.limitations]


def test_enough_searches_guarantee_the_rates():
    found = hbr.fit_stopping_rule(shelf(*[18] * 12))
    assert found.rule.limitations == ()
    assert found.rule.searches >= 100
    assert (found.wrong + 1) / (found.ended + 1) <= 0.01
    assert found.rejected / found.rule.searches <= 0.02
    assert 0.9 <= found.rule.min_confidence <= 1
    assert all(map(isfinite, found.rule.open_set_thresholds))


@pytest.mark.parametrize(
    ("counts", "code"),
    [
        ([8], LimitationCode.ONE_OBJECT),
        ([1, 1, 1], LimitationCode.SINGLE_VIEWS),
        ([8, 8], LimitationCode.UNKNOWN_NOT_MEASURED),
        ([8, 8, 8], LimitationCode.ERROR_RATE),
        ([4, 4, 4], LimitationCode.FALSE_REJECT_RATE),
        ([12, 4, 3, 12], LimitationCode.ERROR_RATE),
    ],
)
def test_little_data_guarantees_nothing_and_still_finds_objects(counts, code):
    index = shelf(*counts)
    rule = hbr.fit_stopping_rule(index).rule
    assert code in codes(rule)
    assert rule.min_confidence == UNFITTED_MIN_CONFIDENCE
    for j, count in enumerate(counts):
        assert search_for(index, rule, views_of(f"object {j}", count, seed=j))[0] == f"object {j}"
    name, taken = search_for(index, rule, views_of("unknown", 24, seed=99))
    if max(counts) > 1:  # with single views, no object is called unknown
        assert name is None
    assert taken <= 8


def test_quick_fit_of_a_large_catalog_searches_for_a_sample():
    rule = quick_stopping_rule(shelf(*[3] * 400))
    assert rule.searches < 400
    assert rule.limitations[0].code is LimitationCode.SAMPLED
    assert rule.limitations[0].values["objects"] == 400
    assert len(rule.usual_scores) == 400


def test_similar_objects_prevent_an_error_rate():
    views = [views_of(f"object {j}", 18, seed=j) for j in range(6)]
    rng = np.random.default_rng(0)
    shuffled = hbr.Views.concatenate(views)  # each view is one of any object
    index = hbr.DenseIndex(
        hbr.Views(
            rng.permutation(shuffled.descriptors),
            shuffled.azimuth_deg,
            shuffled.object_index,
            shuffled.object_names,
            KIND.name,
        )
    )
    rule = hbr.fit_stopping_rule(index).rule
    assert rule.min_confidence == UNFITTED_MIN_CONFIDENCE
    assert LimitationCode.SIMILAR_OBJECTS in codes(rule)


def test_confused_objects_are_named():
    twins = [views_of("one", 18, seed=1), views_of("two", 18, seed=1, changing=0.45), views_of("three", 18, seed=2)]
    found = hbr.fit_stopping_rule(hbr.DenseIndex(hbr.Views.concatenate([*twins, views_of("four", 18, seed=3)])))
    assert set(found.confused) <= {("one", "two"), ("two", "one")}
    # also if another object scores more than the searched one, which is the likeliest by its probability
    searches = leave_one_out(hbr.DenseIndex(hbr.Views.concatenate(twins)))
    leading = replace(searches.known, object_index=searches.unknown.object_index)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("hbr.dense.leave_one_out.leave_one_out", lambda *_, **__: replace(searches, known=leading))
        again = hbr.fit_stopping_rule(hbr.DenseIndex(hbr.Views.concatenate(twins)), false_reject=0.4)
    assert again.confused
    assert all(one != other for one, other in again.confused)
    assert bool(found.confused) == bool(found.accepted)


def same(one: hbr.StoppingRule, other: hbr.StoppingRule) -> bool:
    np.testing.assert_array_equal(one.usual_scores, other.usual_scores)
    assert one.false_accept == pytest.approx(other.false_accept, nan_ok=True)
    names = ("beta", "min_confidence", "open_set_thresholds", "error_rate", "false_reject", "searches", "limitations")
    return all(getattr(one, name) == getattr(other, name) for name in names)


def test_stored_rules_are_read_as_they_were_written(tmp_path):
    for number, counts in enumerate(([8], [8, 8], [18] * 6)):
        index = shelf(*counts)
        rule = hbr.fit_stopping_rule(index).rule
        folder = tmp_path / str(number)
        folder.mkdir()
        assert read_stopping_rule(folder) is None
        write_stopping_rule(folder / FILE, rule, index, made_utc=NOW)
        stored = read_stopping_rule(folder)
        assert stored is not None
        assert (stored.sha256, stored.made_utc) == (digest(index), NOW)
        assert same(stored.adapted(index.views), rule)


def test_rule_of_another_version_or_without_a_value_is_fitted_again(tmp_path):
    index = shelf(8, 8, 8)
    write_stopping_rule(tmp_path / FILE, hbr.fit_stopping_rule(index).rule, index, made_utc=NOW)
    values = json.loads((tmp_path / FILE).read_text())
    assert read_stopping_rule(tmp_path) is not None
    for changed, reason in (
        (values | {"version": values["version"] + 1}, "another version of the program wrote it"),
        ({key: value for key, value in values.items() if key != "leave_one_out_thresholds"}, "leave_one_out"),
    ):
        (tmp_path / FILE).write_text(json.dumps(changed))
        with pytest.raises(CatalogError, match="cannot be read") as caught:
            read_stopping_rule(tmp_path)
        assert reason in caught.value.evidence["reason"]
        assert caught.value.steps == (Do.FIT_STOPPING_RULE(),)
        assert stopping_rule_of(tmp_path, index)[1][0].code is NoteCode.STOPPING_RULE_UNREADABLE


@pytest.mark.parametrize(
    "content", [b"", b"[]", b'{"format": "other"}', b'{"format": "hbr-rig search rules"}', b"\xff"]
)
def test_damaged_rule_is_reported_and_not_used(tmp_path, content):
    index = shelf(8, 8, 8)
    (tmp_path / FILE).write_bytes(content)
    with pytest.raises(CatalogError, match="cannot be read"):
        read_stopping_rule(tmp_path)
    rule, notes = stopping_rule_of(tmp_path, index)
    assert rule.searches
    assert notes[0].code is NoteCode.STOPPING_RULE_UNREADABLE


def test_rule_of_a_changed_catalog_is_fitted_again_or_used_with_a_note(tmp_path, monkeypatch):
    before, after = shelf(*[18] * 8), shelf(*[18] * 9)
    stored = hbr.fit_stopping_rule(before, error_rate=0.05, false_reject=0.1).rule
    write_stopping_rule(tmp_path / FILE, stored, before, made_utc=NOW)
    rule, notes = stopping_rule_of(tmp_path, before)
    assert (rule.open_set_thresholds, notes) == (stored.open_set_thresholds, ())
    # A small catalog gets a new rule, for the rates that were asked for.
    renewed, _ = stopping_rule_of(tmp_path, after)
    assert (renewed.error_rate, renewed.false_reject) == (0.05, 0.1)
    assert renewed.usual_scores.shape[0] == 9
    assert renewed.open_set_thresholds != stored.open_set_thresholds
    # A large one keeps its rule; new objects count as typical.
    monkeypatch.setattr("rig.search.stopping_rules._QUICK_S", 0.0)
    old, notes = stopping_rule_of(tmp_path, after)
    assert old.open_set_thresholds == stored.open_set_thresholds
    np.testing.assert_array_equal(old.usual_scores[:8], stored.usual_scores)
    np.testing.assert_array_equal(old.usual_scores[8], np.median(stored.usual_scores, axis=0))
    assert notes[0].code is NoteCode.STOPPING_RULE_OUTDATED
    assert notes[0].values == {"made": NOW[:10], "added": 1, "removed": 0}
    # A rule of another catalog is not used.
    others = hbr.DenseIndex(hbr.Views.concatenate([views_of(f"thing {j}", 18, seed=j) for j in range(9)]))
    own, _ = stopping_rule_of(tmp_path, others)
    assert own.open_set_thresholds != stored.open_set_thresholds
    assert (own.error_rate, own.false_reject) == (0.05, 0.1)


def test_digest_changes_with_everything_that_the_rule_depends_on():
    index = shelf(8, 8)
    views = index.views
    moved = hbr.Views(views.descriptors, views.azimuth_deg + 1, views.object_index, views.object_names, KIND.name)
    renamed = hbr.Views(views.descriptors, views.azimuth_deg, views.object_index, ("a", "b"), KIND.name)
    others = [hbr.DenseIndex(moved), hbr.DenseIndex(renamed), hbr.DenseIndex(views, omega=1.0), shelf(8, 9)]
    assert len({digest(one) for one in (index, *others)}) == 5
    assert digest(shelf(8, 8)) == digest(index)


def test_rotations_stay_within_the_cable_budget():
    config = RigConfig()
    rotations, seconds = reachable_rotations(config, 0.0)
    np.testing.assert_array_equal(rotations, np.delete(np.arange(-175.0, 181.0, 5.0), 35))
    assert seconds.min() > 0
    wound, long = reachable_rotations(config, 390.0)  # + turns the camera's way lead beyond 400°: the long way round
    left, right = (np.flatnonzero(wound == rotation)[0] for rotation in (-90.0, 90.0))
    assert len(wound) == 71
    assert long[left] == pytest.approx(long[right] + 2)  # 270° against 90°, at 90° a second
    pan = RigConfig.model_validate({"table": {"mode": "pan", "limits_deg": [-60, 60]}})
    few, _ = reachable_rotations(pan, 60.0)
    assert few.min() >= 0
    assert few.max() <= 120
    assert set(few) == set(np.arange(5.0, 121.0, 5.0))


class Around:
    """A custom strategy on the dense search: always rotates to the far side."""

    name = "around"
    descriptor = "edges+colours"

    def next(self, state: DenseSearchState) -> Rotate | Finish:
        return Finish(note="enough") if state.views == 3 else Rotate(180.0, note=state.decision.reason)


def test_custom_strategy_decides_on_the_dense_search():
    index = shelf(12, 12, 12)
    model = Model(index, hbr.fit_stopping_rule(index).rule)
    search = begin_search(model, RigConfig(), Around())
    assert search.strategy.name == "around"
    for number in range(3):
        ranked, step = search.add(seen(index.views.descriptors[6 * (number % 2)]), 180.0 * number % 360, table_deg=0.0)
    assert isinstance(step, Finish)
    assert search.answer().name == "object 0"
    assert sum(c.probability or nan for c in ranked.candidates) == pytest.approx(1)


def test_strategy_that_does_not_fit_the_model_is_rejected():
    index = shelf(8, 8)
    dense, papers = (
        Model(index, hbr.fit_stopping_rule(index).rule),
        model_of(hbr.Views.of_object("a", *_cedd())),
    )
    for model, name in ((dense, "ahbr"), (papers, "dense"), (papers, Around())):
        with pytest.raises(UsageError, match="needs views by") as caught:
            begin_search(model, RigConfig(), name)
        assert "load_model" in caught.value.next_step
    assert begin_search(dense, RigConfig()).strategy.name == "dense"
    assert begin_search(papers, RigConfig()).strategy.name == "ahbr"
    with pytest.raises(CatalogError, match="empty"):
        begin_search(model_of(hbr.Views.empty()), RigConfig(), strategy("dense"))


def _cedd() -> tuple[np.ndarray, np.ndarray]:
    return np.random.default_rng(0).integers(0, 8, (4, 144), np.uint8), np.arange(4) * 90.0


def test_search_ends_if_the_cable_allows_no_rotation():
    index = shelf(8, 8, 8)
    config = RigConfig.model_validate({"table": {"mode": "pan", "limits_deg": [-1, 1]}})
    search = begin_search(Model(index, hbr.fit_stopping_rule(index).rule), config)
    unknown = views_of("unknown", 8, seed=5)
    _, step = search.add(seen(unknown.descriptors[0]), 0.0, table_deg=0.0)
    assert step == Finish(hbr.StopReason.NO_ROTATION_LEFT)


def test_unknown_objects_end_after_the_fitted_views():
    index = shelf(*[18] * 8)
    rule = hbr.fit_stopping_rule(index).rule
    assert len(rule.open_set_thresholds) == 4
    assert search_for(index, rule, views_of("unknown", 18, seed=77), max_views=8) == (None, 4)
    assert search_for(index, rule, views_of("unknown", 18, seed=77), max_views=2) == (None, 2)


def test_views_without_a_description_are_described_before_a_search(tmp_path, simulated):
    s = simulated()
    with Catalog.open(tmp_path / "catalog", clock=s.bench.clock) as catalog:
        for name in ("lamp", "dice"):
            list(enroll(s.bench, catalog, name, views=6))
        before = load_model(catalog)
        assert isinstance(before.index, hbr.DenseIndex)
        with catalog.database.write() as transaction:
            transaction.execute(delete(Derived))
        progress = []
        model = load_model(catalog, progress=progress.append)
        assert np.array_equal(model.views.descriptors, before.views.descriptors)
        assert (model.notes, progress[-1].done) == (before.notes, 2)
        paper = load_model(catalog, descriptor="cedd")
        assert isinstance(paper.index, hbr.ViewIndex)
        assert (paper.rule, paper.notes) == (None, ())


def test_stored_rules_are_readable_json(tmp_path):
    index = shelf(8, 8, 8)
    write_stopping_rule(tmp_path / FILE, hbr.fit_stopping_rule(index).rule, index, made_utc=NOW)
    values = json.loads((tmp_path / FILE).read_text(encoding="utf-8"))
    assert values["model"]["objects"] == 3
    assert list(values["usual_scores"]) == ["object 0", "object 1", "object 2"]
    assert values["made_utc"] == NOW
