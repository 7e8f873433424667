"""A catalog from an untrusted sender cannot reach outside its folder, and every change of its database is noticed."""

import os
import random
import shlex
import shutil
import sqlite3
import stat
import struct
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import Result

from rig.catalog import Action, Catalog
from rig.catalog.edit import delete
from rig.catalog.exchange import import_objects, plan_import, read_bundle, read_catalog, read_objects, write_bundle
from rig.catalog.redescribe import redescribe
from rig.catalog.results import correct
from rig.catalog.results import record as record_result
from rig.catalog.seal import seal_enrollments, seal_objects
from rig.catalog.upkeep import collect_garbage, statistics
from rig.catalog.verify import verify
from rig.core.errors import CatalogDamaged, ImportRejected, RigError
from rig.core.files import write
from rig.core.next_steps import Do
from rig.views import image_files as images
from sim.clock import VirtualClock
from tests.rig.catalog.catalog_samples import (
    PROVENANCE,
    described,
    finished,
    image,
    new_result,
    plan,
    true_fill,
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
        true_fill(catalog, "mug", 3, 0, label="kitchen", note="a chip")
        true_fill(catalog, "mug", 2, 10, (2, 0, 12, 12), replace=True)
        true_fill(catalog, "gone", 1, 90)
        delete(catalog, "gone")
        tin = catalog.begin("tin", planned_azimuth_deg=plan(3), provenance=PROVENANCE)
        tin.store_empty_table(image(99))
        tin.add(described(0, 30, imu_deg=0.1, imu_sigma_deg=0.5, evidence={"sharpness": 12.5}), image(30))
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


def sql(root: Path, *statements: str) -> None:
    with closing(sqlite3.connect(root / "catalog.sqlite", isolation_level=None)) as connection:
        for statement in statements:
            connection.execute(statement)


def content(root: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(root)): path.read_bytes()
        for path in sorted(root.rglob("*"))
        if path.is_file() and not path.name.endswith(("-shm", "-wal"))
    }


def opened(root: Path) -> Catalog:
    return Catalog.open(root, clock=VirtualClock(), create=False)


def seal_as_the_sender(root: Path) -> None:
    """Compute the digests again, as an attacker would do."""
    with opened(root) as catalog, catalog.database.write() as connection:
        seal_enrollments(connection, None)
        seal_objects(connection, None)


READERS: dict[str, Callable[[Catalog, Path], Any]] = {
    "gc": lambda catalog, _: collect_garbage(catalog, old=True),
    "verify": lambda catalog, _: finished(verify(catalog, jobs=1)),
    "repair": lambda catalog, _: finished(verify(catalog, repair=True, jobs=1)),
    "merge": lambda catalog, _: read_catalog(catalog),
    "export": lambda catalog, tmp_path: write_bundle(tmp_path / "folder", read_objects(catalog)),
    "show": lambda catalog, _: [catalog.read_image(view) for view in catalog.object("mug").views],
}


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("kind", ["absolute", "parent", "inner parent", "elsewhere", "link", "folder link"])
def test_image_paths_that_lead_out_are_rejected(root: Path, outside: Path, kind: str, reader: str) -> None:
    """Views 1 to 3 belong to the superseded enrollment, 4 and 5 to the complete one."""
    if kind.endswith("link"):
        (path,) = root.glob(f"images/*mug/{1 if reader == 'gc' else 2:06d}")
        target = path / "000.png" if kind == "link" else path
        shutil.move(target, root.parent / "other")
        target.symlink_to(outside if kind == "link" else root.parent / "other")
    else:
        path = {
            "absolute": str(outside),
            "parent": "../secret.png",
            "inner parent": "images/../../secret.png",
            "elsewhere": "catalog.sqlite",
        }[kind]
        sql(root, f"UPDATE views SET image = '{path}', image_sha256 = '{images.digest(SECRET)}' WHERE id IN (1, 4)")
        seal_as_the_sender(root)
    before = content(root)
    with pytest.raises(CatalogDamaged) as error, opened(root) as catalog:
        READERS[reader](catalog, root.parent)
    assert "exported bundle" in error.value.next_step
    assert content(root) == before


@pytest.mark.parametrize("name", ["images", "lost+found", "incoming", "catalog.sqlite", "catalog.sqlite-wal"])
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


def rollback_journal(database: Path, *, names: Path | None) -> bytes:
    """Return a journal that SQLite plays back. It changes no page, and ``names`` a file that SQLite then deletes."""
    magic = bytes.fromhex("d9d505f920a163d7")
    content = database.read_bytes()
    page_size = int.from_bytes(content[16:18], "big")
    page = content[:page_size]
    checksum = sum(page[at] for at in range(page_size - 200, 0, -200))
    header = magic + struct.pack(">5I", 1, 0, len(content) // page_size, 512, page_size)
    made = header.ljust(512, b"\0") + struct.pack(">I", 1) + page + struct.pack(">I", checksum)
    if names is None:
        return made
    name = os.fsencode(names)
    return made + struct.pack(">I", 2**30 // page_size + 1) + name + struct.pack(">2I", len(name), sum(name)) + magic


COMMANDS = (
    *("catalog gc --yes", "catalog verify --repair --jobs 1", "catalog delete mug --yes", "catalog rename mug cup"),
    *("catalog redescribe --again --jobs 1", "catalog label mug lab", "import photographs --jobs 1"),
    *("enroll cup --views 4", "catalog merge other --jobs 1", "export a.zip", "catalog list", "identify"),
)


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
    assert "SQLite would delete the file" in result.stderr
    assert "exported bundle" in result.stderr
    assert precious.read_bytes() == SECRET
    assert content(root) == before


def test_empty_database_with_a_journal_is_not_used(root: Path, outside: Path) -> None:
    (root / "catalog.sqlite-journal").write_bytes(rollback_journal(root / "catalog.sqlite", names=outside))
    (root / "catalog.sqlite").write_bytes(b"")
    with pytest.raises(CatalogDamaged, match="journal of another program"):
        Catalog.open(root, clock=VirtualClock())


@pytest.mark.parametrize("mode", ["wal", "delete"])
def test_journal_of_another_program_is_not_played_back_unasked(root: Path, tmp_path: Path, mode: str) -> None:
    """The other program was killed while it changed the catalog; the next step finishes its change."""
    expected = reported(root)
    sql(root, "PRAGMA journal_mode = delete")
    with closing(sqlite3.connect(root / "catalog.sqlite", isolation_level=None)) as connection:
        for statement in (
            "PRAGMA cache_size = 1",
            "BEGIN",
            "UPDATE views SET azimuth_deg = 1",
            "DELETE FROM descriptors",
        ):
            connection.execute(statement)
        killed = Path(shutil.copytree(root, tmp_path / "folder"))
    if mode == "wal":
        sql(root, "PRAGMA journal_mode = wal")
        (root / "catalog.sqlite-journal").write_bytes(rollback_journal(root / "catalog.sqlite", names=None))
        killed = root
    before = content(killed)
    for read_only in (True, False):
        with pytest.raises(CatalogDamaged, match="another program") as error:
            Catalog.open(killed, clock=VirtualClock(), read_only=read_only)
    assert content(killed) == before
    program, file, statement = shlex.split(error.value.next_step.partition("finish its change: ")[2])
    assert program == "sqlite3"
    with closing(sqlite3.connect(file)) as connection:
        connection.execute(statement).fetchall()
    assert reported(killed) == expected


def test_catalog_that_is_opened_for_writing_has_a_write_ahead_log(root: Path) -> None:
    sql(root, "PRAGMA journal_mode = delete")
    with Catalog.open(root, clock=VirtualClock(), read_only=True) as catalog:
        (finding,) = finished(verify(catalog, jobs=1)).findings
        assert finding.details == {"setting": "journal", "found": "delete", "stored": "wal"}
    with opened(root) as catalog:
        assert finished(verify(catalog, jobs=1)).findings == ()
    assert (root / "catalog.sqlite").read_bytes()[18:20] == b"\2\2"


def test_completion_reads_no_catalog_with_a_journal(root: Path, rig: Callable[..., Result]) -> None:
    def completed() -> str:
        return rig(
            env={"_RIG_COMPLETE": "complete_bash", "COMP_WORDS": "rig catalog show m", "COMP_CWORD": "3"}
        ).stdout.strip()

    assert completed() == "mug"
    os.mkfifo(root / "catalog.sqlite-journal")
    assert completed() == ""


@pytest.mark.parametrize("name", ["incoming/link", "lost+found/link"])
def test_garbage_behind_links_is_not_collected(root: Path, tmp_path: Path, outside: Path, name: str) -> None:
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "precious.png").write_bytes(SECRET)
    (root / name).parent.mkdir()
    (root / name).symlink_to(tmp_path / "other")
    os.mkfifo((root / name).with_name("pipe"))
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
            true_fill(catalog, "mug", 1, 0)
            write_bundle(tmp_path / "a.zip", read_objects(catalog))
        with Catalog.open(tmp_path / "new", clock=VirtualClock()) as new:
            finished(import_objects(new, plan_import(new, read_bundle(tmp_path / "a.zip")), jobs=1))
    finally:
        os.umask(before)
    for top in (tmp_path / "deep" / "catalog", tmp_path / "new"):
        for path in (top, *top.rglob("*")):
            assert stat.S_IMODE(path.stat().st_mode) == (0o700 if path.is_dir() else 0o600), path


@pytest.mark.parametrize(
    "statement",
    [
        "CREATE TRIGGER evil AFTER UPDATE ON objects BEGIN DELETE FROM descriptors; END",
        "CREATE TRIGGER evil AFTER INSERT ON audit BEGIN DELETE FROM descriptors; END",
        "CREATE VIEW evil AS SELECT * FROM views",
        "CREATE TABLE evil (x)",
        "CREATE INDEX evil ON views (image)",
        "DROP TRIGGER audit_no_update",
        "ALTER TABLE views ADD COLUMN evil TEXT",
    ],
)
def test_foreign_schema_is_rejected(root: Path, statement: str) -> None:
    sql(root, statement)
    before = content(root)
    with pytest.raises(CatalogDamaged, match="other tables"):
        opened(root)
    assert content(root) == before


@pytest.mark.parametrize("version", [-5, 0, -(2**31)])
def test_impossible_version_is_rejected(root: Path, version: int) -> None:
    sql(root, f"PRAGMA user_version = {version}")
    with pytest.raises(CatalogDamaged, match="version"):
        opened(root)


EDITS = (
    *(
        "azimuth_deg = (azimuth_deg + 90) % 360",
        "encoder_deg = 1",
        "commanded_deg = NULL",
        "imu_deg = 5",
        "image = 'images/x'",
    ),
    *("""evidence = '{"sharpness": 1}'""", "captured_utc = '2031-01-01 00:00:00.000000'", "captured_ns = 7"),
    *("image_sha256 = lower(hex(zeroblob(32)))", "image_bytes = image_bytes + 1", "view_index = view_index + 5"),
)


@pytest.mark.parametrize(
    "edit",
    [
        *(f"UPDATE views SET {edit} WHERE id = 5" for edit in EDITS),
        "UPDATE descriptors SET packed = zeroblob(54) WHERE view_id = 4",
        """UPDATE descriptors SET settings = '{"region": [0, 0, 5, 5]}' WHERE view_id = 4""",
        "DELETE FROM descriptors WHERE view_id = 4",
        "UPDATE objects SET name = 'cup' WHERE id = 1",
        "UPDATE objects SET label = 'lab', note = ''",
        "UPDATE objects SET deleted_utc = '2031-01-01 00:00:00.000000' WHERE id = 1",
        "UPDATE objects SET created_utc = '2031-01-01 00:00:00.000000' WHERE id = 1",
        "UPDATE enrollments SET status = 'abandoned' WHERE id = 2",
        "UPDATE enrollments SET planned_azimuth_deg = '[0, 90]' WHERE id = 2",
        "UPDATE enrollments SET finished_utc = NULL WHERE id = 2",
        "UPDATE sessions SET bench = 'x' WHERE id = 2",
        "UPDATE sessions SET conditions = '{}' WHERE id = 2",
        "UPDATE enrollments SET digest = NULL WHERE id = 2",
        "UPDATE sqlite_sequence SET seq = 1",
    ],
)
def test_edited_columns_are_found(root: Path, edit: str) -> None:
    sql(root, edit)
    with opened(root) as catalog:
        assert finished(verify(catalog, quick=True, jobs=1)).findings


def test_edited_azimuth_gives_no_answer(root: Path) -> None:
    sql(root, "UPDATE views SET azimuth_deg = 90 WHERE id = 4")
    with opened(root) as catalog, pytest.raises(CatalogDamaged, match="'mug'") as error:
        catalog.views()
    assert Do.VERIFY_CATALOG() in error.value.steps


def test_damage_stays_noticed_after_later_changes(root: Path) -> None:
    sql(root, "UPDATE views SET imu_deg = 77 WHERE enrollment_id = 4 AND view_index = 0")
    with opened(root) as catalog:
        tin = catalog.resume("tin", provenance=PROVENANCE)
        tin.add(described(1, 31), image(31))
        finished(redescribe(catalog, again=True, jobs=1))
        assert [one.object_name for one in finished(verify(catalog, jobs=1)).findings] == ["tin"]


@pytest.mark.parametrize(
    "statement",
    [
        "DELETE FROM audit WHERE id = 2",
        "DELETE FROM audit WHERE id = (SELECT max(id) FROM audit)",
        "UPDATE audit SET user = 'intruder' WHERE id = 3",
        "UPDATE audit SET time_utc = '2031-01-01 00:00:00.000000' WHERE id = 1",
        "UPDATE audit SET digest = lower(hex(zeroblob(32))) WHERE id = 4",
        "UPDATE results SET outcome = 'unknown' WHERE id = 1",
        "UPDATE results SET sample = 'S-2', operator = 'intruder'",
        "UPDATE results SET image = NULL, image_sha256 = NULL, image_bytes = NULL",
        "UPDATE results SET answer = '{}', catalog_version = ''",
        "DELETE FROM results",
        "UPDATE corrections SET reason = 'another'",
        "DELETE FROM corrections",
    ],
)
def test_edited_log_or_result_is_found(root: Path, statement: str) -> None:
    with opened(root) as catalog:
        record_result(catalog, new_result(sample="S-1"), image(1))
        correct(catalog, 1, unknown=True, reason="read the label")
    table = statement.split()[2 if statement.startswith("DELETE") else 1]
    problem = "log changed" if table == "audit" else "result changed"
    triggers = [f"{table}_no_{change}" for change in ("update", "delete")]
    with closing(sqlite3.connect(root / "catalog.sqlite", isolation_level=None)) as connection:
        sources = [
            connection.execute("SELECT sql FROM sqlite_master WHERE name = ?", (one,)).fetchone() for one in triggers
        ]
        for trigger in triggers:
            connection.execute(f"DROP TRIGGER {trigger}")
        connection.execute(statement)
        for (source,) in sources:
            connection.execute(source)
    with opened(root) as catalog:
        problems = {one.problem for one in finished(verify(catalog, quick=True, jobs=1)).findings}
        assert problems - {"orphaned file"} == {problem}  # the image of a result that is gone
        catalog.note(Action.MOVED)
        assert finished(verify(catalog, quick=True, jobs=1)).findings


def reported(root: Path) -> Any:
    """Return all answers and lists of a catalog."""
    with opened(root) as catalog:
        names = [item.name for item in catalog.objects()]
        details = [catalog.object(name) for name in names]
        loaded = catalog.views()
        return (
            [(item.summary, item.enrollments) for item in details],
            [(view.id, ascii(view.session), view.image, view.image_sha256) for item in details for view in item.views],
            [
                (view.record.azimuth_deg, view.record.evidence, view.record.region, view.record.encoder_deg)
                for item in details
                for view in item.views
            ],
            (loaded.views.descriptors.tolist(), loaded.views.azimuth_deg.tolist(), loaded.view_ids.tolist()),
            catalog.log(),
            statistics(catalog).enrollments,
            [item for item, _ in read_objects(catalog)],
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
            if finished(verify(catalog, quick=True, jobs=1)).findings:
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


def test_half_a_jpeg_is_rejected() -> None:
    pixels = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 256, (120, 160, 3), np.uint8), (0, 0), 3)
    for settings in ([], [cv2.IMWRITE_JPEG_PROGRESSIVE, 1], [cv2.IMWRITE_JPEG_RST_INTERVAL, 4]):
        whole = cv2.imencode(".jpg", pixels, settings)[1].tobytes()
        assert images.decode(whole).shape == pixels.shape
        for share in (0.5, 0.7, 0.9, 0.99):
            with pytest.raises(images.BadImage, match="truncated"):
                images.decode(whole[: int(share * len(whole))] + b"\xff\xd9")
    for picture in (pixels, pixels[..., 0]):
        whole = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
        scans = whole.split(b"\xff\xda")  # tables for the next scan may follow the data of one
        assert len(scans) > 6
        for count in range(2, len(scans)):
            with pytest.raises(images.BadImage, match="truncated"):
                images.decode(b"\xff\xda".join(scans[:count]) + b"\xff\xd9")


def test_wrong_descriptors_of_another_catalog_are_rejected(root: Path, tmp_path: Path) -> None:
    sql(root, "UPDATE descriptors SET packed = zeroblob(54)")
    seal_as_the_sender(root)
    with opened(root) as catalog, Catalog.open(tmp_path / "new", clock=VirtualClock()) as new:
        with pytest.raises(ImportRejected) as error:
            finished(import_objects(new, plan_import(new, read_catalog(catalog)), jobs=1))
        assert "is not that of the image" in str(error.value.evidence)
        assert new.objects() == []


@pytest.mark.parametrize(
    "statement",
    [
        "UPDATE views SET azimuth_deg = 'north'",
        "UPDATE views SET evidence = '{'",
        "UPDATE views SET captured_utc = 'yesterday'",
        "UPDATE views SET image = x'00ff'",
        "UPDATE enrollments SET status = 'lost'",
        "UPDATE enrollments SET planned_azimuth_deg = '[null]'",
        "UPDATE sessions SET devices = '7'",
        "UPDATE descriptors SET packed = 'text'",
        *(
            pytest.param(statement, marks=pytest.mark.nightly)
            for statement in (
                "UPDATE views SET evidence = '[1]'",
                "UPDATE views SET segmentation = '{\"issues\": 5}'",
                "UPDATE views SET captured_utc = 5",
                "UPDATE views SET captured_utc = '9999-99-99 00:00:00.000000'",
                "UPDATE views SET image_bytes = 'many'",
                "UPDATE views SET imu_deg = 1, imu_sigma_deg = NULL",
                "UPDATE views SET session_id = 99",
                "UPDATE enrollments SET started_utc = ''",
                "UPDATE objects SET label = x'ff', note = CAST(x'ff' AS TEXT)",
                "UPDATE sessions SET bench = 5.5",
                "UPDATE descriptors SET packed = x''",
                'UPDATE descriptors SET settings = \'{"region": "evil"}\'',
            )
        ),
    ],
)
def test_invalid_values_end_in_an_error(root: Path, tmp_path: Path, statement: str) -> None:
    sql(root, "PRAGMA ignore_check_constraints = ON", statement)
    with pytest.raises(RigError):
        reported(root)
    for reader in READERS.values():
        try:
            with opened(root) as catalog:
                reader(catalog, tmp_path)
        except RigError:
            continue


@pytest.mark.parametrize(
    "edit",
    [
        "sessions SET empty_table_image_sha256 = '0'",
        "sessions SET empty_table_image_bytes = -1",
        "enrollments SET finished_utc = NULL",
        "views SET image_sha256 = '0'",
        "views SET session_id = (SELECT max(id) FROM sessions)",
    ],
)
def test_values_that_an_import_rejects_are_not_exported(root: Path, edit: str) -> None:
    sql(root, "PRAGMA ignore_check_constraints = ON", f"UPDATE {edit}")
    seal_as_the_sender(root)
    with opened(root) as catalog, pytest.raises(CatalogDamaged, match="impossible values"):
        list(read_objects(catalog))


def test_images_without_their_size_are_reported(root: Path) -> None:
    with opened(root) as catalog:
        record_result(catalog, new_result(), image(1))
    triggers = ("results_no_update", "results_no_delete")
    with closing(sqlite3.connect(root / "catalog.sqlite", isolation_level=None)) as connection:
        sources = [
            connection.execute("SELECT sql FROM sqlite_master WHERE name = ?", (one,)).fetchone()[0] for one in triggers
        ]
        for statement in (
            *(f"DROP TRIGGER {one}" for one in triggers),
            "UPDATE results SET image_bytes = NULL",
            "UPDATE sessions SET empty_table_image_bytes = NULL",
            *sources,
        ):
            connection.execute(statement)
    with opened(root) as catalog:
        problems = {one.problem for one in finished(verify(catalog, jobs=1)).findings}
    assert problems == {"result changed", "enrollment changed"}
