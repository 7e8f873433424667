"""A bench works without its server, and delivers later, each object exactly once, whenever it is killed."""

import json
import os
import sys
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from typer.testing import Result

from rig.catalog import Catalog, edit
from rig.catalog.journal import Journal, deliver, journal_folder, waiting
from rig.catalog.local_copy import open_copy, update_copy
from rig.catalog.results import find_results
from rig.catalog.results import record as record_result
from rig.catalog.verify import Problem, verify
from rig.config.catalog_place import CatalogPlace
from rig.core.clock import SystemClock
from rig.core.errors import CatalogError, CatalogUnavailable, ObjectExists
from rig.events.events import NoteCode
from rig.search.current_model import CurrentModel
from tests.programs import Program
from tests.rig.catalog.catalog_samples import die_at, finished, image, new_result, true_fill
from tests.servers.postgres import PostgresServer, place_in, server

CLOCK = SystemClock()


@pytest.fixture(scope="module")
def postgres() -> Iterator[PostgresServer]:
    with server() as running:
        yield running


@pytest.fixture
def place(postgres: PostgresServer, tmp_path: Path) -> CatalogPlace:
    """The catalog of a bench, with two objects and a local copy; a second bench has `other_bench`."""
    made = place_in(postgres.url, tmp_path / uuid.uuid4().hex, str(tmp_path / "shared"))
    with Catalog.open(made, clock=CLOCK) as catalog:
        true_fill(catalog, "mug", 2, 0)
        true_fill(catalog, "tin", 2, 10)
        update_copy(catalog)
    return made


def names(place: CatalogPlace) -> dict[str, int]:
    with Catalog.open(place, clock=CLOCK, read_only=True) as catalog:
        return {one.name: one.views for one in catalog.objects() if one.enrolled_utc is not None}


def test_copy_has_what_searches_compare_and_follows(place: CatalogPlace) -> None:
    with Catalog.open(place, clock=CLOCK) as catalog:
        assert not update_copy(catalog)
        with open_copy(place, CLOCK) as copy:
            assert copy.version() == catalog.version()
            assert copy.damage() is None
        edit.rename(catalog, "mug", "cup")
        true_fill(catalog, "tin", 3, 20, replace=True)
        assert update_copy(catalog)
        with open_copy(place, CLOCK) as copy:
            assert copy.version() == catalog.version()
            assert copy.damage() is None
        edit.delete(catalog, "cup")
        assert update_copy(catalog)
        with open_copy(place, CLOCK) as copy:
            assert copy.views().views.object_names == ("tin",)


def test_bench_works_without_its_server(postgres: PostgresServer, place: CatalogPlace) -> None:
    with Catalog.open(place, clock=CLOCK, read_only=True) as catalog:
        current = CurrentModel(catalog)
        assert NoteCode.LOCAL_COPY not in {note.code for note in current().notes}
        postgres.stop()
        try:
            assert NoteCode.LOCAL_COPY in {note.code for note in current().notes}
            with pytest.raises(CatalogUnavailable, match="does not answer"):
                Catalog.open(place, clock=CLOCK, read_only=True)
            with open_copy(place, CLOCK) as copy:
                model = CurrentModel(copy)()
            (note,) = (note for note in model.notes if note.code is NoteCode.LOCAL_COPY)
            assert str(note.values["copied_utc"]).endswith("UTC")
            with Journal.of(place, CLOCK) as journal:
                true_fill(journal, "star", 2, 30)
                assert isinstance(journal.unreachable, CatalogUnavailable)
                record_result(journal, new_result("found", "star"), image(1))
                assert waiting(place, CLOCK) == 2
        finally:
            postgres.start()
        assert NoteCode.LOCAL_COPY not in {note.code for note in current().notes}
        with Journal.of(place, CLOCK) as journal, Catalog.open(place, clock=CLOCK) as shared:
            (done,) = deliver(journal, shared)
            assert (done.name, done.views, done.conflict) == ("star", 2, None)
            assert deliver(journal, shared) == []
            assert [one.current.object_name for one in find_results(shared)] == ["star"]
            assert finished(verify(shared, jobs=1)).findings == ()
            assert journal.objects() == []
        assert waiting(place, CLOCK) == 0
        assert current().index.views.object_names == ("mug", "tin", "star")


def test_name_is_reserved_while_the_server_answers(place: CatalogPlace) -> None:
    with Journal.of(place, CLOCK) as journal, Catalog.open(place, clock=CLOCK) as shared:
        true_fill(journal, "star", 2, 30)
        with pytest.raises(CatalogError, match="unfinished"):
            true_fill(shared, "star", 2, 40)
        with pytest.raises(ObjectExists):
            true_fill(journal, "mug", 2, 40)
        assert [one.conflict for one in deliver(journal, shared)] == [None]
        with shared.database.read() as connection:
            assert shared.database.orphans(connection) == []
        begun = journal.begin(
            "gone", planned_azimuth_deg=[0.0], provenance=shared.object("tin").views[0].session.provenance
        )
        begun.discard()
        deliver(journal, shared)
        true_fill(shared, "gone", 1, 50)  # the reservation was given up


def test_conflict_is_kept_and_resolved_by_a_person(
    postgres: PostgresServer, place: CatalogPlace, rig: Callable[..., Result]
) -> None:
    postgres.stop()
    try:
        with Journal.of(place, CLOCK) as journal:
            true_fill(journal, "star", 2, 30)
            true_fill(journal, "cube", 2, 35)
            true_fill(journal, "cone", 2, 37)
    finally:
        postgres.start()
    with Catalog.open(place, clock=CLOCK) as shared:
        for number, name in enumerate(("star", "cube", "cone")):
            true_fill(shared, name, 3, 40 + 3 * number)
    settings = [f"catalog.path={json.dumps(str(place.path))}", f"catalog.url={json.dumps(place.url)}"]
    settings.append(f"catalog.images={json.dumps(place.images)}")
    words = [word for one in settings for word in ("--set", one)]
    reported = rig("catalog", "deliver", *words)
    assert reported.exit_code == 7, reported.output
    assert "another object of that name; nothing is lost" in reported.stderr
    assert names(place) == {"mug": 2, "tin": 2, "star": 3, "cube": 3, "cone": 3}
    with Catalog.open(journal_folder(place), clock=CLOCK, read_only=True) as journal:
        assert len(journal.objects()) == 3
    assert rig("catalog", "deliver", "--rename", "star", "star-2", "--discard", "cone", *words).exit_code == 7
    assert rig("catalog", "deliver", "--replace", "cube", *words).exit_code == 0
    assert names(place) == {"mug": 2, "tin": 2, "star": 3, "cube": 2, "cone": 3, "star-2": 2}
    with Catalog.open(place, clock=CLOCK) as shared:
        assert finished(verify(shared, jobs=1)).findings == ()


def killed_delivery() -> None:
    """Deliver, and die before a durable step."""
    folder, url, shared_images, step = sys.argv[1:5]
    here = CatalogPlace(Path(folder), url, shared_images)
    with Journal.of(here, CLOCK) as journal, Catalog.open(here, clock=CLOCK) as shared:
        die_at(int(step))
        deliver(journal, shared)
    print("all delivered", flush=True)
    os._exit(0)


@pytest.mark.parametrize("every", [5, pytest.param(1, marks=pytest.mark.nightly)])
def test_kill_at_any_point_loses_and_doubles_nothing(place: CatalogPlace, every: int) -> None:
    code = "from tests.servers.test_offline import killed_delivery; killed_delivery()"
    expected = names(place)
    for step in range(1, 200, every):
        name = f"object {step}"
        with Journal.of(place, CLOCK) as journal:
            true_fill(journal, name, 2, step)
        expected[name] = 2
        program = Program(str(place.path), str(place.url), str(place.images), str(step), code=code)
        out, errors = program.communicate(60)
        with Journal.of(place, CLOCK) as journal, Catalog.open(place, clock=CLOCK) as shared:
            deliver(journal, shared)
            assert journal.objects() == []
        assert names(place) == expected, step
        if "all delivered" in out:
            break
        assert program.returncode == -9, errors
    else:
        raise AssertionError("the delivery has more steps")
    assert step > 10
    with Catalog.open(place, clock=CLOCK) as shared:
        found = {one.problem for one in finished(verify(shared, quick=True, jobs=1)).findings}
        assert found <= {Problem.ORPHANED_FILE}
