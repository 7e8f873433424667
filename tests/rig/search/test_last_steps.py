"""The last step of a search: near twins are found or ambiguous, never confused."""

from argparse import Namespace
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import hbr
from benchmarks.twins import kind_of, searches
from hbr.dense.session import FOUND_FROM_SAME_BENCH
from hbr.dense.stopping import fitted_before
from rig.bench import Bench
from rig.catalog import Catalog
from rig.config import load_config
from rig.events.compared import Compared, Verified
from rig.events.events import Identified, NoteCode, Warned
from rig.plans.enroll import enroll
from rig.plans.identify import identify
from rig.search.model import load_model
from rig.search.replay import check
from rig.search.saved_run import RunWriter, load_run
from sim.bench import ShelfOperator, open_sim_bench
from sim.objects.shelf import twins
from sim.world import World

SMALL = ("camera.width=320", "camera.height=240", "view.roi=[40, 0, 240, 240]", "identify.max_views=2")


@contextmanager
def twins_bench(seed: int) -> Iterator[Bench]:
    """Open a bench with one of two twins on it."""
    operator = ShelfOperator(World(seed=seed), twins(), next_object="vase-blue", yaw_deg=180.0)
    with open_sim_bench(load_config(None, SMALL), operator) as bench:
        yield bench


@pytest.fixture(scope="module")
def catalog_of_twins(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Enroll both twins, and return the folder of their catalog."""
    folder = tmp_path_factory.mktemp("catalog")
    with twins_bench(1) as bench, Catalog.open(folder, clock=bench.clock) as catalog:
        for name in ("vase-blue", "vase-poppy"):
            list(enroll(bench, catalog, name, views=4))
    return folder


@pytest.fixture
def enrolled(catalog_of_twins: Path) -> Iterator[tuple[Bench, Catalog]]:
    """A bench with the same noise in each test, and the catalog of both twins."""
    with twins_bench(2) as bench, Catalog.open(catalog_of_twins, clock=bench.clock) as catalog:
        yield bench, catalog


def doubtful(rule: hbr.StoppingRule, offset: float) -> hbr.StoppingRule:
    """A rule with which each search is doubtful after its first view; the offset is added to the open-set score."""
    model = fitted_before("edges+colours", 1)
    assert model is not None
    return replace(
        rule,
        min_confidence=0.0,
        usual_scores=rule.usual_scores[:, :1],
        open_set=replace(
            model, weights=model.weights, spread=np.full_like(model.spread, 1e9), offset=np.array([offset])
        ),
        open_set_thresholds=(1e6,),
        unknown_thresholds=(1e6,),
        leave_one_out_thresholds=(1e6,),
    )


@pytest.mark.parametrize(
    ("offset", "outcome", "answered"),
    [
        (2.0, hbr.Outcome.FOUND, hbr.Outcome.FOUND),
        (-3.0, hbr.Outcome.AMBIGUOUS, hbr.Outcome.AMBIGUOUS),
        (-6.8, hbr.Outcome.UNKNOWN, hbr.Outcome.AMBIGUOUS),  # it fits one of two near twins up to noise
    ],
)
def test_a_doubtful_leader_is_verified_and_the_run_replays(
    enrolled: tuple[Bench, Catalog],
    tmp_path: Path,
    offset: float,
    outcome: hbr.Outcome,
    answered: hbr.Outcome,
) -> None:
    bench, catalog = enrolled
    model = load_model(catalog)
    assert model.rule is not None
    model = replace(model, rule=doubtful(model.rule, offset))
    with RunWriter(tmp_path / "run", bench, model) as writer:
        events = list(identify(bench, model))
        for event in events:
            writer.add(event)
    (found,) = (event for event in events if isinstance(event, Verified))
    answer = events[-1]
    assert isinstance(answer, Identified)
    assert (found.name, found.outcome) == ("vase-blue", outcome)
    assert found.found_from == FOUND_FROM_SAME_BENCH  # the bench is that of the enrollment
    assert answer.outcome is answered
    assert len(answer.possible) == (2 if answered is hbr.Outcome.AMBIGUOUS else 1)
    assert (answer.reason is hbr.StopReason.PIXEL_FIT) == (outcome is answered)
    assert 0.5 < found.fit <= 1
    again = check(load_run(tmp_path / "run"))
    assert again.is_complete
    assert not again.differences


def test_a_missing_image_leaves_the_answer_as_it_is(enrolled: tuple[Bench, Catalog]) -> None:
    bench, catalog = enrolled
    model = load_model(catalog)
    events = list(identify(bench, model))
    assert any(isinstance(event, Compared) for event in events)
    assert isinstance(events[-1], Identified)
    assert events[-1].outcome is hbr.Outcome.AMBIGUOUS
    images = [catalog.image_path(view.image) for view in catalog.object("vase-blue").views]
    hidden = [image.rename(image.with_suffix(".away")) for image in images]
    try:
        *_, warned, answer = identify(bench, model)
    finally:
        for image in hidden:
            image.rename(image.with_suffix(".png"))
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
