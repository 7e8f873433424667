"""One view of an enrolled object taken again: the others stay as they are, and the former enrollment until the end."""

import numpy as np
import pytest

from rig.bench import open_bench
from rig.catalog import Catalog, EnrollmentStatus
from rig.catalog.jobs import finished
from rig.catalog.retake import Retake
from rig.catalog.transfer import same_view
from rig.catalog.verify import verify
from rig.config import load_config
from rig.core.errors import CatalogError, DeviceSilent, ObjectMoved, UsageError
from rig.events.events import Accepted
from rig.plans.enroll import enroll, retake
from rig.search.model import load_model
from tests.small import SMALL

VIEWS = 8


@pytest.fixture
def bench():
    with open_bench("sim", load_config(None, SMALL), seed=4) as bench:
        yield bench


@pytest.fixture
def catalog(tmp_path, bench):
    with Catalog.open(tmp_path, clock=bench.clock) as catalog:
        list(enroll(bench, catalog, "teapot", views=VIEWS))
        yield catalog


def content(view):
    """Return what a view says, without its place in the catalog."""
    return {name: getattr(view, name) for name in ("index", "azimuth_deg", "captured_utc", "image", "evidence")}


def test_view_is_taken_again_at_its_angle_and_the_others_are_taken_over(bench, catalog):
    bench.placer = None  # the object stands where it stood
    before = catalog.object("teapot")
    taken = [event.index for event in retake(bench, catalog, "teapot", [5]) if isinstance(event, Accepted)]
    assert taken == [5]
    after = catalog.object("teapot")
    new, old = after.views[5], before.views[5]
    assert new.azimuth_deg == pytest.approx(old.azimuth_deg, abs=0.3)
    assert new.captured_utc > old.captured_utc
    assert new.image != old.image
    others = [index for index in range(VIEWS) if index != 5]
    assert [content(after.views[index]) for index in others] == [content(before.views[index]) for index in others]
    assert [one.status for one in after.enrollments] == [EnrollmentStatus.COMPLETE, EnrollmentStatus.SUPERSEDED]
    # The former enrollment is as it was, and the log says what was done.
    assert [content(view) for view in after.enrollments[1].enrollment.views] == [content(one) for one in before.views]
    assert catalog.log()[-1].details["taken_again"] == [5]
    assert not finished(verify(catalog, jobs=1)).findings
    assert load_model(catalog).views.object_names == ("teapot",)


def test_several_views_are_taken_again_together_and_once_more(bench, catalog):
    bench.placer = None
    list(retake(bench, catalog, "teapot", [2, 1, 2]))
    list(retake(bench, catalog, "teapot", [1]))
    found = catalog.object("teapot").complete
    assert [view.session for view in found.views] == [0, 2, 1, 0, 0, 0, 0, 0]


def test_interrupted_retake_leaves_the_former_enrollment_in_use(bench, catalog, monkeypatch):
    before, lines = catalog.object("teapot").complete.key, len(catalog.log())
    for stop_at in ("moved", "accepted"):
        events = retake(bench, catalog, "teapot", [0])
        for event in events:
            if event.event == stop_at:
                break
        events.close()
        assert catalog.object("teapot").complete.key == before
        assert len(catalog.log()) == lines
        assert catalog.resumable("teapot") is None

    def unplugged(*_):
        raise DeviceSilent("The servo does not answer.", next_step="Plug it in.")

    with pytest.raises(DeviceSilent):
        for event in retake(bench, catalog, "teapot", [3]):
            if isinstance(event, Accepted):
                monkeypatch.setattr(type(bench.servo), "read_state", unplugged)
    assert catalog.object("teapot").complete.key == before


def test_object_that_stands_otherwise_changes_nothing(bench, catalog):
    before = catalog.object("teapot").complete.key
    bench.placer.place(None)  # somewhere else, and turned
    bench.placer = None
    with pytest.raises(ObjectMoved, match="does not stand as it stood for view 7") as error:
        list(retake(bench, catalog, "teapot", [2]))
    assert "--replace" in str(error.value.next_step)
    assert catalog.object("teapot").complete.key == before


def test_views_that_cannot_be_taken_again_are_rejected_before_anything_moves(bench, catalog):
    for indices in ([], [-1], [VIEWS], range(VIEWS)):
        with pytest.raises(UsageError):
            next(retake(bench, catalog, "teapot", indices))


def test_object_that_was_enrolled_again_meanwhile_keeps_its_new_views(bench, catalog):
    before = catalog.object("teapot")
    session = before.complete.sessions[0]
    begun = Retake.of(catalog, "teapot", [1], provenance=session.provenance)
    list(enroll(bench, catalog, "teapot", views=VIEWS, replace=True))
    begun.add(same_view(before.views[1]), np.zeros((240, 320, 3), np.uint8))
    with pytest.raises(CatalogError, match="enrolled again or deleted"):
        begun.finish()
    assert len(catalog.object("teapot").enrollments) == 2
