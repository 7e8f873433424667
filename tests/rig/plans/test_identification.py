"""Identifications of objects on the simulated bench: poses, unknown objects, slipping platters."""

import numpy as np
import pytest

import hbr
from hbr.core.angles import wrap180
from rig.catalog import Catalog, derived
from rig.config import load_config
from rig.core.errors import (
    CatalogError,
)
from rig.events.events import Accepted, Decided, Identified, Moved, Ranked
from rig.plans.enroll import enroll
from rig.plans.identify import identify
from rig.search.model import model_of
from sim.bench import ShelfOperator, open_sim_bench
from sim.objects.shelf import shelf
from sim.world import World
from tests.small import SMALL

VIEWS = 8


@pytest.fixture(scope="module")
def three_enrolled(tmp_path_factory):
    operator = ShelfOperator(World(seed=9), shelf())
    with (
        open_sim_bench(load_config(None, SMALL), operator) as bench,
        Catalog.open(tmp_path_factory.mktemp("three"), clock=bench.clock) as catalog,
    ):
        for name in ("mug-dots", "lamp", "toy-car"):
            list(enroll(bench, catalog, name, views=VIEWS))
        return model_of(derived.views(catalog))


@pytest.fixture
def shelf_of_three(simulated, three_enrolled):
    return simulated(seed=10), three_enrolled


def test_object_in_any_orientation_is_found_with_the_right_pose(shelf_of_three):
    s, index = shelf_of_three
    s.operator.next_object, s.operator.yaw_deg = "toy-car", 77.0  # the lamp looks the same from everywhere
    events = list(identify(s.bench, index))
    answer = events[-1]
    assert isinstance(answer, Identified)
    assert answer.name == "toy-car"
    # by CEDD of a few views its front and back look the same: the answer has both poses
    assert min(abs(wrap180(yaw_deg - 77.0)) for yaw_deg in answer.yaw_set_deg) < 60
    moves = [e for e in events if isinstance(e, Moved)]
    decisions = [e for e in events if isinstance(e, Decided)]
    assert len(moves) == answer.views == len(decisions) + 1
    for decided, move in zip(decisions, moves[1:], strict=True):
        assert move.commanded_deg == pytest.approx(decided.target_deg)
        # The camera moves around the object against the table's rotation; whole revolutions unwind the cable.
        assert wrap180(move.rotation_encoder_deg + decided.rotation_deg) == pytest.approx(0, abs=0.5)
        assert move.rotation_imu_deg == pytest.approx(move.rotation_encoder_deg, abs=4 * move.imu_sigma_deg + 0.3)
    assert answer.travelled_deg == pytest.approx(sum(abs(m.rotation_encoder_deg) for m in moves))
    assert not s.bench.servo.read_condition().torque


def test_each_ranking_follows_from_the_accepted_images(shelf_of_three):
    s, model = shelf_of_three
    s.operator.next_object = "lamp"
    x, y, width, height = s.bench.config.view.roi
    queries, orientations = [], []
    for event in identify(s.bench, model):
        if isinstance(event, Accepted):
            queries.append(hbr.describe(event.image_bgr[y : y + height, x : x + width]))
            orientations.append(event.azimuth_deg)
        if isinstance(event, Ranked):
            again = hbr.retrieve(np.array(queries), np.array(orientations), model.index)
            assert [c.name for c in event.candidates] == list(again.names)
            assert [c.score for c in event.candidates] == pytest.approx(list(again.scores / len(queries)), abs=1e-3)
            assert event.margin == pytest.approx(hbr.score_margin(again, np.array(queries)) / len(queries), abs=1e-3)


def test_identification_uses_the_gyro_when_the_platter_slips_a_little(shelf_of_three):
    s, index = shelf_of_three
    s.operator.next_object, s.operator.yaw_deg = "toy-car", 10.0
    moves = []
    for event in identify(s.bench, index):
        if isinstance(event, Decided) and not moves[1:]:
            s.world.clock.call_at(s.world.clock.now_ns() + 500_000_000, lambda: s.world.slip(9.0, 0.2))
        if isinstance(event, Moved):
            moves.append(event)
        if isinstance(event, Accepted) and event.index == 1:
            off_deg = wrap180(event.azimuth_deg + s.world.table_deg())
    assert not moves[1].agrees
    assert off_deg == pytest.approx(0, abs=4 * moves[1].imu_sigma_deg)


def test_empty_catalog_is_reported_before_anything_moves(simulated):
    s = simulated()
    with pytest.raises(CatalogError, match="empty"):
        next(identify(s.bench, model_of(hbr.Views.empty())))
