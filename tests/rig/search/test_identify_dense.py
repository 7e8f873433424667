"""The dense search on the simulated bench, with and without an empty-table image."""

from dataclasses import replace

import numpy as np
import pytest

import hbr
from hbr.core.angles import wrap180
from rig.catalog import Catalog
from rig.events.events import (
    Accepted,
    Decided,
    Identified,
    Moved,
    Note,
    NoteCode,
    Ranked,
    RotationReason,
    Started,
    Warned,
)
from rig.plans.enroll import enroll
from rig.plans.identify import identify
from rig.plans.photograph_table import photograph_table
from rig.search.model import load_model
from rig.views.description import BENCH_DESCRIPTOR
from tests.small import SMALL


@pytest.fixture(scope="module")
def shelf(tmp_path_factory):
    """Return the model of three objects that were enrolled without an empty-table image."""
    from rig.config import load_config
    from sim.bench import ShelfOperator, open_sim_bench
    from sim.objects.shelf import shelf as objects
    from sim.world import World

    with (
        open_sim_bench(load_config(None, SMALL), ShelfOperator(World(seed=1), objects())) as bench,
        Catalog.open(tmp_path_factory.mktemp("dense"), clock=bench.clock) as catalog,
    ):
        for name in ("lamp", "dice", "teapot"):
            list(enroll(bench, catalog, name, views=8))
        return load_model(catalog)


def with_table(model, image_bgr):
    """Return the model as if its objects had been enrolled with this empty-table image."""
    return replace(model, with_empty_table=True, empty_table=image_bgr)


def codes(started):
    return {note.code for note in started.notes}


def search(s, model, name, **options):
    s.operator.next_object = name
    events = list(identify(s.bench, model, **options))
    answer = events[-1]
    assert isinstance(answer, Identified)
    return events, answer


def test_objects_enrolled_without_an_empty_table_image_are_searched_without_one(simulated, shelf):
    s = simulated()
    events, answer = search(s, shelf, "dice")
    started = events[0]
    assert isinstance(started, Started)
    assert not codes(started)
    assert (started.strategy, started.descriptor, answer.name) == ("dense", BENCH_DESCRIPTOR, "dice")
    list(photograph_table(s.bench))
    events, answer = search(s, shelf, "dice")
    assert NoteCode.ENROLLED_WITHOUT_EMPTY_TABLE in codes(events[0])
    assert answer.name == "dice"
    assert all(e.segmentation["agreement"] is None for e in events if isinstance(e, Accepted))


@pytest.mark.nightly
def test_image_of_today_comes_before_the_image_of_the_enrollment(simulated, tmp_path):
    s = simulated()
    list(photograph_table(s.bench))
    with Catalog.open(tmp_path, clock=s.bench.clock) as catalog:
        for name in ("lamp", "teapot"):
            list(enroll(s.bench, catalog, name, views=6))
        model = load_model(catalog)
        events, answer = search(s, model, "lamp")
        assert not codes(events[0])
        assert answer.name == "lamp"
        another = simulated(seed=5)
        events, answer = search(another, model, "teapot")
        assert NoteCode.EMPTY_TABLE_OF_ENROLLMENT in codes(events[0])
        assert answer.name == "teapot"
        assert all(e.segmentation["agreement"] > 0.9 for e in events if isinstance(e, Accepted))
        list(enroll(another.bench, catalog, "mug-dots", views=3))
        mixed = load_model(catalog)
        assert mixed.notes[-1] == Note(NoteCode.MIXED_EMPTY_TABLE, {"objects": ["mug-dots"], "with_image": False})
        tables = {one.empty_table for name in ("lamp", "teapot") for one in catalog.object(name).complete.sessions}
        for table in tables:
            catalog.image_path(table).unlink()
        assert load_model(catalog).empty_table is None
        assert NoteCode.EMPTY_TABLE_MISSING in codes(search(another, load_model(catalog), "lamp")[0][0])


@pytest.mark.parametrize("shape", [(10, 10, 3), (480, 640, 3)])
def test_image_of_another_size_is_rejected_and_the_search_continues(simulated, shelf, shape):
    s = simulated()
    events, answer = search(s, with_table(shelf, np.full(shape, 90, np.uint8)), "lamp")
    assert answer.name == "lamp"
    issue = {"code": "empty-table-size", "table_px": [shape[1], shape[0]], "frame_px": [320, 240]}
    assert all(issue in e.segmentation["issues"] for e in events if isinstance(e, Accepted))


def test_image_of_another_bench_is_reported_once_and_not_used(simulated, shelf, monkeypatch):
    monkeypatch.setattr("hbr.dense.stopping.HOPELESS", 1.0)  # the search takes all its views
    s = simulated("identify.max_views=5")
    other = np.random.default_rng(0).integers(0, 256, (240, 320, 3), np.uint8)
    events, answer = search(s, with_table(shelf, other), "radio")
    (warned,) = [e for e in events if isinstance(e, Warned)]
    assert warned.index == 2
    assert warned.note.code is NoteCode.EMPTY_TABLE_CHANGED
    assert warned.note.values["problem"]["frames"] == 3
    assert answer.name is None
    assert len(answer.candidates) == 3


def test_decisions_name_their_candidates_and_stay_within_the_cable_budget(simulated, shelf):
    s = simulated("table.limits_deg=[-180, 185]")
    events, answer = search(s, shelf, "radio")
    decided = [e for e in events if isinstance(e, Decided)]
    _, *moves = [e for e in events if isinstance(e, Moved)]
    assert answer.name is None
    assert len(decided) == len(moves) == answer.views - 1 >= 1
    for event, move in zip(decided, moves, strict=True):
        assert move.commanded_deg == pytest.approx(event.target_deg)
        # The camera moves around the object against the table's rotation; whole revolutions unwind the cable.
        assert wrap180(move.rotation_encoder_deg + event.rotation_deg) == pytest.approx(0, abs=0.5)
        assert move.rotation_imu_deg == pytest.approx(move.rotation_encoder_deg, abs=4 * move.imu_sigma_deg + 0.3)
        assert -180 <= event.target_deg <= 185
        separates = event.reason is RotationReason.SEPARATES_CANDIDATES
        assert separates or event.reason in (RotationReason.NEW_SIDE, RotationReason.SEVERAL_POSES)
        assert len(event.candidates) == (2 if separates else 0)
        weighed = event.weighed
        assert weighed is not None
        assert event.rotation_deg in weighed.rotations_deg
        sums = [a + b for a, b in zip(weighed.confusion, weighed.cost, strict=True)]
        assert sums[weighed.rotations_deg.index(event.rotation_deg)] == min(sums)
    assert answer.travelled_deg == pytest.approx(sum(abs(e.rotation_encoder_deg) for e in moves))
    assert not s.bench.servo.read_condition().torque
    for ranked in (e for e in events if isinstance(e, Ranked)):
        probability = [c.probability for c in ranked.candidates]
        assert probability == sorted(probability, reverse=True)
        assert ranked.decision is not None
        assert sum(probability) + ranked.decision.not_enrolled == pytest.approx(1)


@pytest.mark.parametrize(
    ("name", "yaw_deg", "reason"),
    [("bottle-green", 300.0, RotationReason.SEVERAL_POSES), ("box-tissues", 0.0, RotationReason.NEW_SIDE)],
)
def test_a_new_side_is_viewed_for_one_object_only_if_no_second_one_is_likely(simulated, shelf, name, yaw_deg, reason):
    """All strong hypotheses may be poses of one round object while a second object has 41 %."""
    s = simulated()
    s.operator.yaw_deg = yaw_deg
    events, _ = search(s, shelf, name)
    ranked = [event for event in events if isinstance(event, Ranked)]
    decided = [event for event in events if isinstance(event, Decided) and not event.candidates]
    assert reason in {event.reason for event in decided}
    for event in decided:
        probability = [one.probability for one in ranked[event.index].candidates]
        leading = probability[0] / sum(probability)  # among the enrolled objects
        assert (leading >= 0.95) == (event.reason is RotationReason.NEW_SIDE)


def test_search_uses_the_gyro_when_the_platter_slips_a_little(simulated, shelf):
    s = simulated()
    s.operator.next_object = "radio"
    moves = []
    for event in identify(s.bench, shelf):
        if isinstance(event, Decided) and not moves[1:]:
            s.world.clock.call_at(s.world.clock.now_ns() + 500_000_000, lambda: s.world.slip(9.0, 0.2))
        if isinstance(event, Moved):
            moves.append(event)
        if isinstance(event, Accepted) and event.index == 1:
            off_deg = wrap180(event.azimuth_deg + s.world.table_deg())
    assert not moves[1].agrees
    assert off_deg == pytest.approx(0, abs=4 * moves[1].imu_sigma_deg)


def test_rotation_of_a_round_object_is_not_stated(simulated, shelf):
    s = simulated()
    s.operator.yaw_deg = 40.0
    answer = search(s, shelf, "lamp")[1]
    assert (answer.name, answer.outcome) == ("lamp", hbr.Outcome.FOUND)
    assert (answer.yaw_deg, answer.yaw_sigma_deg, answer.yaw_set_deg, answer.period_deg) == (None, None, (), 0.0)
    answer = search(s, shelf, "teapot")[1]
    assert answer.period_deg == 360.0
    assert abs(answer.yaw_deg - 40.0) <= 2 * answer.yaw_sigma_deg
