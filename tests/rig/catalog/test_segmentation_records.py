"""What finds the objects in a catalog's images: filled in later, verified, and carried to other catalogs."""

from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from sqlalchemy import update

import hbr
from rig.catalog import Catalog
from rig.catalog.exchange import bring_in, collect, open_bundle, package_of, plan_import, read_folder, write_bundle
from rig.catalog.redescribe import redescribe
from rig.catalog.schema import descriptors
from rig.catalog.verify import Problem, verify
from rig.config import ViewConfig
from rig.core.clock import SystemClock
from rig.core.errors import DescriptorOutdated, UsageError
from rig.views.description import BENCH_DESCRIPTOR, PAPER_DESCRIPTOR, ViewDescriber
from rig.views.segmentation_evidence import SegmentationSummary
from tests.rig.catalog.catalog_samples import PROVENANCE, finished, plan, record, without_waiting

REGION = (8, 0, 64, 64)
VIEWS = 3


def table() -> NDArray[np.uint8]:
    coarse = np.random.default_rng(5).integers(60, 200, (8, 10, 3), np.uint8)
    return cv2.resize(coarse, (80, 64), interpolation=cv2.INTER_CUBIC).astype(np.uint8)


def view(index: int) -> NDArray[np.uint8]:
    image = table()
    image[20:50, 25 + 3 * index : 50 + 3 * index] = (20, 20, 230)
    image[28:38, 30 + 3 * index : 40 + 3 * index] = (230, 230, 20)
    return image


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    without_waiting(monkeypatch)


@pytest.fixture
def open_catalog(tmp_path: Path) -> Iterator[Callable[[str], Catalog]]:
    opened: list[Catalog] = []

    def open_one(name: str) -> Catalog:
        opened.append(Catalog.open(tmp_path / name, clock=SystemClock()))
        return opened[-1]

    yield open_one
    for catalog in opened:
        catalog.close()


def enrolled(catalog: Catalog, name: str, *, further: bool = True, reference: bool = True) -> None:
    enrollment = catalog.begin(name, planned_azimuth_deg=plan(VIEWS), provenance=PROVENANCE)
    if reference:
        enrollment.set_reference_image(table())
    describe = ViewDescriber(ViewConfig(roi=REGION), empty_table=table() if reference else None)
    for index in range(VIEWS):
        described = describe(view(index))
        levels = dict(described.levels)
        changes = {"segmentation": described.segmentation, "further": levels} if further else {}
        one = record(index, descriptor=levels.pop(PAPER_DESCRIPTOR), region=REGION, **changes)
        enrollment.add(one, view(index))
    enrollment.finish()


def sightings(catalog: Catalog, name: str) -> SegmentationSummary:
    return SegmentationSummary.of(view.record.segmentation for view in catalog.object(name).views)


def test_an_older_catalog_is_described_as_the_bench_would_have(open_catalog: Callable[[str], Catalog]) -> None:
    new, old = open_catalog("new"), open_catalog("old")
    enrolled(new, "box")
    enrolled(old, "box", further=False)
    with pytest.raises(DescriptorOutdated, match="box") as caught:
        old.views(BENCH_DESCRIPTOR)
    assert f"redescribe --descriptor {BENCH_DESCRIPTOR}" in caught.value.next_step
    assert sightings(old, "box").text == ""
    assert finished(redescribe(old, BENCH_DESCRIPTOR, jobs=1)).described == VIEWS
    assert np.array_equal(old.views(BENCH_DESCRIPTOR).views.descriptors, new.views(BENCH_DESCRIPTOR).views.descriptors)
    assert sightings(old, "box") == sightings(new, "box")
    assert sightings(old, "box").found == VIEWS
    assert finished(verify(old, jobs=1)).findings == finished(verify(new, jobs=1)).findings == ()


def test_without_an_empty_table_it_is_described_all_the_same(open_catalog: Callable[[str], Catalog]) -> None:
    catalog = open_catalog("old")
    enrolled(catalog, "box", further=False, reference=False)
    finished(redescribe(catalog, BENCH_DESCRIPTOR, jobs=1))
    expected = hbr.describe(view(0)[:, 8:72], descriptor=BENCH_DESCRIPTOR)
    assert np.array_equal(catalog.views(BENCH_DESCRIPTOR).views.descriptors[0], expected)
    assert all(view.record.segmentation["agreement"] is None for view in catalog.object("box").views)


def test_everything_travels_in_bundles_and_merges(open_catalog: Callable[[str], Catalog], tmp_path: Path) -> None:
    first = open_catalog("first")
    enrolled(first, "box")
    write_bundle(tmp_path / "box.rigcat.zip", collect(first))
    for name, package in (("bundle", open_bundle(tmp_path / "box.rigcat.zip")), ("merge", package_of(first))):
        catalog = open_catalog(name)
        finished(bring_in(catalog, plan_import(catalog, package), jobs=1))
        assert finished(verify(catalog, jobs=1)).findings == ()
        assert sightings(catalog, "box") == sightings(first, "box")
        before = catalog.views(BENCH_DESCRIPTOR).views.descriptors
        assert np.array_equal(before, first.views(BENCH_DESCRIPTOR).views.descriptors)
        finished(redescribe(catalog, BENCH_DESCRIPTOR, again=True, jobs=1))  # by the empty table that came along
        assert np.array_equal(before, catalog.views(BENCH_DESCRIPTOR).views.descriptors)


def test_a_damaged_empty_table_is_found_and_nothing_is_described_without_it(
    open_catalog: Callable[[str], Catalog],
) -> None:
    catalog = open_catalog("spoilt")
    enrolled(catalog, "box")
    before = catalog.views(BENCH_DESCRIPTOR).views.descriptors
    reference = next(catalog.path.rglob("empty-*.png"))
    whole = reference.read_bytes()
    reference.write_bytes(whole[:-20])
    found = finished(verify(catalog, jobs=1))
    assert [finding.problem for finding in found.findings] == [Problem.CHANGED_IMAGE]
    # elsewhere than where the pictures were read before
    moved = catalog.path.rename(catalog.path.with_name("moved"))
    with Catalog.open(moved, clock=SystemClock()) as other:
        done = finished(redescribe(other, BENCH_DESCRIPTOR, again=True, jobs=1))
        assert (done.described, len(done.failed)) == (0, VIEWS)
        assert all("empty-" in reason for _, reason in done.failed)
        assert np.array_equal(other.views(BENCH_DESCRIPTOR).views.descriptors, before)


@pytest.mark.parametrize(("levels", "step", "found"), [(1, 1, 0), (1, 2, 1), (100, 1, 1)])
def test_levels_that_rounded_otherwise_are_no_damage(
    open_catalog: Callable[[str], Catalog], levels: int, step: int, found: int
) -> None:
    catalog = open_catalog("rounded")
    enrolled(catalog, "box")
    kind = hbr.descriptor(BENCH_DESCRIPTOR)
    off = catalog.views(BENCH_DESCRIPTOR).views.descriptors[0].copy()
    entries = np.arange(levels)
    off[entries] = np.where(off[entries] >= 2, off[entries] - step, off[entries] + step)
    with catalog.database.write() as connection:
        connection.execute(
            update(descriptors)
            .where(descriptors.c.view_id == 1, descriptors.c.name == BENCH_DESCRIPTOR)
            .values(packed=kind.pack(off))
        )
    seen = finished(verify(catalog, repair=True, jobs=1)).findings
    assert [finding.problem for finding in seen] == [Problem.DESCRIPTOR_DIFFERS] * found
    assert finished(verify(catalog, jobs=1)).findings == ()


def test_photographs_are_described_further_as_they_come_in(
    open_catalog: Callable[[str], Catalog], tmp_path: Path
) -> None:
    folder = tmp_path / "photographs"
    folder.mkdir()
    for index in range(VIEWS):
        cv2.imwrite(str(folder / f"obj1__{index * 120}.png"), view(index))
    catalog = open_catalog("catalog")
    package = read_folder(folder, now=SystemClock().utc())
    with pytest.raises(UsageError, match="no descriptor 'edgy'"):
        finished(bring_in(catalog, plan_import(catalog, package), further=["edgy"], jobs=1))
    finished(bring_in(catalog, plan_import(catalog, package), further=[BENCH_DESCRIPTOR], jobs=1))
    assert len(catalog.views(BENCH_DESCRIPTOR).views) == len(catalog.views().views) == VIEWS
    assert sightings(catalog, "obj1").views == VIEWS
    assert finished(verify(catalog, jobs=1)).findings == ()
