"""Segmentations and descriptors of the object alone: computed later, verified, and exported to other catalogs."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from sqlalchemy import update

import hbr
from rig.catalog import Catalog
from rig.catalog.descriptions import guessed_objects
from rig.catalog.exchange import (
    import_objects,
    plan_import,
    read_bundle,
    read_catalog,
    read_folder,
    read_objects,
    write_bundle,
)
from rig.catalog.queries import packed_descriptors
from rig.catalog.redescribe import redescribe
from rig.catalog.schema import descriptors, views
from rig.catalog.seal import changing_enrollments
from rig.catalog.together import DescribedMeanwhile, HeldImages, describe_together, stored_images
from rig.catalog.verify import verify
from rig.catalog.verify_images import Problem
from rig.config import ViewConfig
from rig.core.clock import SystemClock
from rig.core.errors import DescriptorOutdated, UsageError
from rig.core.next_steps import Do
from rig.search.model import load_model
from rig.views.description import BENCH_DESCRIPTOR, DESCRIPTORS, PAPER_DESCRIPTOR, EnrollmentDescriber, ViewDescriber
from rig.views.segmentation_evidence import SegmentationSummary
from tests.rig.catalog.catalog_samples import PROVENANCE, finished, plan, record

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


def enrolled(catalog: Catalog, name: str, *, names: tuple[str, ...] = DESCRIPTORS, empty_table: bool = True) -> None:
    enrollment = catalog.begin(name, planned_azimuth_deg=plan(VIEWS), provenance=PROVENANCE)
    if empty_table:
        enrollment.store_empty_table(table())
    describe = ViewDescriber(ViewConfig(roi=REGION), names, table() if empty_table else None)
    for index in range(VIEWS):
        levels, segmentation = (described := describe(view(index))).levels, described.segmentation
        enrollment.add(record(index, descriptors=levels, region=REGION, segmentation=segmentation), view(index))
    enrollment.revise()
    enrollment.finish()


def segmentations(catalog: Catalog, name: str) -> SegmentationSummary:
    return SegmentationSummary.of(view.record.segmentation for view in catalog.object(name).views)


def test_redescribe_gives_the_levels_of_the_bench(open_catalog: Callable[[str], Catalog]) -> None:
    new, old = open_catalog("new"), open_catalog("old")
    enrolled(new, "box")
    enrolled(old, "box", names=(PAPER_DESCRIPTOR,))
    with pytest.raises(DescriptorOutdated, match="box") as caught:
        old.views(BENCH_DESCRIPTOR)
    assert caught.value.steps == (Do.REDESCRIBE(descriptor=BENCH_DESCRIPTOR),)
    assert segmentations(old, "box").text == ""
    assert finished(redescribe(old, BENCH_DESCRIPTOR, jobs=1)).described == VIEWS
    assert np.array_equal(old.views(BENCH_DESCRIPTOR).views.descriptors, new.views(BENCH_DESCRIPTOR).views.descriptors)
    assert segmentations(old, "box") == segmentations(new, "box")
    assert segmentations(old, "box").found == VIEWS
    assert finished(verify(old, jobs=1)).findings == finished(verify(new, jobs=1)).findings == ()


def test_redescribe_works_without_an_empty_table_image(open_catalog: Callable[[str], Catalog]) -> None:
    catalog = open_catalog("old")
    enrolled(catalog, "box", names=(PAPER_DESCRIPTOR,), empty_table=False)
    finished(redescribe(catalog, BENCH_DESCRIPTOR, jobs=1))
    together = hbr.ViewsTogether(BENCH_DESCRIPTOR, several=False)
    for index in range(VIEWS):
        together.learn(view(index)[:, 8:72])
    together.revise()
    expected = [levels[0] for levels in together.levels]
    assert np.array_equal(catalog.views(BENCH_DESCRIPTOR).views.descriptors, expected)
    assert all(view.record.segmentation["agreement"] is None for view in catalog.object("box").views)
    assert finished(verify(catalog, jobs=1)).findings == ()
    assert finished(redescribe(catalog, BENCH_DESCRIPTOR, jobs=1)).unchanged == VIEWS


def test_redescribe_segments_views_again_that_were_guessed(open_catalog: Callable[[str], Catalog]) -> None:
    catalog = open_catalog("old")
    enrollment = catalog.begin("box", planned_azimuth_deg=plan(VIEWS), provenance=PROVENANCE)
    describe = ViewDescriber(ViewConfig(roi=REGION))
    for index in range(VIEWS):
        found = describe(view(index))
        assert found.segmentation is not None
        assert found.segmentation["method"] == "guess"
        enrollment.add(
            record(index, descriptors=found.levels, region=REGION, segmentation=found.segmentation), view(index)
        )
    enrollment.finish()
    assert finished(verify(catalog, jobs=1)).findings == ()  # by the guess
    assert guessed_objects(catalog) == ("box",)
    assert finished(redescribe(catalog, BENCH_DESCRIPTOR, jobs=1)).described == VIEWS
    assert guessed_objects(catalog) == ()
    assert {view.record.segmentation["together"] for view in catalog.object("box").views} == {VIEWS}
    assert finished(verify(catalog, jobs=1)).findings == ()


@pytest.mark.sqlite
def test_a_view_is_described_again_by_its_stored_silhouette_alone(open_catalog: Callable[[str], Catalog]) -> None:
    catalog = open_catalog("new")
    enrolled(catalog, "box", empty_table=False)
    before = catalog.views(BENCH_DESCRIPTOR).views.descriptors
    next(catalog.path.rglob("001.png")).unlink()
    found = finished(verify(catalog, jobs=1)).findings
    assert [finding.problem for finding in found] == [Problem.MISSING_IMAGE]
    # a silhouette that is not that of the levels is found
    with catalog.database.write(1) as connection, changing_enrollments(connection, [1]):
        evidence = dict(catalog.object("box").views[2].record.segmentation)
        evidence["mask"] = catalog.object("box").views[0].record.segmentation["mask"]
        connection.execute(update(views).where(views.c.view_index == 2).values(segmentation=evidence))
    problems = {finding.problem for finding in finished(verify(catalog, jobs=1)).findings}
    assert Problem.DESCRIPTOR_DIFFERS in problems
    assert np.array_equal(before, catalog.views(BENCH_DESCRIPTOR).views.descriptors)


def test_bundle_and_merge_keep_segmentation_and_empty_table(
    open_catalog: Callable[[str], Catalog], tmp_path: Path
) -> None:
    first = open_catalog("first")
    enrolled(first, "box")
    write_bundle(tmp_path / "box.rigcat.zip", read_objects(first))
    for name, batch in (("bundle", read_bundle(tmp_path / "box.rigcat.zip")), ("merge", read_catalog(first))):
        catalog = open_catalog(name)
        finished(import_objects(catalog, plan_import(catalog, batch), jobs=1))
        assert finished(verify(catalog, jobs=1)).findings == ()
        assert segmentations(catalog, "box") == segmentations(first, "box")
        before = catalog.views(BENCH_DESCRIPTOR).views.descriptors
        assert np.array_equal(before, first.views(BENCH_DESCRIPTOR).views.descriptors)
        finished(redescribe(catalog, BENCH_DESCRIPTOR, again=True, jobs=1))  # by the empty table that came along
        assert np.array_equal(before, catalog.views(BENCH_DESCRIPTOR).views.descriptors)


@pytest.mark.sqlite
def test_damaged_empty_table_image_is_found_and_not_used(
    open_catalog: Callable[[str], Catalog],
) -> None:
    catalog = open_catalog("spoilt")
    enrolled(catalog, "box")
    before = catalog.views(BENCH_DESCRIPTOR).views.descriptors
    empty_table = next(catalog.path.rglob("empty-*.png"))
    whole = empty_table.read_bytes()
    empty_table.write_bytes(whole[:-20])
    found = finished(verify(catalog, jobs=1))
    assert [finding.problem for finding in found.findings] == [Problem.CHANGED_IMAGE]
    # another path: empty-table images are cached by path
    moved = catalog.path.rename(catalog.path.with_name("moved"))
    with Catalog.open(moved, clock=SystemClock()) as other:
        done = finished(redescribe(other, BENCH_DESCRIPTOR, again=True, jobs=1))
        assert (done.described, len(done.failed)) == (0, VIEWS)
        assert all("empty-" in reason for _, reason in done.failed)
        assert np.array_equal(other.views(BENCH_DESCRIPTOR).views.descriptors, before)


@pytest.mark.parametrize(("levels", "step", "found"), [(1, 1, 0), (1, 2, 1), (100, 1, 1)])
def test_verify_tolerates_rounded_levels(
    open_catalog: Callable[[str], Catalog], levels: int, step: int, found: int
) -> None:
    catalog = open_catalog("rounded")
    enrolled(catalog, "box")
    kind = hbr.descriptor(BENCH_DESCRIPTOR)
    off = catalog.views(BENCH_DESCRIPTOR).views.descriptors[0].copy()
    entries = np.arange(levels)
    off[entries] = np.where(off[entries] >= 2, off[entries] - step, off[entries] + step)
    with catalog.database.write() as connection, changing_enrollments(connection, [1]):
        connection.execute(
            update(descriptors)
            .where(descriptors.c.view_id == 1, descriptors.c.name == BENCH_DESCRIPTOR)
            .values(packed=kind.pack(off))
        )
    seen = finished(verify(catalog, repair=True, jobs=1)).findings
    assert [finding.problem for finding in seen] == [Problem.DESCRIPTOR_DIFFERS] * found
    assert finished(verify(catalog, jobs=1)).findings == ()


def test_import_computes_requested_descriptors(open_catalog: Callable[[str], Catalog], tmp_path: Path) -> None:
    folder = tmp_path / "photographs"
    folder.mkdir()
    for index in range(VIEWS):
        cv2.imwrite(str(folder / f"obj1__{index * 120}.png"), view(index))
    catalog = open_catalog("catalog")
    batch = read_folder(folder, now=SystemClock().utc())
    with pytest.raises(UsageError, match="no descriptor 'edgy'"):
        finished(import_objects(catalog, plan_import(catalog, batch), descriptors=["edgy"], jobs=1))
    finished(import_objects(catalog, plan_import(catalog, batch), descriptors=[BENCH_DESCRIPTOR], jobs=1))
    assert len(catalog.views(BENCH_DESCRIPTOR).views) == len(catalog.views().views) == VIEWS
    assert segmentations(catalog, "obj1").views == VIEWS
    assert finished(verify(catalog, jobs=1)).findings == ()


def test_search_compares_the_bench_with_the_newest_enrollment(open_catalog: Callable[[str], Catalog]) -> None:
    catalog = open_catalog("new")
    enrolled(catalog, "box", empty_table=False)
    enrolled(catalog, "can", empty_table=False)
    (first, *_) = catalog.object("can").views
    model = load_model(catalog)
    assert model.empty_table is None
    assert model.bench_image is not None
    assert np.array_equal(model.bench_image, view(0))
    (catalog.path / first.image).unlink()
    assert load_model(catalog).bench_image is None


def test_views_are_described_the_same_in_several_threads(open_catalog):
    catalog = open_catalog("catalog")
    enrolled(catalog, "box")
    with catalog.database.read() as connection:
        images = stored_images(connection, 1)
    one, several = (
        describe_together(HeldImages(catalog.database.images), (BENCH_DESCRIPTOR,), images, threads=threads)
        for threads in (1, 3)
    )
    assert len(one) == VIEWS
    assert all(found.packed for found in one)
    assert one == several


def test_views_described_while_the_table_rotates_equal_those_described_afterwards(open_catalog):
    catalog = open_catalog("catalog")
    enrolled(catalog, "box")
    store = catalog.database.images
    with catalog.database.read() as connection:
        images = stored_images(connection, 1)
        stored = packed_descriptors(connection, views.c.enrollment_id == 1)
    afterwards = describe_together(HeldImages(store), (BENCH_DESCRIPTOR,), images)
    assert [one.packed[0] for one in afterwards] == [
        next(packed for packed in stored[one.view_id] if packed.name == BENCH_DESCRIPTOR) for one in afterwards
    ]
    assert [one.segmentation for one in afterwards] == [
        view.record.segmentation for view in catalog.object("box").views
    ]


def test_description_made_meanwhile_counts_only_for_the_same_descriptors_and_region(open_catalog):
    catalog = open_catalog("catalog")
    enrolled(catalog, "box")
    with catalog.database.read() as connection:
        (item, *_) = stored_images(connection, 1)
    held = HeldImages(catalog.database.images)
    meanwhile = DescribedMeanwhile()
    pixels = held.pixels(item.image, item.sha256)
    config = ViewConfig(roi=REGION)
    segmented = ViewDescriber(config, (BENCH_DESCRIPTOR,), table())(pixels).segmented
    meanwhile.begin(item.image, (BENCH_DESCRIPTOR,), item.region, item.empty_table, segmented)
    describer = EnrollmentDescriber(config, (BENCH_DESCRIPTOR,), table())
    expected = describer.describe(describer.learn(pixels), pixels)
    found = meanwhile.result(item, (BENCH_DESCRIPTOR,))
    assert found.evidence == expected.segmentation
    assert np.array_equal(found.levels[BENCH_DESCRIPTOR], expected.levels[BENCH_DESCRIPTOR])
    assert meanwhile.result(item, (BENCH_DESCRIPTOR, "edges")) is None
    assert meanwhile.result(item._replace(region=None), (BENCH_DESCRIPTOR,)) is None
