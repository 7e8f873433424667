"""Damage of rows that a command does not load is found in the background; listings compare the rows that they list."""

import json
import re
import shutil
import sqlite3
from contextlib import closing
from itertools import count
from pathlib import Path

import pytest

from rig.catalog import Action, Catalog, derived, log, verify
from rig.catalog.images import name_of
from rig.catalog.verify import BackgroundCheck
from rig.core.clock import SystemClock
from rig.core.errors import CatalogDamaged, RigError
from rig.views.image_files import encode
from sim.clock import VirtualClock
from tests.rig.catalog.catalog_samples import PROVENANCE, fill, image, plan, record, sql, without_waiting

pytestmark = pytest.mark.sqlite


@pytest.fixture(scope="module")
def sample(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a catalog with a complete, a superseded, an unfinished and a deleted enrollment, and 120 log entries."""
    folder = tmp_path_factory.mktemp("sample") / "catalog"
    with pytest.MonkeyPatch.context() as patch, Catalog.open(folder, clock=VirtualClock()) as catalog:
        without_waiting(patch)
        fill(catalog, "mug", 2, 0, note="a mug with a chip")
        fill(catalog, "mug", 1, 10, replace=True)
        fill(catalog, "gone", 1, 90, note="a vase with a crack")
        catalog.delete("gone")
        catalog.begin("tin", planned_azimuth_deg=plan(3), provenance=PROVENANCE).add(record(0), image(30))
        with catalog.database.write() as transaction:
            for number in range(120):
                log.append(transaction, catalog.clock, Action.MOVED, details={"angle_deg": float(number)})
    return folder


@pytest.fixture
def root(sample: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(sample, tmp_path / "catalog"))


def flip(root: Path, text: bytes) -> None:
    """Flip the lowest bit of the last byte of a text in the database, wherever it is."""
    with closing(sqlite3.connect(root / "catalog.sqlite")) as connection:
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    content = bytearray((root / "catalog.sqlite").read_bytes())
    for found in re.finditer(re.escape(text), content):
        content[found.end() - 1] ^= 1
    (root / "catalog.sqlite").write_bytes(content)


@pytest.fixture
def enough_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the check of a command compare everything, however slow the computer is."""
    monkeypatch.setattr(verify, "BURST_S", 600.0)


def found(root: Path) -> list[RigError]:
    reported: list[RigError] = []
    with BackgroundCheck(root, SystemClock(), reported.append) as check:
        check.wait()
    return reported


@pytest.mark.parametrize(
    ("statement", "named"),
    [
        ("UPDATE views SET azimuth_deg = 90 WHERE enrollment_id = 1 AND view_index = 1", "'mug'"),
        ("UPDATE views SET imu_deg = 3 WHERE enrollment_id = 4", "'tin'"),
        ("DELETE FROM views WHERE enrollment_id = 3", "'gone'"),
        ("UPDATE log SET user = 'intruder' WHERE action = 'enrolled' AND enrollment_id = 1", "Entry 2 of the log"),
        ("UPDATE log SET user = 'intruder' WHERE id = 115", "Entry 115 of the log"),
        ("DELETE FROM log WHERE id = 115", "Entry 115 of the log"),
    ],
)
def test_damage_that_no_search_loads_is_found(root: Path, statement: str, named: str) -> None:
    assert found(root) == []
    sql(root, statement)
    with Catalog.open(root, clock=VirtualClock(), read_only=True) as catalog:
        assert len(derived.views(catalog)) == 1  # a search does not notice it
    (damage,) = found(root)
    assert isinstance(damage, CatalogDamaged)
    assert named in damage.what


def test_check_uses_a_small_share_of_time_and_ends_with_the_work(root: Path) -> None:
    sql(root, "UPDATE log SET user = 'intruder' WHERE id = 115")
    seconds = count()

    class SlowComputer(SystemClock):
        """Each portion takes a second."""

        def now_ns(self) -> int:
            return next(seconds) * 1_000_000_000

    reported: list[RigError] = []
    with BackgroundCheck(root, SlowComputer(), reported.append) as check:
        check.wait(0.3)
    check.wait()
    assert reported == []  # it waited nearly all of the time
    assert next(seconds) < 5


def test_check_reports_no_change_by_the_program(root: Path) -> None:
    reported: list[RigError] = []
    with Catalog.open(root, clock=VirtualClock()) as catalog, pytest.MonkeyPatch.context() as patch:
        without_waiting(patch)
        for number in range(3):
            with BackgroundCheck(root, SystemClock(), reported.append) as check:
                fill(catalog, f"new-{number}", 3, number)
                check.wait()
    assert reported == []


@pytest.mark.usefixtures("enough_time")
def test_enrollment_reports_a_flipped_byte_of_another_object(rig, root: Path) -> None:
    flip(root, name_of(encode(image(90))).encode())
    done = rig("enroll", "lamp", "--views", "4", "--yes")
    assert done.exit_code == 0, done.output
    assert "'gone' in the catalog changed after they were stored" in done.stderr
    assert "rig catalog verify" in done.stderr
    assert "'gone'" not in rig("catalog", "show", "lamp").stderr


@pytest.mark.usefixtures("enough_time")
def test_watch_reports_a_flipped_byte_of_an_object_that_it_does_not_load(rig, root: Path) -> None:
    flip(root, name_of(encode(image(90))).encode())
    words = ["identify", "--watch", "--scan", "--strategy", "sweep", "--set", "identify.max_views=2"]
    done = rig(*words, "--set", "bench.sim.object=dice", input="S-1\n\n")  # ends when there is no further sample
    assert "'gone' in the catalog changed after they were stored" in done.stderr


@pytest.mark.parametrize("words", [("list",), ("list", "--label", ""), ("list", "--deleted")])
def test_listing_reports_a_flipped_byte_of_a_view_and_is_printed(rig, root: Path, words: tuple[str, ...]) -> None:
    intact = rig("catalog", *words)
    assert intact.exit_code == 0, intact.output
    flip(root, name_of(encode(image(10))).encode())
    done = rig("catalog", *words)
    assert done.exit_code == 7
    assert done.stdout == intact.stdout
    assert "Error 707 (catalog damaged): 'mug' in the catalog changed" in done.stderr
    listed, error = map(json.loads, rig("catalog", *words, "--json").stdout.splitlines())
    assert listed
    assert error["code"] == 707


@pytest.mark.parametrize("words", [("list",), ("show", "mug"), ("rename", "mug", "cup")])
def test_nothing_is_said_about_an_object_whose_line_in_the_log_was_changed(
    rig, root: Path, words: tuple[str, ...]
) -> None:
    flip(root, b"a mug with a chip")
    done = rig("catalog", *words)
    assert (done.exit_code, done.stdout) == (7, "")
    assert "Error 707 (catalog damaged): 'mug' in the catalog changed" in done.stderr
