"""A catalog from an untrusted sender cannot reach outside its folder, and every change of its database is noticed."""

import json
import os
import random
import shutil
import sqlite3
import stat
import struct
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import pytest
from typer.testing import Result

from rig.catalog import Action, Catalog, derived
from rig.catalog.exchange.bundle import read_bundle, write_bundle
from rig.catalog.facts import Enrollment, Entry, Session, View, digested, sha256_of
from rig.catalog.images import name_of, path_of
from rig.catalog.results import correct, find_results
from rig.catalog.results import record as record_result
from rig.catalog.transfer import CatalogSource, transfer
from rig.catalog.upkeep import collect_garbage
from rig.catalog.verify import CatalogProblem, verify
from rig.core.errors import CatalogDamaged, RigError
from rig.core.files import write
from rig.core.next_steps import Do
from rig.views import image_files as images
from rig.views.description import BENCH_DESCRIPTOR
from sim.clock import VirtualClock
from tests.rig.catalog.catalog_samples import (
    PROVENANCE,
    fill,
    finished,
    image,
    new_result,
    plan,
    record,
    sql,
    without_waiting,
)
from tests.rig.cli.noise_photographs import photographs

pytestmark = pytest.mark.sqlite

SECRET = b"not a part of the catalog"


@pytest.fixture(scope="module")
def sample(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a catalog with a complete, a superseded, an unfinished and a deleted enrollment."""
    folder = tmp_path_factory.mktemp("sample") / "catalog"
    with pytest.MonkeyPatch.context() as patch, Catalog.open(folder, clock=VirtualClock()) as catalog:
        without_waiting(patch)
        fill(catalog, "mug", 3, 0, label="kitchen", note="a chip")
        fill(catalog, "mug", 2, 10, (2, 0, 28, 24), replace=True)
        fill(catalog, "gone", 1, 90)
        catalog.delete("gone")
        tin = catalog.begin("tin", planned_azimuth_deg=plan(3), provenance=PROVENANCE, empty_table=image(99))
        tin.add(record(0, imu_deg=0.1, imu_sigma_deg=0.5, evidence={"sharpness": 12.5}), image(30))
        record_result(catalog, new_result(sample="S-1"), image(1))
        correct(catalog, 1, unknown=True, reason="read the label")
    return folder


@pytest.fixture
def root(sample: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(sample, tmp_path / "catalog"))


@pytest.fixture
def outside(tmp_path: Path) -> Iterator[Path]:
    """Return a file outside of the catalog, and check at the end that it is unchanged."""
    path = tmp_path / "secret.png"
    path.write_bytes(SECRET)
    yield path
    assert path.read_bytes() == SECRET
    assert {one.name for one in tmp_path.iterdir()} <= {"secret.png", "catalog", "other", "new", "folder"}


def content(root: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(root)): path.read_bytes()
        for path in sorted(root.rglob("*"))
        if path.is_file() and not path.name.endswith(("-shm", "-wal"))
    }


def opened(root: Path) -> Catalog:
    return Catalog.open(root, clock=VirtualClock(), create=False)


def seal_as_the_sender(root: Path) -> None:
    """Compute all digests again, as an attacker would do."""
    statements, seals, before, counts = list[str](), dict[int, str](), "", [0, 0, 0]

    def names(table: type[Any]) -> str:
        return ", ".join(column.name for _, column in digested(table))

    with closing(sqlite3.connect(root / "catalog.sqlite")) as connection:
        connection.text_factory = lambda stored: stored.decode(errors="surrogateescape")
        for number, key, *values in connection.execute(f"SELECT id, key, {names(Enrollment)} FROM enrollments"):
            digests = [sha256_of((key, *values))]
            statements.append(f"UPDATE enrollments SET digest = '{digests[0]}' WHERE id = {number}")
            for table, order in ((Session, "number"), (View, "view_index")):
                query = (
                    f"SELECT rowid, {names(table)} FROM {table.__tablename__} WHERE enrollment_id = ? ORDER BY {order}"
                )
                for row_id, *row in connection.execute(query, (number,)):
                    digests.append(sha256_of((key, *row)))
                    statements.append(
                        f"UPDATE {table.__tablename__} SET digest = '{digests[-1]}' WHERE rowid = {row_id}"
                    )
            seals[number] = sha256_of(tuple(digests))
        columns = [name for name, _ in digested(Entry)]
        for values in connection.execute(f"SELECT {names(Entry)} FROM log ORDER BY id").fetchall():
            line = dict(zip(columns, values, strict=True))
            if line["seal"] is not None and line["enrollment_id"] in seals:
                line["seal"] = seals[line["enrollment_id"]]
                statements.append(f"UPDATE log SET seal = '{line['seal']}' WHERE id = {line['id']}")
            before = sha256_of((before, *line.values()))
            for place, name in enumerate(("deleted", "status", "result")):
                counts[place] += line[name] is not None
            statements.append(f"UPDATE log SET digest = '{before}' WHERE id = {line['id']}")
    head = " ".join(map(str, (line["id"], before, *counts)))
    statements.append(f"UPDATE properties SET value = '{head}' WHERE key = 'head'")
    sql(root, *statements)


def export(catalog: Catalog, folder: Path) -> None:
    write_bundle(folder / "folder", CatalogSource(catalog))


def move(catalog: Catalog, folder: Path) -> None:
    with Catalog.open(folder / "new", clock=VirtualClock()) as other:
        try:
            finished(transfer(CatalogSource(catalog, own=False), other, jobs=1))
        except RigError:
            assert other.objects() == []
            raise


def answer(catalog: Catalog, _: Path) -> None:
    derived.views(catalog, BENCH_DESCRIPTOR)
    derived.camera_settings(catalog)
    derived.empty_tables(catalog)
    derived.described_regions(catalog, "bench-1")
    derived.local_views(catalog, "mug", [0.0])


READERS: dict[str, Callable[[Catalog, Path], Any]] = {
    "gc": lambda catalog, _: collect_garbage(catalog, old=True),
    "verify": lambda catalog, _: finished(verify(catalog, jobs=1)),
    "export": export,
    "transfer": move,
    "list": lambda catalog, _: (catalog.objects(), catalog.objects(deleted=True)),
    "show": lambda catalog, _: [catalog.read_image(view.image) for view in catalog.object("mug").views],
    "identify": answer,
    "log": lambda catalog, _: (catalog.log(), find_results(catalog)),
    "enroll again": lambda catalog, _: fill(catalog, "mug", 2, replace=True),
    "continue": lambda catalog, _: catalog.resume("tin", provenance=PROVENANCE),
    "rename": lambda catalog, _: catalog.rename("mug", "cup"),
    "undelete": lambda catalog, _: catalog.undelete("gone"),
}


@pytest.mark.parametrize("reader", ["gc", "export", "transfer", "show"])
@pytest.mark.parametrize("kind", ["link", "folder link", "link beside"])
def test_images_that_lead_out_are_rejected(root: Path, outside: Path, kind: str, reader: str) -> None:
    """View 1 belongs to the superseded enrollment, 4 to the complete one."""
    with opened(root) as catalog:
        name = catalog.view(1 if reader == "gc" else 4).image
    target = root / path_of(name)
    match kind:
        case "link":
            target.unlink()
            target.symlink_to(outside)
        case "folder link":
            shutil.move(target.parent, root.parent / "other")
            target.parent.symlink_to(root.parent / "other")
        case "link beside":
            target.unlink()
            target.symlink_to(root / "catalog.sqlite")
    before = content(root)
    with pytest.raises(RigError) as error, opened(root) as catalog:
        READERS[reader](catalog, root.parent)
    assert reader in ("export", "transfer") or "exported bundle" in error.value.next_step
    assert content(root) == before


@pytest.mark.parametrize("name", ["../secret.png", "/secret.png", "images/../../secret.png", "catalog.sqlite", ""])
@pytest.mark.parametrize("reader", ["gc", "export", "transfer", "show"])
def test_image_names_that_are_paths_are_rejected(root: Path, outside: Path, name: str, reader: str) -> None:
    sql(root, f"UPDATE views SET image = '{name}'")
    seal_as_the_sender(root)
    before = content(root)
    with pytest.raises(CatalogDamaged), opened(root) as catalog:
        READERS[reader](catalog, root.parent)
    assert content(root) == before
    assert outside.exists()


@pytest.mark.parametrize("name", ["images", "catalog.sqlite", "catalog.sqlite-wal"])
def test_links_in_the_folder_are_rejected(root: Path, tmp_path: Path, outside: Path, name: str) -> None:
    other = tmp_path / "other"
    if (root / name).exists():
        shutil.move(root / name, other)
    else:
        other.mkdir()
        (other / "precious.png").write_bytes(SECRET)
    (root / name).symlink_to(other)
    with pytest.raises(CatalogDamaged, match="leads to another place"), opened(root) as catalog:
        collect_garbage(catalog, old=True)
    assert outside.exists()
    assert other.is_file() or any(other.iterdir())


@pytest.mark.parametrize("suffix", ["wal", "shm", "journal"])
@pytest.mark.parametrize("kind", ["pipe", "hard link", "folder"])
def test_files_of_sqlite_are_regular_files_with_one_name(root: Path, outside: Path, suffix: str, kind: str) -> None:
    file = root / f"catalog.sqlite-{suffix}"
    match kind:
        case "pipe":
            os.mkfifo(file)
        case "hard link":
            file.hardlink_to(outside)
        case _:
            file.mkdir()
    with pytest.raises(CatalogDamaged, match="leads to another place"):
        opened(root)


def rollback_journal(database: Path, *, names: Path) -> bytes:
    """Return a journal that SQLite plays back. It changes no page, and ``names`` a file that SQLite then deletes."""
    magic = bytes.fromhex("d9d505f920a163d7")
    content = database.read_bytes()
    page_size = int.from_bytes(content[16:18], "big")
    page = content[:page_size]
    checksum = sum(page[at] for at in range(page_size - 200, 0, -200))
    header = magic + struct.pack(">5I", 1, 0, len(content) // page_size, 512, page_size)
    made = header.ljust(512, b"\0") + struct.pack(">I", 1) + page + struct.pack(">I", checksum)
    name = os.fsencode(names)
    return made + struct.pack(">I", 2**30 // page_size + 1) + name + struct.pack(">2I", len(name), sum(name)) + magic


COMMANDS = ("catalog gc --yes", "catalog verify", "enroll cup --views 4", "import other --jobs 1", "export a.zip")


@pytest.mark.parametrize("mode", ["wal", "delete"])
@pytest.mark.parametrize("command", COMMANDS)
def test_journal_that_names_a_file_is_not_played_back(
    root: Path, tmp_path: Path, rig: Callable[..., Result], command: str, mode: str
) -> None:
    sql(root, f"PRAGMA journal_mode = {mode}")
    precious = tmp_path / "precious.txt"
    precious.write_bytes(SECRET)
    photographs(tmp_path / "photographs", "vase")
    if "other" in command:
        root = root.rename(tmp_path / "other")
    (root / "catalog.sqlite-journal").write_bytes(rollback_journal(root / "catalog.sqlite", names=precious))
    before = content(root)
    result = rig(*command.split())
    assert result.exit_code == 7
    assert "is a journal of another program" in " ".join(result.stderr.split())
    assert "exported bundle" in result.stderr
    assert precious.read_bytes() == SECRET
    assert content(root) == before


def test_empty_database_with_a_journal_is_not_used(root: Path, outside: Path) -> None:
    (root / "catalog.sqlite-journal").write_bytes(rollback_journal(root / "catalog.sqlite", names=outside))
    (root / "catalog.sqlite").write_bytes(b"")
    with pytest.raises(CatalogDamaged, match="journal of another program"):
        Catalog.open(root, clock=VirtualClock())


def test_catalog_that_is_opened_for_writing_has_a_write_ahead_log(root: Path) -> None:
    sql(root, "PRAGMA journal_mode = delete")
    with Catalog.open(root, clock=VirtualClock(), read_only=True) as catalog:
        assert len(catalog.objects()) == 2
    with opened(root) as catalog:
        assert finished(verify(catalog, jobs=1)).findings == ()
    assert (root / "catalog.sqlite").read_bytes()[18:20] == b"\2\2"


@pytest.mark.parametrize("name", ["link", "3f", "3f/link.png"])
def test_garbage_behind_links_is_not_collected(root: Path, tmp_path: Path, outside: Path, name: str) -> None:
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "precious.png").write_bytes(SECRET)
    link = root / "images" / name
    shutil.rmtree(link, ignore_errors=True)
    link.parent.mkdir(exist_ok=True)
    link.symlink_to(tmp_path / "other")
    os.mkfifo(link.with_name("pipe"))
    with opened(root) as catalog:
        collect_garbage(catalog)
    assert (tmp_path / "other" / "precious.png").read_bytes() == SECRET
    assert outside.exists()


@pytest.mark.parametrize("kind", ["link", "hard link", "pipe"])
def test_part_files_are_not_followed(tmp_path: Path, outside: Path, kind: str) -> None:
    part = tmp_path / "folder" / "a.png.part"
    part.parent.mkdir()
    match kind:
        case "link":
            part.symlink_to(outside)
        case "hard link":
            part.hardlink_to(outside)
        case _:
            os.mkfifo(part)
    write(part.with_suffix(""), b"new")
    assert part.with_suffix("").read_bytes() == b"new"


@pytest.mark.parametrize("umask", [0o000, 0o022, 0o277])
def test_new_catalog_is_private(tmp_path: Path, umask: int) -> None:
    before = os.umask(umask & 0o077)
    try:
        with Catalog.open(tmp_path / "deep" / "catalog", clock=VirtualClock()) as catalog:
            fill(catalog, "mug", 1, 0)
            write_bundle(tmp_path / "a.zip", CatalogSource(catalog))
        with (
            Catalog.open(tmp_path / "new", clock=VirtualClock()) as new,
            read_bundle(tmp_path / "a.zip", VirtualClock()) as source,
        ):
            finished(transfer(source, new, jobs=1))
    finally:
        os.umask(before)
    for top in (tmp_path / "deep" / "catalog", tmp_path / "new"):
        for path in (top, *top.rglob("*")):
            assert stat.S_IMODE(path.stat().st_mode) == (0o700 if path.is_dir() else 0o600), path


@pytest.mark.parametrize(
    "statement",
    [
        "CREATE TRIGGER evil AFTER UPDATE ON derived BEGIN DELETE FROM derived; END",
        "CREATE TRIGGER evil AFTER INSERT ON log BEGIN DELETE FROM derived; END",
        "CREATE VIEW evil AS SELECT * FROM views",
        "CREATE TABLE evil (x)",
        "CREATE INDEX evil ON views (image)",
        "DROP TRIGGER log_no_update",
        "ALTER TABLE views ADD COLUMN evil TEXT",
    ],
)
def test_foreign_schema_is_rejected(root: Path, statement: str) -> None:
    with closing(sqlite3.connect(root / "catalog.sqlite", isolation_level=None)) as connection:
        connection.execute(statement)
    before = content(root)
    with pytest.raises(CatalogDamaged, match="other tables"):
        opened(root)
    assert content(root) == before


@pytest.mark.parametrize("version", [-5, 0, -(2**31)])
def test_impossible_version_is_rejected(root: Path, version: int) -> None:
    sql(root, f"PRAGMA user_version = {version}")
    with pytest.raises(CatalogDamaged, match="version"):
        opened(root)


STATEMENTS = (
    *(
        f"UPDATE views SET {edit} WHERE id = 5"
        for edit in (
            "azimuth_deg = (azimuth_deg + 90) % 360",
            "image = (SELECT image FROM views WHERE id = 4)",
            "view_index = view_index + 5",
            "region = NULL",
            "enrollment_id = 4, view_index = 1",
        )
    ),
    *(
        f"UPDATE log SET {edit}"
        for edit in (
            "label = 'lab'",
            "deleted = 1 WHERE id = 1",
            "deleted = NULL WHERE action = 'deleted'",
            "status = NULL, enrollment_id = NULL WHERE id = 5",
            "object_id = NULL WHERE id = 5",
            "seal = (SELECT seal FROM log WHERE id = 2) WHERE id = 5",
            "digest = lower(hex(zeroblob(32))) WHERE id = 5",
            "id = 100 WHERE id = (SELECT max(id) FROM log)",
            "action = 'moved' WHERE result = 1",
            "record = json_set(record, '$.outcome', 'unknown') WHERE result = 1",
        )
    ),
    "UPDATE enrollments SET object_id = 5 WHERE id = 2",
    "UPDATE enrollments SET key = lower(hex(zeroblob(32))) WHERE id = 2",
    "UPDATE sessions SET conditions = '{}' WHERE enrollment_id = 2",
    "UPDATE properties SET value = '3 ' || (SELECT digest FROM log WHERE id = 3) || ' 1 2 0' WHERE key = 'head'",
    *(
        f"DELETE FROM {rows}"
        for rows in (
            "log WHERE id = 2",
            "log WHERE id = (SELECT max(id) FROM log)",
            "log",
            "views WHERE id = 5",
            "sessions WHERE enrollment_id = 4",
            "enrollments WHERE id = 2",
            "properties WHERE key = 'head'",
        )
    ),
    *(
        pytest.param(statement, marks=pytest.mark.nightly)
        for statement in (
            "UPDATE views SET encoder_deg = 1 WHERE id = 5",
            "UPDATE views SET commanded_deg = NULL WHERE id = 5",
            "UPDATE views SET imu_deg = 5, imu_sigma_deg = 1 WHERE id = 5",
            """UPDATE views SET evidence = '{"sharpness":1}' WHERE id = 5""",
            "UPDATE views SET captured_utc = '2031-01-01 00:00:00.000000' WHERE id = 5",
            "UPDATE views SET captured_ns = 7 WHERE id = 5",
            "UPDATE views SET image_bytes = image_bytes + 1 WHERE id = 5",
            "UPDATE views SET digest = lower(hex(zeroblob(32))) WHERE id = 5",
            "UPDATE log SET object_name = 'cup' WHERE id = 1",
            "UPDATE log SET note = 'none' WHERE id = 1",
            "UPDATE log SET deleted = 0 WHERE action = 'deleted'",
            "UPDATE log SET created_utc = '2031-01-01 00:00:00.000000' WHERE id = 1",
            "UPDATE log SET status = 'abandoned' WHERE id = 5",
            "UPDATE log SET status = NULL WHERE id = 5",
            "UPDATE log SET enrollment_id = 1 WHERE id = 5",
            "UPDATE log SET object_id = 5 WHERE id = 5",
            "UPDATE log SET finished_utc = NULL WHERE id = 5",
            "UPDATE log SET seal = NULL WHERE id = 5",
            "UPDATE log SET user = 'intruder' WHERE id = 3",
            "UPDATE log SET time_utc = '2031-01-01 00:00:00.000000' WHERE id = 1",
            "UPDATE log SET result = 2 WHERE result = 1",
            "UPDATE log SET details = '{}' WHERE result = 1",
            "UPDATE log SET record = NULL WHERE result = 1",
            "UPDATE enrollments SET started_utc = '2031-01-01 00:00:00.000000' WHERE id = 2",
            "UPDATE enrollments SET planned_azimuth_deg = '[0.0,90.0]' WHERE id = 2",
            "UPDATE enrollments SET digest = '' WHERE id = 2",
            "UPDATE sessions SET bench = 'x' WHERE enrollment_id = 2",
            "UPDATE sessions SET empty_table = NULL",
            "UPDATE sessions SET empty_table_bytes = 1",
            "UPDATE properties SET value = '9' WHERE key = 'head'",
            "DELETE FROM log WHERE id > 3",
            "DELETE FROM views WHERE id = 1",
            "DELETE FROM enrollments",
            "DELETE FROM views",
            "DELETE FROM log WHERE result = 1",
        )
    ),
)


SHOWN: dict[str, Callable[[Catalog], Any]] = {
    "list": lambda catalog: catalog.objects(),
    "show": lambda catalog: ascii(
        [
            (one.status, one.enrollment.sessions, one.enrollment.views, one.finished_utc)
            for one in catalog.object("mug").enrollments
        ]
    ),
    "identify": lambda catalog: (
        derived.views(catalog, BENCH_DESCRIPTOR).object_names,
        derived.views(catalog, BENCH_DESCRIPTOR).azimuth_deg.tolist(),
        derived.empty_tables(catalog).newest,
    ),
    "export": lambda catalog: ascii(
        [
            (
                one.name,
                one.label,
                one.note,
                (one.enrollment.planned_azimuth_deg, one.enrollment.views),
            )
            for one in CatalogSource(catalog).items()
        ]
    ),
    "results": lambda catalog: find_results(catalog),
}
"""What commands show."""


@pytest.fixture(scope="module")
def shown(sample: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Return what commands show of the catalog before it is edited."""
    with opened(Path(shutil.copytree(sample, tmp_path_factory.mktemp("shown") / "catalog"))) as catalog:
        return {reader: show(catalog) for reader, show in SHOWN.items()}


def edited(root: Path, statement: str) -> None:
    sql(root, "PRAGMA foreign_keys = OFF", "PRAGMA ignore_check_constraints = ON", statement)


@pytest.mark.parametrize("statement", STATEMENTS)
def test_edited_rows_are_found_and_never_shown(root: Path, shown: dict[str, Any], statement: str) -> None:
    """Each command shows what was stored, or that the catalog is damaged."""
    edited(root, statement)
    with suppress(CatalogDamaged), opened(root) as catalog:
        assert finished(verify(catalog, jobs=1)).findings
    accepted = []
    for reader, show in SHOWN.items():
        try:
            with opened(root) as catalog:
                if show(catalog) != shown[reader]:
                    accepted.append(reader)
        except CatalogDamaged as error:
            if not error.next_step:
                accepted.append(f"{reader}: no next step")
    assert accepted == []


def test_an_edited_state_is_not_written_again(root: Path) -> None:
    sql(root, "UPDATE log SET label = 'lab' WHERE id = 1")
    for change in (
        lambda catalog: catalog.rename("mug", "cup"),
        lambda catalog: catalog.set_texts("mug", note="new"),
        lambda catalog: catalog.delete("mug"),
        lambda catalog: fill(catalog, "mug", 1, replace=True, note="new"),
    ):
        with opened(root) as catalog, pytest.raises(CatalogDamaged, match="'mug'") as error:
            change(catalog)
        assert Do.VERIFY_CATALOG() in error.value.steps


@pytest.mark.parametrize("words", [("list",), ("list", "--label", ""), ("list", "--deleted")])
def test_listing_reports_a_flipped_byte_of_a_view_and_is_printed(
    rig: Callable[..., Result], root: Path, words: tuple[str, ...]
) -> None:
    intact = rig("catalog", *words)
    assert intact.exit_code == 0, intact.output
    with closing(sqlite3.connect(root / "catalog.sqlite")) as connection:
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    stored, name = (root / "catalog.sqlite").read_bytes(), name_of(images.encode(image(10))).encode()
    (root / "catalog.sqlite").write_bytes(stored.replace(name, name[:-1] + bytes([name[-1] ^ 1])))
    done = rig("catalog", *words)
    assert done.exit_code == 7
    assert done.stdout == intact.stdout
    assert "Error 707 (catalog damaged): 'mug' in the catalog changed" in done.stderr
    listed, error = map(json.loads, rig("catalog", *words, "--json").stdout.splitlines())
    assert listed
    assert error["code"] == 707


def test_damage_stays_noticed_after_later_changes(root: Path) -> None:
    sql(root, "UPDATE views SET imu_deg = 77 WHERE enrollment_id = 1 AND view_index = 0")
    with opened(root) as catalog:
        fill(catalog, "new", 1, 50)
        catalog.rename("mug", "cup")
        catalog.note(Action.MOVED)
        assert [one.object_name for one in finished(verify(catalog, jobs=1)).findings] == ["cup"]


def reported(root: Path) -> Any:
    """Return all answers and lists of a catalog."""
    with opened(root) as catalog:
        names = [item.name for item in catalog.objects()]
        details = [catalog.object(name) for name in names]
        loaded = derived.views(catalog)
        return (
            catalog.objects(deleted=True),
            ascii(
                [
                    (item.summary, [(e.enrollment, e.enrollment.sessions, e.status, e.seal) for e in item.enrollments])
                    for item in details
                ]
            ),
            ascii([item.views for item in details]),
            (loaded.descriptors.tolist(), loaded.azimuth_deg.tolist(), loaded.object_names, catalog.version()),
            ascii(catalog.log()),
            ascii([(item.name, item.label, item.enrollment.key) for item in CatalogSource(catalog).items()]),
            find_results(catalog),
        )


def flip(root: Path, intact: Path, expected: Any, seed: int) -> bool:
    """Flip a byte of the database. Return whether that is noticed; if not, everything reads as before."""
    found = random.Random(seed)
    spoiled = bytearray((intact / "catalog.sqlite").read_bytes())
    used = [at for at, byte in enumerate(spoiled) if byte]  # half of the flips avoid free space
    at = found.choice(used) if seed % 2 else found.randrange(len(spoiled))
    spoiled[at] ^= found.randint(1, 255)
    for path in root.glob("catalog.sqlite*"):
        path.unlink()
    (root / "catalog.sqlite").write_bytes(spoiled)
    try:
        with opened(root) as catalog:
            if finished(verify(catalog, jobs=1)).findings:
                return True
    except RigError:
        return True
    assert reported(root) == expected, f"seed {seed}"
    return False


@pytest.mark.parametrize("count", [12, pytest.param(1000, marks=[pytest.mark.nightly, pytest.mark.timeout(1200)])])
def test_flipped_bytes_are_found_or_change_nothing(root: Path, sample: Path, count: int) -> None:
    expected = reported(sample)
    noticed = sum(flip(root, sample, expected, seed) for seed in range(count))
    print(f"{noticed} of {count} flipped bytes were noticed; all others change nothing that is read")
    assert noticed > count / 5


VALUES = (
    "views SET azimuth_deg = 'north'",
    "views SET evidence = '{'",
    "views SET session = 7",
    "log SET status = 'lost'",
    "log SET record = '{}' WHERE result = 1",
    "enrollments SET planned_azimuth_deg = '[null]'",
    """sessions SET conditions = '{"a":NaN}'""",
    "properties SET value = '²  0 0 0' WHERE key = 'head'",
    *(
        pytest.param(edit, marks=pytest.mark.nightly)
        for edit in (
            "views SET azimuth_deg = 9e999",
            "views SET captured_utc = 'yesterday'",
            "views SET digest = NULL",
            "log SET object_name = NULL WHERE id = 1",
            "log SET details = '[]'",
            "sessions SET devices = '7'",
            "derived SET content = x''",
            "properties SET value = '99999999999999999999  0 0 0' WHERE key = 'head'",
            "views SET azimuth_deg = 360.5",
            "views SET azimuth_deg = NULL",
            "views SET evidence = NULL",
            "views SET view_index = 700 WHERE id IN (1, 4)",
            "views SET image = x'00ff'",
            "enrollments SET planned_azimuth_deg = NULL",
            "sessions SET number = 5",
            "derived SET content = 'text'",
            "enrollments SET object_id = 77",
            "log SET result = 9223372036854775807 WHERE result = 1",
            "views SET evidence = '[1]'",
            "views SET evidence = '{\"locks\":5}'",
            "views SET region = '[0,0,5,5]'",
            "views SET region = '[90000,0,5,5]'",
            "views SET region = '\"evil\"'",
            "views SET captured_utc = 5",
            "views SET captured_utc = '9999-99-99 00:00:00.000000'",
            "views SET captured_utc = '0001-01-01 00:00:00.000000'",
            "views SET captured_ns = 9223372036854775807",
            "views SET image_bytes = 'many'",
            "views SET image_bytes = -1",
            "views SET imu_deg = 1, imu_sigma_deg = NULL",
            "views SET imu_deg = 1, imu_sigma_deg = -1",
            "views SET enrollment_id = 'x' WHERE id = 5",
            "enrollments SET started_utc = ''",
            "enrollments SET key = NULL",
            "enrollments SET key = 5 WHERE id = 2",
            "log SET label = x'ff', note = CAST(x'ff' AS TEXT)",
            "log SET object_id = 'x'",
            "log SET time_utc = NULL",
            "log SET finished_utc = NULL",
            "log SET deleted = 7",
            "sessions SET bench = 5.5",
            "sessions SET bench = NULL",
            "sessions SET empty_table_bytes = -1",
            "sessions SET empty_table = 'x'",
            "derived SET made_by = NULL",
            "derived SET content = NULL",
            "derived SET sha256 = NULL",
            f"derived SET made_by = 'cedd {'9' * 5000}' WHERE what = 'cedd'",
            "derived SET seal = 5 WHERE what = 'segmentation' AND rowid = 1",
        )
    ),
)


@pytest.fixture
def without_constraints(root: Path) -> Path:
    """Return the catalog with tables that allow NULL; the schema says that they do not."""
    with closing(sqlite3.connect(root / "catalog.sqlite", isolation_level=None)) as connection:
        connection.execute("PRAGMA writable_schema = ON")
        connection.execute("UPDATE sqlite_master SET sql = replace(sql, ' NOT NULL', '') WHERE type = 'table'")
        connection.execute("PRAGMA writable_schema = RESET")
    return root


@pytest.mark.parametrize(
    "sealed", [pytest.param(False, marks=pytest.mark.nightly, id="edited"), pytest.param(True, id="sealed")]
)
@pytest.mark.parametrize("edit", VALUES)
def test_invalid_values_end_in_an_error(
    without_constraints: Path, sample: Path, tmp_path: Path, edit: str, sealed: bool
) -> None:
    """Values that no program stored end in an error, even if a sender gave them the right digests."""
    root, strange = without_constraints, ("properties", "derived", "log SET result", "log SET record")
    edited(root, f"UPDATE {edit}")
    if sealed and not edit.startswith("properties"):
        seal_as_the_sender(root)
    restore_schema(root, sample)
    if not edit.startswith(strange) and not sealed:
        with pytest.raises(RigError):
            reported(root)
    for number, reader in enumerate(READERS.values()):
        copied = Path(shutil.copytree(root, tmp_path / f"copy {number}"))
        target = tmp_path / f"target {number}"
        target.mkdir()
        try:
            with opened(copied) as catalog:
                reader(catalog, target)
        except RigError:
            continue


def restore_schema(root: Path, sample: Path) -> None:
    """Let the schema say again what this program makes."""
    with closing(sqlite3.connect(sample / "catalog.sqlite")) as connection:
        expected = connection.execute("SELECT name, sql FROM sqlite_master WHERE type = 'table'").fetchall()
    with closing(sqlite3.connect(root / "catalog.sqlite", isolation_level=None)) as connection:
        connection.execute("PRAGMA writable_schema = ON")
        for name, definition in expected:
            connection.execute("UPDATE sqlite_master SET sql = ? WHERE name = ?", (definition, name))
        connection.execute("PRAGMA writable_schema = RESET")


def test_swapped_truncated_and_foreign_images_are_found(root: Path) -> None:
    with opened(root) as catalog:
        first, second = (catalog.image_path(catalog.view(number).image) for number in (4, 5))
        whole = first.read_bytes(), second.read_bytes()
        for spoilt in ((whole[1], whole[0]), (whole[0][:-1], whole[1]), (images.encode(image(77)), whole[1])):
            first.write_bytes(spoilt[0])
            second.write_bytes(spoilt[1])
            found = finished(verify(catalog, jobs=1)).findings
            wrong = sum(one != other for one, other in zip(spoilt, whole, strict=True))
            assert [(one.problem, one.object_name) for one in found] == [(CatalogProblem.CHANGED_IMAGE, "mug")] * wrong
            with pytest.raises(RigError, match="not the one that was stored"):
                catalog.read_image(catalog.view(4).image)


@pytest.mark.parametrize("count", [20, pytest.param(1000, marks=[pytest.mark.nightly, pytest.mark.timeout(1200)])])
def test_a_flipped_byte_of_an_image_is_found(root: Path, count: int) -> None:
    found = random.Random(3)
    with opened(root) as catalog:
        names = [view.image for view in catalog.object("mug").views]
        for _ in range(count):
            name = found.choice(names)
            path = catalog.image_path(name)
            whole = path.read_bytes()
            at = found.randrange(len(whole))
            path.write_bytes(whole[:at] + bytes([whole[at] ^ found.randint(1, 255)]) + whole[at + 1 :])
            with pytest.raises(RigError, match="not the one that was stored"):
                catalog.read_image(name)
            path.write_bytes(whole)
        assert finished(verify(catalog, jobs=1)).findings == ()
