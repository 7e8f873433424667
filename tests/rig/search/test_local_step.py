"""The last step of a search: near twins are found or ambiguous, never confused."""

from argparse import Namespace
from collections import Counter
from pathlib import Path

import pytest

import hbr
from benchmarks.twins import kind_of, searches
from rig.catalog import Catalog
from rig.config import load_config
from rig.events.compared import Compared
from rig.events.events import Identified, NoteCode, Warned
from rig.plans.enroll import enroll
from rig.plans.identify import identify
from rig.search.model import load_model
from sim.bench import ShelfOperator, open_sim_bench
from sim.objects.shelf import twins
from sim.world import World

SMALL = ("camera.width=320", "camera.height=240", "view.roi=[40, 0, 240, 240]", "identify.max_views=2")


def test_a_missing_image_leaves_the_answer_as_it_is(tmp_path: Path) -> None:
    operator = ShelfOperator(World(seed=1), twins(), next_object="vase-blue", yaw_deg=180.0)
    with (
        open_sim_bench(load_config(None, SMALL), operator) as bench,
        Catalog.open(tmp_path, clock=bench.clock) as catalog,
    ):
        for name in ("vase-blue", "vase-poppy"):
            list(enroll(bench, catalog, name, views=4))
        model = load_model(catalog)
        events = list(identify(bench, model))
        assert any(isinstance(event, Compared) for event in events)
        assert isinstance(events[-1], Identified)
        assert events[-1].outcome is hbr.Outcome.AMBIGUOUS
        for image in tmp_path.glob("images/*-vase-blue/*/*.png"):
            image.unlink()
        *_, warned, answer = identify(bench, model)
        assert isinstance(warned, Warned)
        assert warned.note.code is NoteCode.NOT_COMPARED
        assert isinstance(answer, Identified)
        assert answer.outcome is not hbr.Outcome.FOUND


@pytest.mark.nightly
@pytest.mark.timeout(3600)
def test_near_twins_are_never_confused_in_200_searches() -> None:
    rows = searches(Namespace(searches=200, views=36, modes="dense", alone=False, seed=0, catalog=None))
    kinds = Counter(kind_of(row) for row in rows)
    assert kinds.keys() <= {"found", "ambiguous"}
    assert kinds["found"] > 120
