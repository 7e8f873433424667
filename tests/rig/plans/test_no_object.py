"""An empty table is no object: nothing is enrolled, and no answer is given."""

import pytest

from rig.catalog import Catalog
from rig.core.errors import NoObject
from rig.events.events import Accepted, Failed, Identified, Ranked, ScanStarted, Started, Waiting
from rig.plans.enroll import enroll
from rig.plans.identify import identify, watch
from rig.plans.operator import Choice, Subject
from rig.plans.photograph_table import photograph_table
from rig.plans.tray import enroll_tray
from rig.search.model import load_model
from sim.bench import ShelfOperator, open_sim_bench
from sim.objects.shelf import shelf
from sim.world import World
from tests.rig.motion.times import SMALL, camera_time
from tests.rig.plans.test_tray_list import Scripted, items


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    """The models of two enrolled objects for the dense search and for the paper's."""
    world = World(seed=5)
    with (
        open_sim_bench(camera_time(world, *SMALL), ShelfOperator(world, shelf())) as bench,
        Catalog.open(tmp_path_factory.mktemp("models"), clock=bench.clock) as catalog,
    ):
        list(photograph_table(bench))
        for name in ("lamp", "toy-car"):
            list(enroll(bench, catalog, name, views=6))
        yield load_model(catalog), load_model(catalog, descriptor="cedd")


@pytest.fixture
def model(models):
    return models[0]


@pytest.fixture
def world():
    return World(seed=5)


@pytest.fixture
def plain_bench(world):
    """A bench with a calibrated camera time. Its operator puts no object on the table."""
    with open_sim_bench(camera_time(world, *SMALL), ShelfOperator(world, shelf())) as bench:
        bench.placer = None
        yield bench


@pytest.fixture
def bench(plain_bench):
    """The same bench with an empty-table image."""
    list(photograph_table(plain_bench))
    return plain_bench


@pytest.fixture
def catalog(bench, tmp_path):
    with Catalog.open(tmp_path / "catalog", clock=bench.clock) as catalog:
        yield catalog


def until_no_object(plan):
    """Return the events of a plan that ends because the table is empty."""
    events = []
    with pytest.raises(NoObject, match="No object is on the table") as caught:
        events.extend(plan)
    assert caught.value.next_step.startswith("Put the object on the table")
    return events


@pytest.mark.parametrize("strategy", ["dense", "arc", "ahbr"])
def test_empty_table_gives_no_answer(bench, models, world, strategy):
    world.change(light=(0.8, 0.8, 0.9))
    events = until_no_object(identify(bench, models[strategy == "ahbr"], strategy=strategy))
    assert len([event for event in events if isinstance(event, Accepted)]) == 1
    assert not any(isinstance(event, Ranked) for event in events)
    assert not bench.servo.read_condition().torque


def test_empty_table_is_noticed_by_the_image_of_the_enrollment(bench, model, world):
    assert model.empty_table is not None
    bench.state.store_file("empty-table.json", b"{")
    until_no_object(identify(bench, model))


@pytest.mark.parametrize("strategy", ["dense", "arc", "ahbr"])
def test_without_an_empty_table_image_the_rotation_shows_that_the_table_is_empty(plain_bench, models, strategy):
    events = until_no_object(identify(plain_bench, models[strategy == "ahbr"], strategy=strategy))
    assert not any(isinstance(event, Identified) for event in events)
    assert not plain_bench.servo.read_condition().torque


@pytest.mark.parametrize("fly", [False, True])
def test_without_an_empty_table_image_an_enrollment_of_nothing_ends_early(plain_bench, world, tmp_path, fly):
    with Catalog.open(tmp_path / "catalog", clock=plain_bench.clock) as catalog:
        events = until_no_object(enroll(plain_bench, catalog, "lamp", views=36, fly=fly))
        assert len([event for event in events if isinstance(event, Accepted)]) <= 3  # of 36
        assert catalog.resumable("lamp") is None  # views of an empty table are not continued
        world.put(shelf()["lamp"])
        *_, done = enroll(plain_bench, catalog, "lamp", views=4, fly=False)
        assert done.views == 4


@pytest.mark.parametrize("fly", [False, True])
def test_empty_table_is_not_enrolled(bench, catalog, fly):
    events = until_no_object(enroll(bench, catalog, "nothing", views=6, fly=fly))
    assert not any(isinstance(event, Accepted | ScanStarted) for event in events)
    assert catalog.objects() == []
    assert len(list(catalog.path.rglob("*.png"))) == 1  # the empty-table image; `rig catalog gc` removes it


def test_views_are_not_continued_on_an_empty_table(bench, catalog, world):
    world.put(shelf()["lamp"])
    plan = enroll(bench, catalog, "lamp", views=6)
    while not isinstance(next(plan), Accepted):
        pass
    plan.close()
    world.put(None)
    until_no_object(enroll(bench, catalog, "lamp", resume=True))
    assert catalog.resumable("lamp").enrollment.present == (0,)
    world.put(shelf()["lamp"])
    list(enroll(bench, catalog, "lamp", resume=True))


def test_operator_of_a_tray_can_put_the_object_on_the_table_and_try_again(bench, catalog, world):
    class Forgetful(Scripted):
        def choose(self, question):
            if question.subject is Subject.FAILURE:
                world.put(shelf()["lamp"])
            return super().choose(question)

    operator = Forgetful(problem=[Choice.CONTINUE])
    list(enroll_tray(bench, catalog, items("lamp"), views=6, operator=operator, fly=False))
    (failure,) = operator.troubles
    assert failure.startswith("lamp: No object is on the table")
    assert [one.name for one in catalog.objects()] == ["lamp"]


def test_watch_reports_an_empty_or_a_dark_table_returns_and_waits_for_the_next_object(bench, models, world):
    answers = []
    for event in watch(bench, lambda: identify(bench, models[1], strategy="ahbr")):
        if isinstance(event, Waiting):
            assert world.table_deg() == pytest.approx(0.0, abs=1.0)  # where the first object was waited for
            if len(answers) == 3:
                break
            world.put(shelf()["lamp"] if answers else None)
            world.change(light=(float(len(answers) != 1),) * 3)
        if isinstance(event, Failed | Identified):
            answers.append(event.error.code if isinstance(event, Failed) else event.name)
    assert answers == [606, 600, "lamp"]


def test_object_is_on_the_table_when_the_search_starts(bench, model, world):
    class Comes:
        def place(self, name):
            world.put(shelf()["toy-car"])

    bench.placer = Comes()
    assert isinstance(next(identify(bench, model)), Started)
    assert world.scene.object is shelf()["toy-car"]
