"""A bench works without its server, and delivers later, each object and answer exactly once, whenever it is killed."""

import errno
import json
import os
import sys
import uuid
from collections.abc import Callable
from pathlib import Path

import pytest
from sqlalchemy import text
from typer.testing import Result

from rig.catalog import Catalog, derived
from rig.catalog.copying import only_program, open_copy, open_or_copy, update_copy
from rig.catalog.jobs import finished
from rig.catalog.journal import Journal, deliver, journal_folder, waiting
from rig.catalog.results import correct, find_results
from rig.catalog.results import record as record_result
from rig.catalog.verify import CatalogProblem, verify
from rig.config.catalog_place import CatalogPlace
from rig.core.clock import SystemClock
from rig.core.errors import CatalogBusy, CatalogDamaged, CatalogError, CatalogUnavailable, ObjectExists
from rig.core.next_steps import Do
from rig.events.events import NoteCode
from rig.plans.tray import TrayItem, left_to_enroll
from rig.search.model import CurrentModel
from tests.programs import Program
from tests.rig.catalog.catalog_samples import PROVENANCE, die_at, fill, image, new_result, record
from tests.servers.postgres import PostgresServer, place_in

CLOCK = SystemClock()


@pytest.fixture
def place(postgres: PostgresServer, tmp_path: Path) -> CatalogPlace:
    """The catalog of a bench, with two objects and a local copy; a second bench has `other_bench`."""
    made = place_in(postgres.url, tmp_path / uuid.uuid4().hex, str(tmp_path / "shared"))
    with Catalog.open(made, clock=CLOCK) as catalog:
        fill(catalog, "mug", 2, 0)
        fill(catalog, "tin", 2, 10)
        update_copy(catalog)
    return made


def names(place: CatalogPlace) -> dict[str, int]:
    with Catalog.open(place, clock=CLOCK, read_only=True) as catalog:
        return {one.name: one.views for one in catalog.objects() if one.enrolled_utc is not None}


def settings_of(place: CatalogPlace) -> list[str]:
    values = {"path": str(place.path), "url": place.url, "images": place.images}
    return [f"catalog.{key}={json.dumps(value)}" for key, value in values.items()]


def same_copy(place: CatalogPlace, catalog: Catalog) -> Catalog:
    """Return the local copy, which has what searches compare with."""
    copy = open_copy(place, CLOCK)
    assert copy.version() == catalog.version()
    assert copy.damage() is None
    assert copy.objects() == catalog.objects()
    return copy


def test_copy_has_the_searched_views_and_is_updated(place: CatalogPlace) -> None:
    with Catalog.open(place, clock=CLOCK) as catalog:
        assert not update_copy(catalog)
        same_copy(place, catalog).close()
        catalog.rename("mug", "cup")
        catalog.set_texts("cup", label="kitchen")
        fill(catalog, "tin", 3, 20, replace=True, empty_table=image(99))
        record_result(catalog, new_result(), image(1))
        made = place.copy_folder.stat().st_ino
        assert update_copy(catalog)
        assert place.copy_folder.stat().st_ino == made  # the copy was not made again as a whole
        with same_copy(place, catalog) as copy:
            assert derived.views(copy).object_names == ("cup", "tin")
            assert copy.database.images.names() == {derived.empty_tables(catalog).newest}
        expected = derived.views(catalog)
        catalog.delete("cup")
        assert update_copy(catalog)
        with same_copy(place, catalog) as copy:  # which has no images to describe
            assert copy.objects(deleted=True) == []  # else it would grow with each update
            views = derived.views(copy)
            assert views.object_names == ("tin",)
            assert views.packed().tolist() == expected.select(expected.object_index == 1).packed().tolist()
            assert derived.described_regions(copy, PROVENANCE.bench) == {(None, ())}
        catalog.undelete("cup")
        assert update_copy(catalog)
        with same_copy(place, catalog) as copy:
            assert derived.views(copy).object_names == ("cup", "tin")
        fill(catalog, "jar", 1, 40)
        expected = derived.views(catalog, "cedd-blurred")  # another program describes the views in another way
        assert update_copy(catalog)
        with same_copy(place, catalog) as copy:
            assert derived.views(copy, "cedd-blurred").packed().tolist() == expected.packed().tolist()


def test_damaged_copy_and_copy_of_another_catalog_are_made_again(
    postgres: PostgresServer, place: CatalogPlace, tmp_path: Path
) -> None:
    file = place.copy_folder / "catalog.sqlite"
    file.write_bytes(file.read_bytes()[:8000])
    with pytest.raises(CatalogUnavailable, match="no copy"):
        open_copy(place, CLOCK)
    left = place.path / ".copy-killed" / place.copy_folder.name  # by a program that was killed
    left.mkdir(parents=True)
    with Catalog.open(place, clock=CLOCK) as catalog:
        with only_program(place.path / "copying", "makes the local copy"), pytest.raises(CatalogBusy):
            update_copy(catalog)
        assert update_copy(catalog)
        assert not list(place.path.glob(".copy-*"))
        same_copy(place, catalog).close()
    other = place_in(postgres.url, tmp_path / uuid.uuid4().hex, str(tmp_path / "other"))
    moved = CatalogPlace(place.path, other.url, other.images)
    with pytest.raises(CatalogUnavailable, match="no copy"):
        open_copy(moved, CLOCK)
    with Catalog.open(moved, clock=CLOCK) as catalog:
        fill(catalog, "jar", 1, 30)
        assert update_copy(catalog)
        same_copy(moved, catalog).close()


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
                fill(journal, "star", 2, 30)
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
            assert journal.objects() == journal.objects(deleted=True) == []
        assert waiting(place, CLOCK) == 0
        assert current().views.object_names == ("mug", "tin", "star")


def test_damaged_catalog_leaves_its_copy_alone(place: CatalogPlace) -> None:
    with Catalog.open(place, clock=CLOCK) as catalog:
        before = catalog.version()
        catalog.rename("mug", "cup")
        with catalog.database.write() as transaction:
            transaction.execute(text("ALTER TABLE log DISABLE TRIGGER USER"))
            transaction.execute(text("UPDATE log SET object_name = 'pot' WHERE object_name = 'cup'"))
        with pytest.raises(CatalogDamaged, match="pot"):
            update_copy(catalog)
        with open_copy(place, CLOCK) as copy:
            assert copy.version() == before
            assert copy.damage() is None


def test_answer_is_delivered_once_with_its_corrections(place: CatalogPlace) -> None:
    with Journal.of(place, CLOCK) as journal, Catalog.open(place, clock=CLOCK) as shared:
        record_result(shared, new_result("found", "tin"), None)
        unconfirmed = new_result("found", "mug")
        record_result(shared, unconfirmed, image(1))  # the bench did not get the confirmation
        for answer in (unconfirmed, new_result("found", "mug", sample="7")):
            record_result(journal, answer, image(1))
        correct(journal, 2, reason="wrong", object_name=None, unknown=True)
        assert waiting(place, CLOCK) == 3
        deliver(journal, shared)
        correct(journal, 2, reason="sample", sample="8")
        assert waiting(place, CLOCK) == 1
        deliver(journal, shared)
        found = find_results(shared)
        assert [one.id for one in found] == [1, 2, 3]
        assert [one.current[1:] for one in found] == [("tin", None), ("mug", None), (None, "8")]
        assert [one.reason for one in found[2].corrections] == ["wrong", "sample"]
        assert [one.time_utc for one in found[1:]][1] == find_results(journal)[1].time_utc
        assert finished(verify(shared, jobs=1)).findings == ()


def test_second_bench_with_a_name_gets_a_conflict(place: CatalogPlace) -> None:
    other_bench = CatalogPlace(place.path / "other", place.url, place.images)
    with (
        Journal.of(place, CLOCK) as first,
        Journal.of(other_bench, CLOCK) as second,
        Catalog.open(place, clock=CLOCK) as shared,
    ):
        with pytest.raises(ObjectExists):
            fill(first, "mug", 2, 40)
        fill(first, "star", 2, 30)
        fill(second, "star", 2, 40)
        assert [one.conflict for one in deliver(first, shared)] == [None]
        (done,) = deliver(second, shared)
        assert isinstance(done.conflict, ObjectExists)
        assert [one.name for one in second.objects()] == ["star"]
        second.rename("star", "star-2")
        assert [one.conflict for one in deliver(second, shared)] == [None]
        fill(first, "mug", 3, 50, replace=True)
        assert [one.conflict for one in deliver(first, shared)] == [None]
        assert names(place) == {"mug": 3, "tin": 2, "star": 2, "star-2": 2}
        assert [one.status for one in shared.object("mug").enrollments] == ["complete", "superseded"]
        assert finished(verify(shared, jobs=1)).findings == ()


def test_conflict_stays_until_the_operator_resolves_it(
    postgres: PostgresServer, place: CatalogPlace, rig: Callable[..., Result]
) -> None:
    postgres.stop()
    try:
        with Journal.of(place, CLOCK) as journal:
            fill(journal, "star", 2, 30)
            fill(journal, "cube", 2, 35)
            fill(journal, "cone", 2, 37)
    finally:
        postgres.start()
    with Catalog.open(place, clock=CLOCK) as shared:
        for number, name in enumerate(("star", "cube", "cone")):
            fill(shared, name, 3, 40 + 3 * number)
    words = [word for one in settings_of(place) for word in ("--set", one)]
    reported = rig("catalog", "deliver", *words)
    assert reported.exit_code == 7, reported.output
    assert "another object of that name. Nothing is lost." in reported.stderr
    assert names(place) == {"mug": 2, "tin": 2, "star": 3, "cube": 3, "cone": 3}
    with Catalog.open(journal_folder(place), clock=CLOCK, read_only=True) as journal:
        assert len(journal.objects()) == 3
    assert rig("catalog", "deliver", "--rename", "star", "star-2", "--discard", "cone", *words).exit_code == 7
    assert rig("catalog", "deliver", "--replace", "cube", *words).exit_code == 0
    assert names(place) == {"mug": 2, "tin": 2, "star": 3, "cube": 2, "cone": 3, "star-2": 2}
    with Catalog.open(place, clock=CLOCK) as shared:
        assert finished(verify(shared, jobs=1)).findings == ()


def test_names_of_the_server_are_known_before_the_table_is_cleared(
    postgres: PostgresServer, place: CatalogPlace
) -> None:
    with Journal.of(place, CLOCK) as journal:
        fill(journal, "star", 2, 30)
        unfinished = journal.begin("cube", planned_azimuth_deg=[0.0], provenance=PROVENANCE)
        unfinished.add(record(0), image(1))
        with pytest.raises(ObjectExists, match="'mug' is enrolled already"):
            journal.check_enrollable("mug")
        journal.check_enrollable("mug", replace=True)
        journal.check_enrollable("cone")
        items = [TrayItem(1, name) for name in ("mug", "star", "cube", "cone", "tin")]
        assert [one.name for one in left_to_enroll(journal, items)] == ["cube", "cone"]
        postgres.stop()
        try:  # by the local copy
            assert [one.name for one in left_to_enroll(journal, items)] == ["cube", "cone"]
            with pytest.raises(ObjectExists, match="'mug' is enrolled already"):
                journal.check_enrollable("mug")
        finally:
            postgres.start()


def test_damage_in_the_journal_stays_there_and_is_reported(place: CatalogPlace) -> None:
    with Journal.of(place, CLOCK) as journal, Catalog.open(place, clock=CLOCK) as shared:
        for number, name in enumerate(("star", "cube", "cone")):
            fill(journal, name, 2, 30 + 3 * number)
        record_result(journal, new_result("found", "star"), image(77))
        (recorded,) = find_results(journal)
        store = journal.database.images
        assert recorded.image is not None
        store.remove([recorded.image, journal.object("cube").views[1].image])
        swapped, other = (view.image for view in journal.object("star").views)
        store.file(swapped).write_bytes(store.read(other))
        done = deliver(journal, shared)
        assert [(one.name, type(one.conflict)) for one in done] == [
            ("star", CatalogDamaged),
            ("cube", CatalogDamaged),
            ("cone", type(None)),
        ]
        assert done[0].conflict is not None
        assert Do.DISCARD(name="star") in done[0].conflict.steps
        assert set(names(place)) == {"mug", "tin", "cone"}
        assert [one.name for one in journal.objects()] == ["star", "cube"]
        (finding,) = finished(verify(shared, jobs=1)).findings
        assert finding.problem is CatalogProblem.MISSING_IMAGE  # of the answer, which is there all the same


def test_wrong_password_and_absent_server_have_their_own_messages(
    postgres: PostgresServer, place: CatalogPlace, rig: Callable[..., Result], monkeypatch: pytest.MonkeyPatch
) -> None:
    words = [word for one in settings_of(place) for word in ("--set", one)]
    nowhere = str(place.url).replace("/postgres?", "/nowhere?")
    denied = rig("catalog", "list", *words, "--set", f"catalog.url={json.dumps(nowhere)}")
    assert (denied.exit_code, "denies the connection" in denied.stderr) == (7, True)
    assert "~/.pgpass" in denied.stderr
    other = rig("catalog", "list", *words, "--set", 'catalog.url="mysql://host/rig"')
    assert (other.exit_code, "is not the URL of a PostgreSQL database" in other.stderr) == (3, True)
    postgres.stop()
    try:
        gone = rig("catalog", "deliver", *words)
    finally:
        postgres.start()
    assert (gone.exit_code, "does not answer" in gone.stderr) == (7, True)
    missing = rig("catalog", "deliver", "--replace", "star", *words)
    assert "There is no object 'star'" in missing.stderr
    with Journal.of(place, CLOCK) as journal:
        fill(journal, "star", 2, 30)
    monkeypatch.setattr("rig.core.files.open_new", _full)
    full = rig("identify", *words)
    assert "is full" in full.stderr
    assert "What is in the journal of this computer is delivered later" in full.stderr
    assert waiting(place, CLOCK) == 1


def _full(*_: object, **__: object) -> None:
    raise OSError(errno.ENOSPC, "No space left on device")


def test_bench_works_while_its_share_is_not_mounted(place: CatalogPlace, tmp_path: Path) -> None:
    share = tmp_path / "shared"
    share.rename(tmp_path / "not mounted")
    for mount_point in (False, True):
        if mount_point:
            share.mkdir()
        with open_or_copy(place, CLOCK) as copy:
            assert copy.copied_utc is not None
        with Journal.of(place, CLOCK) as journal:
            fill(journal, f"star {mount_point}", 2, 30)
            assert journal.unreachable is not None
            assert "Mount the network share" in journal.unreachable.next_step
    share.rmdir()
    (tmp_path / "not mounted").rename(share)
    with Journal.of(place, CLOCK) as journal, Catalog.open(place, clock=CLOCK) as shared:
        assert [one.conflict for one in deliver(journal, shared)] == [None, None]
        assert finished(verify(shared, jobs=1)).findings == ()


def test_each_object_of_a_tray_is_delivered_and_none_is_asked_for_again(
    postgres: PostgresServer, rig: Callable[..., Result], tmp_path: Path
) -> None:
    place = place_in(postgres.url, tmp_path / uuid.uuid4().hex, str(tmp_path / "shared"))
    words = [word for one in settings_of(place) for word in ("--set", one)]
    words += [
        "--views",
        "4",
        "--set",
        "camera.width=320",
        "--set",
        "camera.height=240",
        "--set",
        "view.roi=[40,0,240,240]",
    ]
    seen = []
    for listed in (["toy-house"], ["toy-house", "toy-car", "mug"]):  # the first one into an empty database
        (tmp_path / "tray.csv").write_text("name\n" + "\n".join(listed))
        done = rig("enroll", "--list", "tray.csv", "--json", *words)
        assert done.exit_code == 0, done.output
        events = [json.loads(line) for line in done.stdout.splitlines()]
        seen.append([(one["name"], one["action"]) for one in events if one["event"] == "item"])
        assert f"Delivered {listed[min(1, len(listed) - 1)]} with 4 views" in done.stderr
        with Catalog.open(place, clock=CLOCK) as other_bench:
            if "mug" not in names(place):
                fill(other_bench, "mug", 2, 0)
    assert seen == [
        [("toy-house", "enroll")],
        [("toy-house", "skip"), ("toy-car", "enroll"), ("mug", "skip")],
    ]
    assert names(place) == {"mug": 2, "toy-house": 4, "toy-car": 4}


def killed(kind: str) -> None:
    """Enroll an object through the journal, or deliver the journal, and die before a durable step."""
    folder, url, shared_images, step = sys.argv[1:5]
    here = CatalogPlace(Path(folder), url, shared_images)
    with Journal.of(here, CLOCK) as journal, Catalog.open(here, clock=CLOCK) as shared:
        die_at(int(step))
        if kind == "enrollment":
            fill(journal, f"object {step}", 2, int(step))
        else:
            deliver(journal, shared)
    print("not killed", flush=True)
    os._exit(0)


def finish(journal: Journal, name: str, step: int) -> None:
    """Enroll an object, or complete the enrollment of a killed program."""
    known = {one.name: one for one in journal.known_objects()}.get(name)
    if known is None:
        fill(journal, name, 2, step)
    elif known.unfinished_views is not None:
        enrollment = journal.resume(name, provenance=PROVENANCE)
        for index in enrollment.missing():
            enrollment.add(record(index), image(step + index))
        enrollment.finish()


@pytest.mark.parametrize("every", [7, pytest.param(1, marks=pytest.mark.nightly)])
@pytest.mark.parametrize("kind", ["enrollment", "delivery"])
def test_kill_at_any_point_loses_and_doubles_nothing(place: CatalogPlace, kind: str, every: int) -> None:
    expected = names(place)
    for step in range(1, 200, every):
        name = f"object {step}"
        expected[name] = 2
        if kind == "delivery":
            with Journal.of(place, CLOCK) as journal:
                fill(journal, name, 2, step)
        code = f"from tests.servers.test_offline import killed; killed({kind!r})"
        program = Program(str(place.path), str(place.url), str(place.images), str(step), code=code)
        out, errors = program.communicate(60)
        with Journal.of(place, CLOCK) as journal, Catalog.open(place, clock=CLOCK) as shared:
            finish(journal, name, step)
            assert {one.conflict for one in deliver(journal, shared)} <= {None}
            assert journal.objects() == []
        assert names(place) == expected, step
        if "not killed" in out:
            break
        assert program.returncode == -9, errors
    else:
        raise AssertionError(f"the {kind} has more steps")
    assert step > 10
    with Catalog.open(place, clock=CLOCK) as shared:
        assert finished(verify(shared, jobs=1)).findings == ()
        assert {one.unfinished_views for one in shared.objects()} == {None}


@pytest.mark.parametrize(
    ("version", "error", "words"),
    [("2", CatalogError, "another version of the program"), ("0", CatalogDamaged, "version")],
)
def test_catalog_of_another_version_is_not_used(
    place: CatalogPlace, version: str, error: type[CatalogError], words: str
) -> None:
    with Catalog.open(place, clock=CLOCK) as catalog:
        with catalog.database.write() as connection:
            connection.execute(text(f"UPDATE properties SET value = '{version}' WHERE key = 'version'"))
        for attempt in (catalog.objects, lambda: fill(catalog, "jar", 1, 9)):
            with pytest.raises(error, match=words):
                attempt()
    for read_only in (False, True):
        with pytest.raises(error, match=words):
            Catalog.open(place, clock=CLOCK, read_only=read_only)
