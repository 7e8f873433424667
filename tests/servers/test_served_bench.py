"""A served bench, and `--watch`, work while the server of the catalog is gone, and deliver when it is back."""

import json
import threading
from collections.abc import Callable
from itertools import groupby
from pathlib import Path
from typing import Any

import pytest

from rig.catalog import Catalog, derived
from rig.catalog.copying import open_copy, update_copy
from rig.catalog.jobs import finished
from rig.catalog.journal import BackgroundDelivery, Journal, JournalState, waiting
from rig.catalog.results import find_results
from rig.catalog.verify import verify
from rig.config.catalog_place import CatalogPlace
from rig.core.clock import SystemClock
from rig.events.events import NoteCode
from rig.search.model import CurrentModel
from tests.rig.catalog.catalog_samples import fill
from tests.rig.web.conftest import Served, serve  # noqa: F401 - a fixture
from tests.servers.postgres import PostgresServer, place_in

CLOCK = SystemClock()
SMALL = ("camera.width=320", "camera.height=240", "view.roi=[40,0,240,240]", "bench.sim.object='mug-white'")


@pytest.fixture
def place(postgres: PostgresServer, tmp_path: Path) -> CatalogPlace:
    return place_in(postgres.url, tmp_path / "catalog", str(tmp_path / "shared"))


def served_at(start: Callable[..., Served], place: CatalogPlace) -> Served:
    return start(f"catalog.url={json.dumps(place.url)}", f"catalog.images={json.dumps(place.images)}", *SMALL)


def wait_until(condition: Callable[[], Any]) -> Any:
    for _ in range(3000):
        if found := condition():
            return found
        threading.Event().wait(0.01)
    pytest.fail("it does not happen")


def test_served_bench_works_without_the_server_and_delivers_once(
    postgres: PostgresServer,
    place: CatalogPlace,
    serve: Callable[..., Served],  # noqa: F811
) -> None:
    served = served_at(serve, place)
    catalog = served.server.catalog
    for name in ("mug-white", "lamp"):
        job = served.run(kind="enroll", name=name, views=4)
        assert job["state"] == "done", job["error"]
        assert f"Delivered {name} with 4 views" in job["result_text"]
    assert served.run(kind="identify", max_views=2)["state"] == "done"  # and makes the local copy
    postgres.stop()
    try:
        job = served.run(kind="identify", max_views=2)
        assert job["state"] == "done", job["error"]
        texts = [json.loads(one.data).get("text", "") for one in served.server.hub.since(0)[0] if one.kind == "plan"]
        assert any("this uses the copy of" in text for text in texts)
        assert [one["name"] for one in served.client.get("/api/v1/objects").json()["items"]] == ["lamp", "mug-white"]
        assert served.client.get("/api/v1/status").json()["catalog"]["local_copy_utc"].endswith("UTC")
        job = served.run(kind="enroll", name="teapot", views=4)
        assert job["state"] == "done", job["error"]
        assert "is delivered later" in job["result_text"]
        assert served.run(kind="enroll", name="mug-star", views=4)["state"] == "done"
        taken = served.run(kind="enroll", name="lamp", views=4)  # the local copy has it
        assert "enrolled already" in taken["error"]["detail"]
        assert "does not answer" in served.client.patch("/api/v1/objects/lamp", json={"label": "x"}).json()["detail"]
        assert waiting(place, CLOCK) == 3
    finally:
        postgres.start()
    with Catalog.open(place, clock=CLOCK) as other_bench:
        fill(other_bench, "mug-star", 2, 30)
    with catalog.background_delivery():  # beside the worker, which is idle
        state = wait_until(lambda: catalog.state["reasons"] and waiting(place, CLOCK) == 1 and catalog.state)
    (conflict,) = state["reasons"]
    assert "another object of that name. Nothing is lost." in conflict
    assert "rig catalog deliver --rename mug-star" in conflict
    shown = [json.loads(one.data) for one in served.server.hub.since(0)[0] if one.kind == "catalog"]
    assert shown[-1] == served.client.get("/api/v1/status").json()["catalog"]
    assert shown[-1]["reasons"] == [conflict]
    served.client.get("/api/v1/objects")
    assert served.client.get("/api/v1/status").json()["catalog"]["local_copy_utc"] is None
    with Catalog.open(place, clock=CLOCK) as shared:
        assert {one.name: one.views for one in shared.objects()} == {
            "mug-white": 4,
            "lamp": 4,
            "teapot": 4,
            "mug-star": 2,
        }
        assert len(find_results(shared)) == 2
        assert finished(verify(shared, jobs=1)).findings == ()


def test_journal_is_delivered_in_the_middle_of_a_run(postgres: PostgresServer, place: CatalogPlace) -> None:
    with Catalog.open(place, clock=CLOCK) as shared:
        fill(shared, "mug", 2, 0)
        update_copy(shared)
    postgres.stop()
    said: list[str] = []
    states: list[JournalState] = []
    try:
        with Journal.of(place, CLOCK) as journal:
            fill(journal, "star", 2, 30)
        begun = (
            open_copy(place, CLOCK),
            BackgroundDelivery(place, CLOCK, said.append, changed=states.append, check_s=0.01, retry_s=0.05),
        )
        with begun[0] as copy, CurrentModel(copy) as model, begun[1]:
            assert NoteCode.LOCAL_COPY in {note.code for note in model().notes}
            wait_until(lambda: states)
            assert NoteCode.LOCAL_COPY in {note.code for note in model().notes}
            postgres.start()
            wait_until(lambda: states[-1] == JournalState())
            found = wait_until(lambda: "star" in model().views.object_names and model())
            assert NoteCode.LOCAL_COPY not in {note.code for note in found.notes}
    finally:
        if not postgres.runs:
            postgres.start()
    # a server that starts is another reason than one that is stopped
    assert [waiting for waiting, _ in groupby(state.waiting for state in states)] == [1, 0]
    assert len(said) > 1
    assert all("is delivered later" in words for words in said[:-1])
    assert said[-1].startswith("Delivered star with 2 views")
    with open_copy(place, CLOCK) as copy:  # it follows the first search after the outage
        assert derived.views(copy).object_names == ("mug", "star")
