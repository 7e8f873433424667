"""Catalogs and bundles with arbitrary values are read or rejected: no traceback, and nothing outside their place."""

import json
import shutil
import sqlite3
import zipfile
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.catalog import Catalog, migrate
from rig.catalog.edit import set_texts
from rig.catalog.exchange import import_objects, plan_import, read_bundle, read_objects, write_bundle
from rig.catalog.exchange.bundle import MANIFEST, OBJECTS
from rig.catalog.schema import APPEND_ONLY, METADATA
from rig.catalog.upkeep import collect_garbage, statistics
from rig.catalog.verify import verify
from rig.core.errors import ImportRejected, RigError
from rig.views import image_files as images
from sim.clock import VirtualClock
from tests.fuzzing import fuzz_settings
from tests.rig.catalog.catalog_samples import PROVENANCE, described, finished, image, plan, true_fill, without_waiting

HOSTILE = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.floats(),
    st.text(max_size=20),
    st.sampled_from(
        ["", "../x", "/etc/passwd", "images/../../x", "images/\0", "\x1b[2J", "9999-12-31T23:59:59-14:00", "1" * 5000]
    ),
    st.sampled_from([[], {}, [[]], {"region": "evil"}, {"issues": 5}, {"view": 7}, 2**63, -(2**70), [None]]),
)
CELLS = [(table.name, column.name) for table in METADATA.sorted_tables for column in table.columns]


@pytest.fixture(scope="module")
def sample(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("fuzz")
    with pytest.MonkeyPatch.context() as patch, Catalog.open(folder / "catalog", clock=VirtualClock()) as catalog:
        without_waiting(patch)
        true_fill(catalog, "mug", 2, 0, (2, 0, 12, 12))
        tin = catalog.begin("tin", planned_azimuth_deg=plan(2), provenance=PROVENANCE)
        tin.store_empty_table(image(9))
        tin.add(described(0, 3, segmentation={"method": "none", "issues": []}), image(3))
        write_bundle(folder / "good.zip", read_objects(catalog))
    return folder


@pytest.fixture(autouse=True, scope="module")
def _fast() -> Any:
    with pytest.MonkeyPatch.context() as patch:
        without_waiting(patch)
        yield


def in_sql(value: Any) -> Any:
    if isinstance(value, list | dict):
        return json.dumps(value)
    return str(value) if isinstance(value, int) and not -(2**63) <= value < 2**63 else value


@given(data=st.data())
@fuzz_settings(0.04)
def test_catalog_with_any_value_is_read_or_rejected(
    sample: Path, tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    table, column = data.draw(st.sampled_from(CELLS))
    value = in_sql(data.draw(HOSTILE))
    folder = tmp_path_factory.mktemp("victim")
    root = Path(shutil.copytree(sample / "catalog", folder / "catalog"))
    with closing(sqlite3.connect(root / "catalog.sqlite", isolation_level=None)) as connection:
        connection.execute("PRAGMA ignore_check_constraints = ON")
        connection.execute("DROP TRIGGER audit_no_update")
        try:
            connection.execute(f"UPDATE {table} SET {column} = ?", (value,))
        except (sqlite3.Error, UnicodeEncodeError):
            return
        finally:
            connection.execute(APPEND_ONLY[0])
    for read in (
        lambda catalog: [catalog.object(item.name) for item in catalog.objects()],
        lambda catalog: catalog.views(),
        lambda catalog: catalog.log(),
        statistics,
        lambda catalog: list(read_objects(catalog)),
        lambda catalog: finished(verify(catalog, jobs=1)),
        lambda catalog: finished(verify(catalog, repair=True, jobs=1)),
        lambda catalog: collect_garbage(catalog, old=True),
    ):
        try:
            with Catalog.open(root, clock=VirtualClock(), create=False) as catalog:
                read(catalog)
        except RigError:
            pass
    migrate(root, clock=VirtualClock())
    assert [path.name for path in folder.iterdir()] == ["catalog"]
    shutil.rmtree(folder)


def _leaves(value: Any) -> list[tuple[Any, Any]]:
    """Return container and key of every value in JSON."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [place for key, inner in items for place in [(value, key), *_leaves(inner)]]


@given(data=st.data())
@fuzz_settings(0.06)
def test_bundle_with_any_value_is_imported_or_rejected(
    sample: Path, tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    with zipfile.ZipFile(sample / "good.zip") as archive:
        members = {info.filename: archive.read(info) for info in archive.infolist()}
    lines = [json.loads(line) for line in members[OBJECTS].splitlines()]
    manifest = json.loads(members[MANIFEST])
    container, key = data.draw(
        st.sampled_from([*_leaves(lines), *((manifest, name) for name in ("format", "version"))])
    )
    container[key] = data.draw(HOSTILE)
    members[OBJECTS] = "".join(json.dumps(line) + "\n" for line in lines).encode()
    members[MANIFEST] = json.dumps(manifest | {"objects_sha256": images.digest(members[OBJECTS])}).encode()
    folder = tmp_path_factory.mktemp("victim")
    with zipfile.ZipFile(folder / "a.zip", "w") as target:
        for name, content in members.items():
            target.writestr(name, content)
    with Catalog.open(folder / "catalog", clock=VirtualClock()) as catalog:
        try:
            finished(import_objects(catalog, plan_import(catalog, read_bundle(folder / "a.zip")), jobs=1))
        except ImportRejected:
            assert catalog.objects() == []
        else:
            assert finished(verify(catalog, jobs=1)).findings == ()
            write_bundle(folder / "b.zip", read_objects(catalog))
            read_bundle(folder / "b.zip")
    shutil.rmtree(folder)


@given(
    name=st.text(min_size=1, max_size=30),
    texts=st.tuples(st.text(max_size=50), st.one_of(st.text(max_size=50), st.just("a" * 3_000_000))),
    azimuth_deg=st.floats(0, 360, exclude_max=True),
    evidence=st.dictionaries(
        st.text(max_size=5), st.one_of(st.floats(), st.integers(), st.text(max_size=9)), max_size=3
    ),
    region=st.sampled_from([None, (2, 0, 12, 12), (-1, 0, 5, 5), (0, 0, 0, 5), (0, 0, 16, 12)]),
    captured_ns=st.one_of(st.none(), st.integers(-(10**20), 10**20)),
)
@fuzz_settings(0.03)
def test_whatever_the_catalog_accepts_survives_export_and_import(
    tmp_path_factory: pytest.TempPathFactory,
    name: str,
    texts: tuple[str, str],
    azimuth_deg: float,
    evidence: dict[str, Any],
    region: tuple[int, int, int, int] | None,
    captured_ns: int | None,
) -> None:
    folder = tmp_path_factory.mktemp("round")
    clock = VirtualClock()
    with Catalog.open(folder / "catalog", clock=clock) as catalog, Catalog.open(folder / "copy", clock=clock) as copy:
        try:
            begun = catalog.begin(name, planned_azimuth_deg=[azimuth_deg], provenance=PROVENANCE)
            within = region if region and min(region) >= 0 and min(region[2:]) else None
            view = described(0, 1, within, azimuth_deg=azimuth_deg, evidence=evidence, captured_ns=captured_ns)
            if region != within:
                described(0, 1, None, region=region)
            begun.add(view, image(1))
            begun.finish()
            set_texts(catalog, begun.object_name, label=texts[0], note=texts[1])
        except (RigError, TypeError, OverflowError):
            pass
        if not catalog.objects() or not catalog.objects()[0].views:
            return
        assert write_bundle(folder / "a.zip", read_objects(catalog)) == 1
        finished(import_objects(copy, plan_import(copy, read_bundle(folder / "a.zip")), jobs=1))
        assert [item for item, _ in read_objects(copy)] == [item for item, _ in read_objects(catalog)]
        assert finished(verify(copy, jobs=1)).findings == ()
    shutil.rmtree(folder)
