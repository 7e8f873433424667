"""Commands compare the rows that they list or change with their digests."""

import json
import re
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from rig.catalog import Action, Catalog, log
from rig.catalog.images import name_of
from rig.views.image_files import encode
from sim.clock import VirtualClock
from tests.rig.catalog.catalog_samples import PROVENANCE, fill, image, plan, record, without_waiting

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
