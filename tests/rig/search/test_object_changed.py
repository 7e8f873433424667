"""The object is replaced during a search; by default the golden session identify-replaced tests it."""

from collections.abc import Iterator

import pytest

from rig import Catalog, enroll, identify, load_model
from rig.bench import Bench
from rig.events.events import Identified, Moved, ObjectChanged, Started
from rig.plans.identify import watch
from rig.search.model import Model
from sim.bench import ShelfOperator, open_sim_bench
from sim.faults import Fault
from sim.objects.shelf import shelf
from sim.world import World
from tests.rig.motion.times import SMALL, camera_time

pytestmark = pytest.mark.nightly

REPLACED = f"object_moved:other={sorted(shelf()).index('toy-car') + 1}@move1"


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


def opened(*faults: str) -> Bench:
    world = World(seed=2)
    operator = ShelfOperator(world, shelf(), next_object="mug-white", yaw_deg=135.0)
    return open_sim_bench(camera_time(world, *SMALL), operator, faults=[Fault.parse(one) for one in faults])


def test_less_evidence_is_needed_if_the_gyro_saw_the_platter_move(model: Model) -> None:
    needed = []
    for faults in ((REPLACED,), (REPLACED, "slip:angle=8@move1")):
        with opened(*faults) as bench:
            events = list(identify(bench, model, strategy="dense"))
        assert any(isinstance(event, Moved) and not event.agrees for event in events) is (len(faults) > 1)
        needed.append(next(event.needed for event in events if isinstance(event, ObjectChanged)))
    assert needed[0] > needed[1]


def test_watch_continues_with_the_next_object_after_a_change(model: Model) -> None:
    with opened(REPLACED) as bench:
        started, answers = 0, []
        for event in watch(bench, lambda: identify(bench, model, strategy="dense")):
            started += isinstance(event, Started)
            if isinstance(event, Identified):
                answers.append((event.name, len(event.left_out)))
            if len(answers) == 2:
                break
    assert started == 2
    assert answers[0] == ("toy-car", 1)
    assert answers[1][1] == 0
