"""A servo that moves the camera around the object, and one that pans over less than a revolution, in both plans."""

from pathlib import Path

import numpy as np
import pytest

from hbr.dense import stopping
from hbr.segmentation import BoxMethod
from rig.catalog import Catalog, derived
from rig.catalog.describing import described
from rig.core.errors import ConfigError
from rig.events.events import Accepted, Enrolled, Identified
from rig.motion.turntable import Turntable
from rig.plans.enroll import enroll
from rig.plans.identify import identify
from rig.plans.photograph_table import photograph_table
from rig.search.model import load_model, model_of
from rig.search.replay import check
from rig.search.saved_run import load_run
from rig.search.strategies import descriptor_for
from rig.search.strategies import strategy as strategy_named
from sim.objects.solid import empty_platter
from tests.rig.search.run_samples import searched

PAN = ("table.mode=pan", "table.limits_deg=[-150, 150]")
ARM = ("table.carries=camera",)


def enrolled(simulated, catalog: Catalog, name: str, *overrides: str, views: int = 24) -> list[Accepted]:
    s = simulated(*overrides)
    *_, done = events = list(enroll(s.bench, catalog, name, views=views))
    assert isinstance(done, Enrolled)
    return [event for event in events if isinstance(event, Accepted)]


def test_azimuths_agree_whether_object_or_camera_rotates(
    simulated, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At one azimuth both kinds of bench see the same side of a mug, with its handle on the same side."""
    # In one room and one light, so that the images differ only by the object.
    monkeypatch.setattr("sim.camera.room", lambda *_: empty_platter())
    monkeypatch.setattr("sim.camera.relight", lambda *_: None)
    views = []
    for overrides in ((), ARM):
        with Catalog.open(tmp_path / str(len(views)), clock=simulated().bench.clock, create=True) as catalog:
            views.append(enrolled(simulated, catalog, "mug-star", *overrides, views=4))
    rotated, around = views
    assert [view.azimuth_deg for view in rotated[1:]] == pytest.approx([270, 180, 90], abs=0.5)
    assert [view.azimuth_deg for view in around[1:]] == pytest.approx([90, 180, 270], abs=0.5)
    sides = {round(view.azimuth_deg) % 360: view.image_bgr.astype(float) for view in rotated}
    for view in around:
        azimuth = round(view.azimuth_deg) % 360
        unlike = {side: np.abs(image - view.image_bgr).mean() for side, image in sides.items()}
        assert min(unlike, key=lambda side: unlike[side]) == azimuth


@pytest.mark.parametrize(
    ("strategy", "photographs"),
    [*(pytest.param(one, False, marks=pytest.mark.nightly) for one in ("ahbr", "dense")), ("dense", True)],
)
def test_orbiting_camera_enrolls_and_identifies(simulated, tmp_path: Path, strategy: str, photographs: bool) -> None:
    """The background differs in each view; whole frames (AHBR) and the rig's own search find the object again.

    With an empty-table image for each azimuth the rig's own search knows the background of every view.
    """
    s = simulated(*ARM)
    with Catalog.open(tmp_path / "catalog", clock=s.bench.clock, create=True) as catalog:
        if photographs:
            list(photograph_table(s.bench, views=8))
        for name in ("teapot", "mug-dots"):
            views = [event for event in enroll(s.bench, catalog, name, views=8) if isinstance(event, Accepted)]
            assert len(views) == 8
        s.operator.next_object, s.operator.yaw_deg = "teapot", 10.0
        model = load_model(catalog, descriptor=descriptor_for(strategy_named(strategy)))
        *events, answer = searched(tmp_path / "run", s.bench, model, strategy=strategy)
        views += [event for event in events if isinstance(event, Accepted)]
        stored = catalog.object("mug-dots").complete
        methods = {one["method"] for one in described(catalog.database, stored, "mug-dots").segmentation}
    again = check(load_run(tmp_path / "run"))
    assert again.is_complete
    assert again.differences == []
    assert isinstance(answer, Identified)
    assert answer.name == "teapot"
    used = {view.segmentation["method"] for view in views if view.segmentation is not None}
    if photographs:
        assert methods == used == {BoxMethod.EMPTY_TABLE}
    else:
        assert BoxMethod.EMPTY_TABLE not in methods | used


def test_pan_servo_enrolls_and_identifies_within_its_reach(simulated, tmp_path: Path) -> None:
    with Catalog.open(tmp_path, clock=simulated().bench.clock, create=True) as catalog:
        assert len(enrolled(simulated, catalog, "toy-car", *PAN, views=12)) == 11  # the 300° that it reaches
        s = simulated(*PAN)
        s.operator.next_object, s.operator.yaw_deg = "toy-car", 30.0
        *_, found = identify(s.bench, model_of(derived.views(catalog)))
    assert isinstance(found, Identified)
    assert found.name == "toy-car"


def test_limits_beyond_the_reach_are_rejected_before_anything_moves(simulated) -> None:
    with pytest.raises(ConfigError, match="reaches 0° to 360°") as caught:
        simulated("table.mode=pan", "table.limits_deg=[-190, 190]")
    assert "[-180, 180]" in caught.value.next_step


def test_pan_servo_goes_to_its_nearest_limit(simulated) -> None:
    with Turntable(simulated(*PAN).bench) as table:
        assert table.within_reach(200.0) == -150.0
        assert table.within_reach(-170.0) == -150.0
        assert table.within_reach(160.0) == 150.0
        assert table.within_reach(250.0) == -110.0


@pytest.mark.nightly
def test_search_by_an_orbiting_camera_goes_where_an_image_was_taken(
    simulated, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The search weighs rotations of 5 degrees; with an image each 30 degrees it takes no view between them."""
    s = simulated(*ARM)
    with Catalog.open(tmp_path, clock=s.bench.clock, create=True) as catalog:
        list(photograph_table(s.bench, views=12))
        for name in ("mug-star", "mug-white"):
            list(enroll(s.bench, catalog, name, views=6))
        for limit in ("MIN_CONFIDENCE", "HOPELESS"):
            monkeypatch.setattr(stopping, limit, 2.0)  # so that the search takes all its views
        s.operator.next_object, s.operator.yaw_deg = "mug-white", 100.0
        views = [e for e in identify(s.bench, load_model(catalog)) if isinstance(e, Accepted)]
    assert len(views) > 1
    assert all(abs((view.azimuth_deg + 15) % 30 - 15) < 1 for view in views)
    assert {view.segmentation["method"] for view in views} == {BoxMethod.EMPTY_TABLE}
