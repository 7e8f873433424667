"""The empty-table image: taken, checked, stored, its problems, and its use by an enrollment."""

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
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
from rig.catalog.describing import described
from rig.config import RigConfig, load_config
from rig.core.errors import StateNotStored, TableNotEmpty, UsageError, ViewRejected
from rig.core.next_steps import Do
from rig.events.events import EmptyTableImage, Moved, NoteCode, Warned
from rig.events.wording import note_steps, note_words
from rig.motion.move import equivalent_within
from rig.motion.turntable import Turntable
from rig.plans.enroll import SAME_SIMILARITY, enroll
from rig.plans.photograph_table import photograph_table
from rig.safety.saved_state import FileStore, MemoryStore
from rig.views.capture import image_similarity
from rig.views.description import segmentation_summary
from rig.views.empty_table import MAX_AGE_H, empty_table_status
from rig.views.object_presence import TableWatcher
from rig.views.table_problems import TableProblem, TableProblemCode
from rig.views.table_sheet import table_image
from sim.bench import ShelfOperator, open_sim_bench
from sim.change import CHANGES
from sim.faults.environment import fill_disk
from sim.objects.shelf import shelf
from sim.world import World
from tests.fuzzing import examples
from tests.small import SMALL

Open = Callable[..., Any]


def photographed(bench: Bench, **options: Any) -> EmptyTableImage:
    *_, taken = photograph_table(bench, **options)
    assert isinstance(taken, EmptyTableImage)
    return taken


def test_table_is_cleared_photographed_and_rotated_back(simulated: Open) -> None:
    s = simulated()
    s.operator.place("dice")
    assert empty_table_status(s.bench).problems == (TableProblem(TableProblemCode.MISSING),)
    taken = photographed(s.bench)
    kept = empty_table_status(s.bench).table
    assert kept is not None
    assert np.array_equal(kept.image_bgr, taken.image_bgr)
    assert s.world.scene.object is None
    assert taken.turning_share == 0
    assert abs(s.world.table_deg()) < 1
    assert empty_table_status(s.bench).problems == ()


@pytest.mark.parametrize("limits", [(0, 400), (-400, 3)])
def test_rotation_stays_within_the_cable_limits(simulated: Open, limits: tuple[int, int]) -> None:
    s = simulated(f"table.limits_deg={list(limits)}")
    s.operator.clear = lambda: True  # type: ignore[method-assign]
    s.operator.place("toy-house")
    with pytest.raises(TableNotEmpty, match="Something is on the table") as caught:
        photographed(s.bench)
    assert Do.EMPTY_TABLE(anyway=True) in caught.value.steps


def test_forgotten_object_is_rejected_and_the_previous_image_stays(simulated: Open) -> None:
    s = simulated()
    before = photographed(s.bench)
    s.operator.clear = lambda: True
    for name in ("mug-white", "dice"):
        s.operator.place(name)
        with pytest.raises(TableNotEmpty):
            photographed(s.bench)
    kept = empty_table_status(s.bench).table
    assert kept is not None
    assert np.array_equal(kept.image_bgr, before.image_bgr)
    assert abs(s.world.table_deg()) < 1
    assert photographed(s.bench, anyway=True).turning_share > 0.004


def test_round_object_is_noticed_by_the_previous_image(simulated: Open) -> None:
    s = simulated()
    photographed(s.bench)
    s.operator.clear = lambda: True
    s.operator.place("vase-blue")
    events = list(photograph_table(s.bench))
    assert [type(event) for event in events[-2:]] == [Warned, EmptyTableImage]
    assert events[-2].note.code is NoteCode.TABLE_DIFFERS


def test_dark_table_is_rejected_like_a_view(simulated: Open) -> None:
    s = simulated()
    s.world.change(light=(0.0, 0.0, 0.0))
    with pytest.raises(ViewRejected, match="too dark"):
        photographed(s.bench)
    assert empty_table_status(s.bench).table is None


@pytest.mark.parametrize(
    ("mode", "limits_deg", "reached"),
    [("turntable", (-180, 180), range(12)), ("pan", (-100, 40), (0, 1, 9, 10, 11))],
)
def test_orbiting_camera_takes_an_image_at_each_azimuth_that_it_reaches(
    simulated: Open, mode: str, limits_deg: tuple[int, int], reached: Sequence[int]
) -> None:
    range_of = (f"table.mode={mode}", f"table.limits_deg={list(limits_deg)}")
    s = simulated("table.carries=camera", *range_of, "enroll.views=12")
    s.operator.place("dice")
    events = list(photograph_table(s.bench))
    assert events[-1].images == 12
    assert len([event for event in events if isinstance(event, Moved)]) == len(reached)
    assert s.world.scene.object is None
    kept = empty_table_status(s.bench)
    assert kept.problems == ()
    for number in range(12):
        with Turntable(s.bench) as table:
            if number not in reached:
                assert table_image(kept.table.image_bgr, events[-1].image_bgr, 30.0 * number) is None
                continue
            table.goto(equivalent_within(30.0 * number, 0.0, limits_deg))
        frame = s.bench.camera.capture(s.bench.clock.now_ns()).image_bgr
        image = table_image(kept.table.image_bgr, frame, 30.0 * number)
        assert image_similarity(image, frame, s.bench.config.view) > SAME_SIMILARITY
    other = simulated(*range_of)
    other.bench.state = s.bench.state
    assert empty_table_status(other.bench).problems == (TableProblem(TableProblemCode.OTHER_MOTION),)


def test_surroundings_that_move_while_the_camera_goes_around_are_noticed(simulated: Open) -> None:
    s = simulated("table.carries=camera", "enroll.views=4")
    events = photograph_table(s.bench)
    for _ in range(3):
        next(events)
    s.world.seed += 1  # another room
    with pytest.raises(TableNotEmpty, match="surroundings"):
        list(events)
    assert empty_table_status(s.bench).table is None


def test_images_that_are_too_large_together_are_rejected_before_anything_moves(simulated: Open) -> None:
    s = simulated("table.carries=camera")
    with pytest.raises(UsageError, match="too large together") as caught:
        next(photograph_table(s.bench, views=2000))
    assert Do.SET_KEY(key="enroll.views", value="1000") in caught.value.steps


def test_age_and_settings_are_problems_and_another_size_is_not_usable(simulated: Open) -> None:
    s = simulated()
    photographed(s.bench)
    s.operator.devices.camera.drift(kelvin=6000.0)
    parameters = {"name": "white_balance_k", "before": 5000.0, "now": 6000.0}
    assert empty_table_status(s.bench).problems == (TableProblem(TableProblemCode.SETTING, parameters),)
    assert "white_balance_k was 5000, is 6000" in empty_table_status(s.bench).text
    s.world.clock.set_civil(-7200.0)
    assert empty_table_status(s.bench).problems[0] == TableProblem(TableProblemCode.FUTURE, {"hours": 2.0})
    s.world.clock.set_civil(timedelta(hours=MAX_AGE_H + 3).total_seconds())
    status = empty_table_status(s.bench)
    assert status.table is not None
    assert status.problems[0] == TableProblem(TableProblemCode.OLD, {"hours": 13.0})
    camera = s.bench.camera.identity
    for device, expected in ((camera.device, TableProblemCode.OLD), ("another", TableProblemCode.OTHER_CAMERA)):
        s.bench.camera.identity = replace(camera, name="/dev/video7", device=device)  # another name of a camera
        assert empty_table_status(s.bench).problems[0].code is expected
    other = simulated("camera.width=640", "camera.height=480", "view.roi=[80, 0, 480, 480]")
    other.bench.state = s.bench.state
    status = empty_table_status(other.bench)
    assert status.table is None
    sizes = {"image_px": (320, 240), "frame_px": (640, 480)}
    assert status.problems == (TableProblem(TableProblemCode.OTHER_SIZE, sizes),)


def test_damage_on_disk_is_reported_and_fixed_by_a_new_image(simulated: Open, tmp_path: Path) -> None:
    s = simulated()
    s.bench.state = FileStore(tmp_path)
    photographed(s.bench)
    (png,) = tmp_path.glob("*.png")
    metadata = tmp_path / "empty-table.json"
    whole = metadata.read_bytes()
    for spoil, said in (
        (lambda: png.write_bytes(png.read_bytes()[:-9]), "is damaged"),
        (png.unlink, "is missing"),
        (lambda: metadata.write_bytes(whole[:50]), "empty-table.json is damaged"),
        (
            lambda: metadata.write_text(json.dumps({**json.loads(whole), "version": 9})),
            "empty-table.json is damaged (version",
        ),
        (lambda: metadata.write_text(json.dumps({**json.loads(whole), "noticed": {"code": "x"}})), "is damaged"),
    ):
        spoil()
        status = empty_table_status(s.bench)
        assert status.table is None
        assert said in status.text
    photographed(s.bench)
    assert empty_table_status(s.bench).table is not None
    photographed(s.bench)
    assert len(list(tmp_path.glob("*.png"))) == 1  # the previous one was removed


@pytest.fixture(scope="module")
def metadata() -> bytes:
    """Return the JSON file that a bench stores beside an image."""
    world = World()
    with open_sim_bench(load_config(None, SMALL), ShelfOperator(world, shelf())) as bench:
        photographed(bench)
        return bench.state.read_file("empty-table.json") or b""


@examples(100)
@given(data=st.data())
def test_any_file_content_gives_an_image_or_a_problem(metadata: bytes, data: st.DataObject) -> None:
    state = MemoryStore()
    known = json.loads(metadata)
    garbage = st.recursive(
        st.none() | st.integers() | st.text() | st.just(1e999), lambda some: st.lists(some), max_leaves=3
    )
    spoilt = st.dictionaries(st.sampled_from(sorted(known)), garbage, max_size=3).map(
        lambda changes: json.dumps({**known, **changes}).encode()
    )
    state.files["empty-table.json"] = data.draw(spoilt | st.binary(max_size=40))
    state.files[known["image"]] = data.draw(st.binary(max_size=40))
    bench = SimpleNamespace(state=state, config=RigConfig())
    status = empty_table_status(bench)  # type: ignore[arg-type]
    assert status.table is None
    assert [problem.code for problem in status.problems] == [TableProblemCode.UNREADABLE]


def test_watching_bench_takes_the_image_before_the_first_object(simulated: Open) -> None:
    s = simulated()
    s.bench.placer = TableWatcher(s.bench)
    assert photographed(s.bench).turning_share == 0
    s.world.clock.call_at(s.world.clock.now_ns() + 2_000_000_000, lambda: s.world.put(shelf()["toy-car"]))
    s.bench.placer.place(None)
    with pytest.raises(UsageError, match="cannot be taken away"):
        photographed(s.bench)


def test_full_disk_is_reported_and_the_previous_image_stays(simulated: Open, tmp_path: Path) -> None:
    s = simulated()
    s.bench.state = FileStore(tmp_path)
    before = photographed(s.bench)
    kept = sorted(path.name for path in tmp_path.iterdir())
    store = s.bench.state

    class Full(FileStore):
        """A disk that is full when the image is stored."""

        def store_file(self, name: str, content: bytes) -> None:
            free = fill_disk()
            try:
                super().store_file(name, content)
            finally:
                free()

    s.bench.state = Full(tmp_path)
    with pytest.raises(StateNotStored, match="cannot be stored") as caught:
        photographed(s.bench)
    assert Do.FREE_DISK() in caught.value.steps
    s.bench.state = store
    table = empty_table_status(s.bench).table
    assert table is not None
    assert np.array_equal(table.image_bgr, before.image_bgr)
    assert sorted(path.name for path in tmp_path.iterdir()) == kept


def test_enrolled_views_have_their_evidence_and_the_image(simulated: Open, tmp_path: Path) -> None:
    s = simulated()
    taken = photographed(s.bench)
    with Catalog.open(tmp_path, clock=s.bench.clock) as catalog:
        events = list(enroll(s.bench, catalog, "toy-car", views=4))
        stored = catalog.object("toy-car").complete
        (session,) = stored.sessions
        assert session.empty_table is not None
        assert np.array_equal(catalog.read_image(session.empty_table), empty_table_status(s.bench).table.image_bgr)
        summary = segmentation_summary(described(catalog.database, stored, "toy-car").segmentation)
    assert [summary[key] for key in ("views", "found", "guessed", "corrected")] == [4, 4, 0, 4]
    assert f"{taken.taken_utc:.10}" in session.provenance.conditions["empty_table"]["taken_utc"]
    assert not any(isinstance(event, Warned) for event in events)


def test_changed_surroundings_are_reported_once_and_stored(simulated: Open, tmp_path: Path) -> None:
    s = simulated(seed=2)
    photographed(s.bench)
    s.operator.change_bench(CHANGES["bench"])
    with Catalog.open(tmp_path, clock=s.bench.clock) as catalog:
        warned = [event for event in enroll(s.bench, catalog, "toy-car", views=6) if isinstance(event, Warned)]
        evidence = described(catalog.database, catalog.object("toy-car").complete, "toy-car").segmentation
    assert [event.index for event in warned] == [2]
    assert warned[0].note.code is NoteCode.EMPTY_TABLE_CHANGED
    assert Do.EMPTY_TABLE() in note_steps(warned[0].note)
    assert all(one["issues"][0]["code"] == "empty-table-differs" for one in evidence)
    *_, problem = empty_table_status(s.bench).problems
    assert (problem.code, problem.parameters["frames"]) == (TableProblemCode.SURROUNDINGS, 3)
    assert "3 frames in a row" in note_words(warned[0].note)
    photographed(s.bench)
    assert empty_table_status(s.bench).problems == ()


@pytest.mark.parametrize("code", TableProblemCode)
def test_every_problem_has_a_text(code: TableProblemCode) -> None:
    parameters = {
        TableProblemCode.UNREADABLE: {"detail": "it is damaged"},
        TableProblemCode.OTHER_SIZE: {"image_px": (320, 240), "frame_px": [640, 480]},
        TableProblemCode.OTHER_CAMERA: {"image_camera": "A", "camera": "B"},
        TableProblemCode.OLD: {"hours": 100.0},
        TableProblemCode.SETTING: {"name": "autofocus", "before": True, "now": False},
        TableProblemCode.SURROUNDINGS: {"frames": 3, "agreement": 0.4},
    }
    text = TableProblem(code, parameters.get(code, {})).text
    assert text != code
    assert "{" not in text
