"""The comparison with enrolled views: near twins are found or ambiguous, never confused."""

from argparse import Namespace
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from math import exp
from pathlib import Path

import pytest

import hbr
from benchmarks.twins import kind_of, searches
from hbr.dense import stopping
from hbr.dense.pixel_fit import LocalView, PixelFit
from rig.bench import Bench
from rig.catalog import Catalog
from rig.config import load_config
from rig.core.errors import MotionStopped
from rig.events.events import Identified, NoteCode, Verified, Warned
from rig.plans.enroll import enroll
from rig.plans.identify import identify
from rig.search.model import load_model
from rig.search.replay import check
from rig.search.saved_run import load_run
from sim.bench import ShelfOperator, open_sim_bench
from sim.objects.shelf import twins
from sim.world import World
from tests.rig.search.run_samples import searched

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


@dataclass(frozen=True)
class Fixed:
    """A model of the evidence with these log-odds that the leader is enrolled, before its fit and with it."""

    before: float
    after: float
    is_common: bool = False

    def log_odds(self, _numbers: object, fit: PixelFit | None) -> float:
        return self.before if fit is None else self.after


@pytest.mark.parametrize(
    ("after", "outcome", "possible"),
    [(6.0, hbr.Outcome.FOUND, 1), (0.0, hbr.Outcome.AMBIGUOUS, 2), (-4.0, hbr.Outcome.UNKNOWN, 0)],
)
def test_a_doubtful_leader_is_verified_and_the_run_replays(
    enrolled: tuple[Bench, Catalog],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    after: float,
    outcome: hbr.Outcome,
    possible: int,
) -> None:
    bench, catalog = enrolled
    model = load_model(catalog)
    monkeypatch.setattr(stopping, "_models", lambda: defaultdict(lambda: Fixed(-1.0, after)))
    for least in ("MIN_CONFIDENCE", "LAST_CONFIDENCE"):
        monkeypatch.setattr(stopping, least, 0.55)  # twins share the probability
    events = searched(tmp_path / "run", bench, model)
    *_, found = (event for event in events if isinstance(event, Verified))
    answer = events[-1]
    assert isinstance(answer, Identified)
    assert (found.name, found.outcome) == ("vase-blue", outcome)
    assert found.not_enrolled == answer.not_enrolled == pytest.approx(1 / (1 + exp(after)))
    assert sum(one.probability or 0.0 for one in answer.candidates) == pytest.approx(1 - found.not_enrolled)
    assert answer.outcome is outcome
    assert len(answer.possible) == possible
    assert 0.5 < found.fit <= 1
    again = check(load_run(tmp_path / "run"))
    assert again.is_complete
    assert not again.differences


def test_a_search_decides_without_a_missing_image(
    enrolled: tuple[Bench, Catalog],
) -> None:
    bench, catalog = enrolled
    model = load_model(catalog)
    images = [catalog.image_path(view.image) for view in catalog.object("vase-blue").views]
    hidden = [image.rename(image.with_suffix(".away")) for image in images]
    try:
        events = list(identify(bench, model))
    finally:
        for image in hidden:
            image.rename(image.with_suffix(".png"))
    (warned,) = (event for event in events if isinstance(event, Warned))  # not after each view
    assert warned.note.code is NoteCode.NOT_COMPARED
    assert not any(isinstance(event, Verified) for event in events)
    assert isinstance(events[-1], Identified)
    assert "vase-blue" in events[-1].possible


def test_a_stop_does_not_wait_for_the_end_of_the_comparison(enrolled: tuple[Bench, Catalog]) -> None:
    bench, catalog = enrolled
    model = load_model(catalog)
    read: list[str] = []

    def stopped_meanwhile(name: str, azimuths_deg: Sequence[float]) -> Sequence[LocalView]:
        read.append(name)
        bench.state.request_stop()
        assert model.leader_views is not None
        return model.leader_views(name, azimuths_deg)

    with pytest.raises(MotionStopped):
        list(identify(bench, replace(model, leader_views=stopped_meanwhile)))
    assert len(read) == 1  # not those of the second candidate


@pytest.mark.nightly
@pytest.mark.timeout(3600)
def test_near_twins_are_never_confused_in_200_searches() -> None:
    rows = searches(Namespace(searches=200, views=36, modes="dense", alone=False, seed=0, catalog=None))
    kinds = Counter(kind_of(row) for row in rows)
    assert kinds.keys() <= {"found", "ambiguous"}
    assert kinds["found"] > 120
