"""The picture of the empty table: taken, judged, kept, doubted, and what an enrollment makes of it."""

import json
from collections.abc import Callable
from datetime import timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.bench import Bench
from rig.catalog import Catalog
from rig.config import RigConfig, load_config
from rig.core.errors import StateNotStored, TableNotEmpty, UsageError, ViewRejected
from rig.events.events import EmptyTableImage, Warned
from rig.plans.enroll import enroll
from rig.plans.photograph_table import photograph_table
from rig.safety.saved_state import FileStore, MemoryStore
from rig.views.description import BENCH_DESCRIPTOR
from rig.views.empty_table import HOLDS_H, Drift, EmptyTables
from rig.views.object_presence import TableWatcher
from rig.views.segmentation_evidence import SegmentationSummary
from sim import disk
from sim.bench import ShelfOperator, open_sim_bench
from sim.change import CHANGES
from sim.objects.shelf import shelf
from sim.world import World

SMALL = ("camera.width=320", "camera.height=240", "view.roi=[40, 0, 240, 240]")

Open = Callable[..., Any]


def photographed(bench: Bench, **options: Any) -> EmptyTableImage:
    *_, taken = photograph_table(bench, **options)
    assert isinstance(taken, EmptyTableImage)
    return taken


def test_the_table_is_cleared_photographed_and_turned_back(simulated: Open) -> None:
    s = simulated(*SMALL)
    s.operator.place("dice")
    assert EmptyTables.standing(s.bench).words == "no picture of the empty table was taken yet"
    taken = photographed(s.bench)
    kept = EmptyTables.standing(s.bench).table
    assert kept is not None
    assert np.array_equal(kept.image_bgr, taken.image_bgr)
    assert s.world.scene.thing is None
    assert taken.turning_share == 0
    assert abs(s.world.table_deg()) < 1
    assert EmptyTables.standing(s.bench).doubts == ()


@pytest.mark.parametrize("limits", [(0, 400), (-400, 3)])
def test_the_cable_decides_where_it_turns_to(simulated: Open, limits: tuple[int, int]) -> None:
    s = simulated(*SMALL, f"table.limits_deg={list(limits)}")
    s.operator.clear = lambda: True  # type: ignore[method-assign]
    s.operator.place("toy-house")
    with pytest.raises(TableNotEmpty, match="Something stands on the table") as caught:
        photographed(s.bench)
    assert "--anyway" in caught.value.next_step


def test_a_forgotten_object_is_refused_and_the_picture_before_stays(simulated: Open) -> None:
    s = simulated(*SMALL)
    before = photographed(s.bench)
    s.operator.clear = lambda: True
    for name in ("mug-white", "dice"):
        s.operator.place(name)
        with pytest.raises(TableNotEmpty):
            photographed(s.bench)
    kept = EmptyTables.standing(s.bench).table
    assert kept is not None
    assert np.array_equal(kept.image_bgr, before.image_bgr)
    assert abs(s.world.table_deg()) < 1
    assert photographed(s.bench, anyway=True).turning_share > 0.004


def test_a_round_object_turns_unseen_and_is_told_by_the_picture_before(simulated: Open) -> None:
    s = simulated(*SMALL)
    photographed(s.bench)
    s.operator.clear = lambda: True
    s.operator.place("vase-blue")
    events = list(photograph_table(s.bench))
    assert [type(event) for event in events[-2:]] == [Warned, EmptyTableImage]
    assert "does not look as it did" in events[-2].what


def test_a_dark_table_is_refused_as_a_view_is(simulated: Open) -> None:
    s = simulated(*SMALL)
    s.world.change(light=(0.0, 0.0, 0.0))
    with pytest.raises(ViewRejected, match="too dark"):
        photographed(s.bench)
    assert EmptyTables.standing(s.bench).table is None


def test_a_camera_that_goes_around_has_no_empty_table(simulated: Open) -> None:
    s = simulated(*SMALL, 'table.carries="camera"')
    with pytest.raises(UsageError, match="goes around"):
        photographed(s.bench)


def test_age_and_settings_are_doubts_and_another_size_makes_it_useless(simulated: Open) -> None:
    s = simulated(*SMALL)
    photographed(s.bench)
    s.operator.parts.camera.drift(kelvin=6000.0)
    assert EmptyTables.standing(s.bench).doubts == ("white_balance_k was 5000, is 6000",)
    s.world.clock.sleep(timedelta(hours=HOLDS_H + 1).total_seconds())
    standing = EmptyTables.standing(s.bench)
    assert standing.table is not None
    assert standing.doubts[0] == "it is 13 hours old"
    other = simulated()
    other.bench.state = s.bench.state
    standing = EmptyTables.standing(other.bench)
    assert standing.table is None
    assert "320 x 240 pixels, the camera's frames have 640 x 480" in standing.words


def test_on_disk_damage_is_told_and_a_new_picture_mends_it(simulated: Open, tmp_path: Path) -> None:
    s = simulated(*SMALL)
    s.bench.state = FileStore(tmp_path)
    photographed(s.bench)
    (png,) = tmp_path.glob("*.png")
    facts = tmp_path / "empty-table.json"
    whole = facts.read_bytes()
    for spoil, said in (
        (lambda: png.write_bytes(png.read_bytes()[:-9]), "is damaged"),
        (png.unlink, "is missing"),
        (lambda: facts.write_bytes(whole[:50]), "empty-table.json is damaged"),
        (lambda: facts.write_text(json.dumps({**json.loads(whole), "version": 9})), "of version 9"),
    ):
        spoil()
        standing = EmptyTables.standing(s.bench)
        assert standing.table is None
        assert said in standing.words
    photographed(s.bench)
    assert EmptyTables.standing(s.bench).table is not None
    photographed(s.bench)
    assert len(list(tmp_path.glob("*.png"))) == 1  # the one before is let go of


@pytest.fixture(scope="module")
def facts() -> bytes:
    """What a bench keeps beside a picture."""
    world = World()
    with open_sim_bench(load_config(None, SMALL), ShelfOperator(world, shelf())) as bench:
        photographed(bench)
        return bench.state.read_file("empty-table.json") or b""


@given(data=st.data())
def test_whatever_is_in_the_files_is_a_picture_or_a_reason(facts: bytes, data: st.DataObject) -> None:
    state = MemoryStore()
    known = json.loads(facts)
    garbage = st.recursive(
        st.none() | st.integers() | st.text() | st.just(1e999), lambda some: st.lists(some), max_leaves=3
    )
    spoilt = st.dictionaries(st.sampled_from(sorted(known)), garbage, max_size=3).map(
        lambda changes: json.dumps({**known, **changes}).encode()
    )
    state.files["empty-table.json"] = data.draw(spoilt | st.binary(max_size=40))
    state.files[known["image"]] = data.draw(st.binary(max_size=40))
    bench = SimpleNamespace(state=state, config=RigConfig())
    standing = EmptyTables.standing(bench)  # type: ignore[arg-type]
    assert standing.table is None
    assert "of no use" in standing.words


def test_a_clock_that_was_set_back_is_told(simulated: Open) -> None:
    s = simulated(*SMALL)
    photographed(s.bench)
    s.world.clock.set_civil(-7200.0)
    assert "dated in the future" in EmptyTables.standing(s.bench).words


def test_a_bench_that_watches_its_table_photographs_it_before_the_first_object(simulated: Open) -> None:
    s = simulated(*SMALL)
    s.bench.operator = TableWatcher(s.bench)
    assert photographed(s.bench).turning_share == 0
    s.world.clock.call_at(s.world.clock.now_ns() + 2_000_000_000, lambda: s.world.put(shelf()["toy-car"]))
    s.bench.operator.place(None)
    with pytest.raises(UsageError, match="cannot be taken away"):
        photographed(s.bench)


def test_a_full_disk_is_told_and_the_picture_before_stays(simulated: Open, tmp_path: Path) -> None:
    s = simulated(*SMALL)
    s.bench.state = FileStore(tmp_path)
    before = photographed(s.bench)
    kept = sorted(path.name for path in tmp_path.iterdir())
    store = s.bench.state

    class Full(FileStore):
        """Full where pictures go; the table's turns were kept before."""

        def store_file(self, name: str, content: bytes) -> None:
            free = disk.fill()
            try:
                super().store_file(name, content)
            finally:
                free()

    s.bench.state = Full(tmp_path)
    with pytest.raises(StateNotStored, match="cannot be kept") as caught:
        photographed(s.bench)
    assert "Make room" in caught.value.next_step
    s.bench.state = store
    table = EmptyTables.standing(s.bench).table
    assert table is not None
    assert np.array_equal(table.image_bgr, before.image_bgr)
    assert sorted(path.name for path in tmp_path.iterdir()) == kept


def test_every_enrolled_view_has_both_descriptors_its_evidence_and_the_empty_table(
    simulated: Open, tmp_path: Path
) -> None:
    s = simulated(*SMALL)
    taken = photographed(s.bench)
    with Catalog.open(tmp_path, clock=s.bench.clock) as catalog:
        events = list(enroll(s.bench, catalog, "toy-car", views=4))
        details = catalog.object("toy-car")
        loaded = catalog.views(BENCH_DESCRIPTOR).views
        (sitting,) = details.enrollments[0].sittings
        assert sitting.reference_image is not None
        assert (tmp_path / sitting.reference_image).exists()
    assert loaded.descriptor == BENCH_DESCRIPTOR
    assert len(loaded) == 4
    summary = SegmentationSummary.of(view.record.segmentation for view in details.views)
    assert (summary.views, summary.found, summary.guessed, summary.corrected) == (4, 4, 0, 4)
    assert summary.text.startswith("object found in 4 of 4 views, illumination corrected in 4")
    assert f"{taken.taken_utc:.10}" in sitting.provenance.conditions["empty_table"]
    assert not any(isinstance(event, Warned) for event in events)


def test_another_wall_is_noticed_told_once_and_remembered(simulated: Open, tmp_path: Path) -> None:
    s = simulated(*SMALL, seed=2)
    photographed(s.bench)
    s.operator.another_day(CHANGES["bench"])
    with Catalog.open(tmp_path, clock=s.bench.clock) as catalog:
        warned = [event for event in enroll(s.bench, catalog, "toy-car", views=6) if isinstance(event, Warned)]
        views = catalog.object("toy-car").views
    assert [event.index for event in warned] == [2]
    assert "rig empty-table" in warned[0].next_step
    assert all(view.record.segmentation["issues"][0]["code"] == "empty-table-differs" for view in views)
    assert any("3 frames in a row" in doubt for doubt in EmptyTables.standing(s.bench).doubts)
    photographed(s.bench)
    assert EmptyTables.standing(s.bench).doubts == ()


def test_two_bad_frames_are_no_drift() -> None:
    drift = Drift()
    low, high = {"agreement": 0.2}, {"agreement": 0.9}
    assert [bool(drift.look(seen)) for seen in (low, low, high, low, None, low, low, low)] == [False] * 6 + [
        True,
        False,
    ]
