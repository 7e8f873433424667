"""What is computed from the facts can be lost, damaged, old or of another enrollment, and searches stay the same."""

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from sqlalchemy import delete, insert, select, update

import hbr
from hbr.descriptors import network
from hbr.descriptors.registry import FULL
from rig.catalog import Catalog, Enrollment, derived, describing
from rig.catalog.describing import SEGMENTATION, described
from rig.catalog.facts import Derived, seal_of
from rig.catalog.jobs import JobProgress, finished
from rig.catalog.verify import CatalogProblem, verify
from rig.config import ViewConfig
from rig.core.errors import CatalogBusy, CatalogDamaged, CatalogError, ExtraMissing, UsageError
from rig.core.next_steps import Do
from rig.search.model import load_model
from rig.views.description import (
    BENCH_DESCRIPTOR,
    DESCRIPTORS,
    PAPER_DESCRIPTOR,
    EnrollmentDescriber,
    segmentation_summary,
    within,
)
from sim.clock import VirtualClock
from tests.rig.catalog.catalog_samples import PROVENANCE, forget, plan, record, sql, without_waiting

REGION = (8, 0, 64, 64)
VIEWS = 4
NAMES = ("box", "can", "cup")


def table() -> NDArray[np.uint8]:
    coarse = np.random.default_rng(5).integers(60, 200, (8, 10, 3), np.uint8)
    return cv2.resize(coarse, (80, 64), interpolation=cv2.INTER_CUBIC).astype(np.uint8)


def view(index: int, number: int = 0) -> NDArray[np.uint8]:
    image = table()
    image[20:50, 25 + 3 * index : 50 + 3 * index] = (20, 20 + 90 * number, 230)
    image[28:38, 30 + 3 * index : 40 + 3 * index] = (230, 230, 20)
    return image


def enroll(catalog: Catalog, name: str, number: int = 0, *, empty_table: bool = True, **begin: Any) -> None:
    enrollment = catalog.begin(
        name,
        planned_azimuth_deg=plan(VIEWS),
        provenance=PROVENANCE,
        empty_table=table() if empty_table else None,
        **begin,
    )
    for index in range(VIEWS):
        enrollment.add(record(index, region=REGION), view(index, number))
    enrollment.finish()


@pytest.fixture(scope="module")
def enrolled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("derived") / "catalog"
    with pytest.MonkeyPatch.context() as patch, Catalog.open(path, clock=VirtualClock()) as catalog:
        without_waiting(patch)
        for number, name in enumerate(NAMES):
            enroll(catalog, name, number)
    return path


@pytest.fixture
def catalog(enrolled: Path, tmp_path: Path) -> Iterator[Catalog]:
    with Catalog.open(shutil.copytree(enrolled, tmp_path / "catalog"), clock=VirtualClock()) as catalog:
        yield catalog


def complete(catalog: Catalog, name: str) -> Enrollment:
    enrollment = catalog.object(name).complete
    assert enrollment is not None
    return enrollment


def load(catalog: Catalog, kind: str = BENCH_DESCRIPTOR) -> tuple[hbr.Views, int]:
    """Return the views, and how many enrollments were described for them."""
    steps: list[JobProgress] = []
    views = derived.views(catalog, kind, steps.append)
    return views, steps[-1].total if steps else 0


def equal(one: hbr.Views, other: hbr.Views) -> bool:
    return one.object_names == other.object_names and all(
        np.array_equal(getattr(one, name), getattr(other, name))
        for name in ("descriptors", "azimuth_deg", "object_index")
    )


def rows(catalog: Catalog) -> dict[tuple[str, str], tuple[str, bytes, str]]:
    with catalog.database.read() as transaction:
        found = transaction.scalars(select(Derived)).all()
        return {(one.seal, one.what): (one.made_by, one.content, one.sha256) for one in found}


@pytest.mark.parametrize("kind", [BENCH_DESCRIPTOR, PAPER_DESCRIPTOR])
def test_an_enrollment_is_described_once_when_it_ends(catalog: Catalog, kind: str) -> None:
    views, described = load(catalog, kind)
    assert described == 0
    assert isinstance(views, hbr.PackedViews)
    assert views.object_names == NAMES
    describer = EnrollmentDescriber(ViewConfig(roi=REGION), DESCRIPTORS, table())
    numbers = [describer.learn(view(index)) for index in range(VIEWS)]
    expected = [describer.describe(number, view(index)).levels[kind] for index, number in enumerate(numbers)]
    assert np.array_equal(views.descriptors[:VIEWS], expected)


def test_deleting_everything_that_is_computed_loses_nothing(catalog: Catalog) -> None:
    before, stored = [load(catalog, kind)[0] for kind in DESCRIPTORS], rows(catalog)
    version = catalog.version()
    forget(catalog)
    assert catalog.version() == version
    assert load(catalog)[1] == len(NAMES)  # all descriptors of an enrollment are computed together
    after = [load(catalog, kind) for kind in DESCRIPTORS]
    assert [described for _, described in after] == [0] * len(DESCRIPTORS)
    assert all(equal(one, other) for one, (other, _) in zip(before, after, strict=True))
    assert rows(catalog) == stored
    assert finished(verify(catalog, jobs=1)).findings == ()


@pytest.mark.parametrize(
    "values",
    [
        {"made_by": f"{BENCH_DESCRIPTOR} 0, segmentation 1"},
        *({"content": b""}, {"content": bytes(VIEWS * 100)}, {"sha256": "0" * 64}, {"sha256": ""}),
    ],
)
def test_a_wrong_or_old_result_is_computed_again(catalog: Catalog, values: dict[str, Any]) -> None:
    before, stored = load(catalog)[0], rows(catalog)
    with catalog.database.write() as transaction:
        transaction.execute(update(Derived).values(**values))
    after, described = load(catalog)
    assert (described, equal(before, after)) == (len(NAMES), True)
    for kind in DESCRIPTORS:
        load(catalog, kind)
    assert rows(catalog) == stored


def test_flipped_bytes_and_results_of_another_enrollment_are_found_and_computed_again(catalog: Catalog) -> None:
    before = load(catalog)[0]
    own = {seal: row for (seal, what), row in rows(catalog).items() if what == BENCH_DESCRIPTOR}
    (first, (_, one, one_digest)), (second, (_, other, other_digest)), (third, (_, last, digest)) = own.items()
    flipped = last[:5] + bytes([last[5] ^ 1]) + last[6:]
    with catalog.database.write() as transaction:
        for seal, content, sha256 in (
            *((first, other, other_digest), (second, one, one_digest)),  # exchanged, with their digests
            (third, flipped, digest),
        ):
            changed = update(Derived).where(Derived.seal == seal, Derived.what == BENCH_DESCRIPTOR)
            transaction.execute(changed.values(content=content, sha256=sha256))
    found = [one.problem for one in finished(verify(catalog, jobs=1)).findings]
    assert found == [CatalogProblem.DESCRIPTION_DAMAGED] * len(NAMES)
    after, described = load(catalog)
    assert (described, equal(before, after)) == (len(NAMES), True)
    assert finished(verify(catalog, jobs=1)).findings == ()


def test_only_new_objects_are_described(catalog: Catalog) -> None:
    enroll(catalog, "new", 1)
    assert load(catalog)[1] == 0
    catalog.rename("new", "newer")
    catalog.delete("box")
    catalog.undelete("box")
    views, described = load(catalog)
    assert described == 0
    assert views.object_names == (*NAMES, "newer")
    enroll(catalog, "can", 2, replace=True)
    assert load(catalog)[1] == 0


def test_another_descriptor_is_described_when_it_is_asked_for(catalog: Catalog) -> None:
    kind = hbr.descriptor("cedd-blurred")
    assert np.array_equal(load(catalog, kind.name)[0].descriptors[1], kind.describe(within(view(1), REGION)))
    assert load(catalog, kind.name)[1] == 0


def test_an_interrupted_description_continues(catalog: Catalog) -> None:
    before = load(catalog)[0]
    forget(catalog)
    shown = []

    def interrupt(progress: JobProgress) -> None:
        shown.append(progress.done)
        if progress.done:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        derived.views(catalog, BENCH_DESCRIPTOR, interrupt)
    assert shown == [0, 1]
    after, described = load(catalog)
    assert (described, equal(before, after)) == (len(NAMES) - 1, True)


def test_a_catalog_that_is_read_only_is_described_in_memory(catalog: Catalog, monkeypatch: pytest.MonkeyPatch) -> None:
    before = load(catalog)[0]
    forget(catalog)

    def busy(*_: object) -> None:
        raise CatalogBusy("Another process writes.", next_step="Wait.")

    with monkeypatch.context() as patch, Catalog.open(catalog.path, clock=VirtualClock(), read_only=True) as reader:
        patch.setattr(describing, "_write", busy)
        for opened in (reader, catalog):
            after, described = load(opened)
            assert (described, equal(before, after)) == (len(NAMES), True)
    with Catalog.open(catalog.path, clock=VirtualClock(), read_only=True) as reader:
        assert [load(reader)[1] for _ in range(2)] == [len(NAMES), 0]


@pytest.mark.parametrize("evidence", ["[]", "{}", "[1]", "[NaN, NaN, NaN, NaN]", "null", "[" * 5000, '[{"issues": 5}]'])
def test_evidence_that_no_program_wrote_is_computed_again(catalog: Catalog, evidence: str) -> None:
    enrollment = complete(catalog, "box")
    expected = described(catalog.database, enrollment, "box")
    assert segmentation_summary(expected.segmentation)["found"] == VIEWS
    (seal,) = {seal for seal, what in rows(catalog) if seal == seal_of(enrollment)}
    with catalog.database.write() as transaction:
        transaction.execute(delete(Derived).where(Derived.seal == seal, Derived.what == SEGMENTATION))
        transaction.execute(insert(Derived).values(describing.row_of(seal, SEGMENTATION, evidence.encode())))
    found = described(catalog.database, enrollment, "box")
    assert found.segmentation == expected.segmentation
    assert all(np.array_equal(found.levels[name], expected.levels[name]) for name in DESCRIPTORS)


def test_azimuths_that_no_program_wrote_are_not_searched(catalog: Catalog) -> None:
    kind = hbr.descriptor(BENCH_DESCRIPTOR)
    enrollment = complete(catalog, "box")
    seal, packed = seal_of(enrollment), np.zeros((VIEWS, kind.size_bytes), np.uint8)
    with catalog.database.write() as transaction:
        transaction.execute(delete(Derived).where(Derived.seal == seal, Derived.what == kind.name))
        content = describing.content_of(kind, packed, [0.0, 90.0, np.nan, 270.0])
        transaction.execute(insert(Derived).values(describing.row_of(seal, kind.name, content)))
    with pytest.raises(CatalogDamaged, match="azimuth"):
        load(catalog)


@pytest.mark.sqlite
@pytest.mark.parametrize(
    "edit",
    [
        "log SET object_name = 'cap' WHERE id = 1",
        "log SET seal = lower(hex(zeroblob(32))) WHERE id = 2",
        "log SET status = NULL WHERE id = 2",
        "views SET azimuth_deg = 1.5 WHERE id = 2",
    ],
)
def test_a_changed_name_seal_or_view_is_found_at_every_start(catalog: Catalog, edit: str) -> None:
    load(catalog)
    if edit.startswith("views"):
        forget(catalog)  # a view is read when it is described
    sql(catalog, f"UPDATE {edit}")
    for _ in range(2):
        with pytest.raises(CatalogDamaged):
            load(catalog)


def test_an_object_whose_image_is_missing_is_named(catalog: Catalog) -> None:
    stored = rows(catalog)
    forget(catalog)
    catalog.image_path(catalog.object("can").views[1].image).unlink()
    with pytest.raises(CatalogError, match=r"'can' cannot be described: .* is missing"):
        load(catalog)
    assert len(rows(catalog)) == (len(NAMES) - 1) * len(stored) // len(NAMES)  # the others are described
    with pytest.raises(UsageError, match="no descriptor 'edgy'"):
        load(catalog, "edgy")


def test_a_catalog_with_learned_descriptions_is_searched_without_the_weights(
    catalog: Catalog, monkeypatch: pytest.MonkeyPatch
) -> None:
    learned = FULL
    with monkeypatch.context() as patch:
        patch.setattr(network, "weights_file", lambda: Path("weights"))
        patch.setattr(network, "_NET", lambda frame: frame[105:119, 105:119, :1].repeat(112, axis=2))
        views, described = load(catalog, learned)
    assert (len(views), described) == (len(NAMES) * VIEWS, len(NAMES))
    monkeypatch.setattr(network, "weights_file", lambda: None)
    model = load_model(catalog)
    assert (model.descriptor, len(model.views)) == (BENCH_DESCRIPTOR, len(views))
    with pytest.raises(ExtraMissing) as caught:
        load(catalog, learned)
    assert Do.INSTALL_EXTRA(extra="network") in caught.value.steps


@pytest.mark.parametrize("threads", [1, 3])
def test_views_are_described_the_same_in_several_threads(
    catalog: Catalog, threads: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    stored = rows(catalog)
    forget(catalog)
    monkeypatch.setattr(describing, "THREADS", threads)
    for name in NAMES:
        enrollment = complete(catalog, name)
        described(catalog.database, enrollment, name)
    assert rows(catalog) == stored


def test_local_views_are_cut_by_the_stored_silhouettes(catalog: Catalog) -> None:
    near = derived.local_views(catalog, "box", [10.0])
    assert near
    forget(catalog)
    again = derived.local_views(catalog, "box", [10.0])
    assert [one.azimuth_deg for one in near] == [one.azimuth_deg for one in again]
    assert all(np.array_equal(one.mask, other.mask) for one, other in zip(near, again, strict=True))


def test_one_object_without_a_description_does_not_change_the_method(catalog: Catalog) -> None:
    before = load_model(catalog)
    seal, _ = next(iter(rows(catalog)))
    with catalog.database.write() as transaction:
        transaction.execute(delete(Derived).where(Derived.seal == seal))
    after = load_model(catalog)
    assert after.descriptor == before.descriptor == BENCH_DESCRIPTOR
    assert equal(before.views, after.views)
    assert after.is_dense


def test_a_changed_empty_table_image_is_found_and_not_used(catalog: Catalog) -> None:
    enrollment = complete(catalog, "box")
    image = enrollment.sessions[0].empty_table
    assert image is not None
    path = catalog.image_path(image)
    path.write_bytes(path.read_bytes()[:-20])
    found = finished(verify(catalog, jobs=1)).findings
    assert {finding.problem for finding in found} == {CatalogProblem.CHANGED_IMAGE}
    forget(catalog)
    with pytest.raises(CatalogError, match="cannot be described"):
        load(catalog)
    assert not rows(catalog)


def test_a_short_session_learns_from_all_views(open_catalog: Callable[[str], Catalog]) -> None:
    """After an interruption, one view alone would not show what the background is."""
    whole, interrupted = open_catalog("whole"), open_catalog("interrupted")
    enroll(whole, "box", empty_table=False)
    begun = interrupted.begin("box", planned_azimuth_deg=plan(VIEWS), provenance=PROVENANCE)
    for index in range(VIEWS - 1):
        begun.add(record(index, region=REGION), view(index))
    resumed = interrupted.resume("box", provenance=PROVENANCE)
    resumed.add(record(VIEWS - 1, region=REGION), view(VIEWS - 1))
    resumed.finish()
    assert equal(load(whole)[0], load(interrupted)[0])
