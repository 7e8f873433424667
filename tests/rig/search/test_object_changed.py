"""The object is replaced, or rotated by hand, during a search on the simulated bench."""

from collections.abc import Iterator
from pathlib import Path
from typing import TypeVar

import numpy as np
import pytest

from rig import Catalog, enroll, identify, load_model
from rig.bench import Bench
from rig.catalog.results import find_results
from rig.events.events import Accepted, Event, Identified, Moved, ObjectChanged, Started
from rig.plans.identify import ResultRecorder, watch
from rig.search.model import Model
from rig.search.replay import check
from rig.search.saved_run import RunWriter, load_run
from sim.bench import ShelfOperator, open_sim_bench
from sim.faults import Fault
from sim.objects.shelf import shelf
from sim.world import World
from tests.rig.motion.times import SMALL, camera_time

pytestmark = pytest.mark.nightly
"""The golden session identify-replaced is the default test of this."""

T = TypeVar("T")
TOY_CAR = sorted(shelf()).index("toy-car") + 1
REPLACED = f"object_moved:other={TOY_CAR}@move1"


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Model]:
    """Return a model of twins, whose searches take several views, and of another object."""
    world = World(seed=5)
    with (
        open_sim_bench(camera_time(world, *SMALL), ShelfOperator(world, shelf())) as bench,
        Catalog.open(tmp_path_factory.mktemp("model"), clock=bench.clock) as catalog,
    ):
        for name in ("mug-white", "mug-star", "toy-car"):
            list(enroll(bench, catalog, name, views=8))
        yield load_model(catalog)


def opened(*faults: str, name: str = "mug-white", yaw_deg: float = 135.0) -> Bench:
    world = World(seed=2)
    operator = ShelfOperator(world, shelf(), next_object=name, yaw_deg=yaw_deg)
    return open_sim_bench(camera_time(world, *SMALL), operator, faults=[Fault.parse(one) for one in faults])


def saved(bench: Bench, model: Model, folder: Path, strategy: str = "dense") -> list[Event]:
    """Search, save the run, and return the events; its replay must give the same answer."""
    with RunWriter(folder, bench, model) as writer:
        events = []
        for event in identify(bench, model, strategy=strategy):
            writer.add(event)
            events.append(event)
    found = check(load_run(folder))
    assert found.is_complete
    assert found.differences == []
    return events


def of_kind(kind: type[T], events: list[Event]) -> list[T]:
    return [event for event in events if isinstance(event, kind)]


def test_last_steps_use_the_views_of_the_new_object_alone(model: Model, tmp_path: Path) -> None:
    mug = sorted(shelf()).index("mug-star") + 1
    with opened(f"object_moved:other={mug}:angle=90@move1", "object_moved:other=0@move3", yaw_deg=150.0) as bench:
        events = saved(bench, model, tmp_path / "run")  # the replay compares again the views that count
    answer = of_kind(Identified, events)[-1]
    assert answer.possible
    assert set(answer.possible) <= {"mug-white", "mug-star"}


def test_less_evidence_is_needed_if_the_gyro_saw_the_platter_move(model: Model) -> None:
    needed = {}
    for faults in ((REPLACED,), (REPLACED, "slip:angle=8@move1")):
        with opened(*faults) as bench:
            events = list(identify(bench, model, strategy="dense"))
        assert any(not event.agrees for event in of_kind(Moved, events)) is (len(faults) > 1)
        needed[len(faults)] = of_kind(ObjectChanged, events)[0].needed
    assert needed[1] > needed[2]


def test_result_has_the_image_and_the_views_of_the_new_object(model: Model, tmp_path: Path) -> None:
    with opened(REPLACED) as bench, Catalog.open(tmp_path, clock=bench.clock) as catalog:
        recorder = ResultRecorder(tmp_path, bench, clock=bench.clock, catalog_version=catalog.version)
        events = []
        for event in identify(bench, model, strategy="dense"):
            events.append(event)
            recorder.add(event)
        (result,) = find_results(catalog)
        new = of_kind(Accepted, events)[1:]
        assert np.array_equal(catalog.read_image(result.image), new[0].image_bgr)
        assert list(result.azimuths_deg) == [event.azimuth_deg for event in new]


def test_watch_continues_with_the_next_object_after_a_change(model: Model) -> None:
    with opened(REPLACED) as bench:
        events, answers = [], []
        for event in watch(bench, lambda: identify(bench, model, strategy="dense")):
            events.append(event)
            if isinstance(event, Identified):
                answers.append((event.name, len(event.left_out)))
            if len(answers) == 2:
                break
    assert len(of_kind(Started, events)) == 2
    assert answers[0] == ("toy-car", 1)
    assert answers[1][1] == 0
