"""A catalog returns what was stored, and searches use complete enrollments only."""

from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

import hbr
from rig.catalog import Catalog, EnrollmentStatus, OpenEnrollment, Provenance, View, clean_name
from rig.catalog.derived import views as searched
from rig.core.errors import CatalogError, ObjectExists, ObjectNotFound, UsageError
from rig.core.next_steps import Do
from rig.views.image_files import encode
from sim.clock import EPOCH, VirtualClock
from tests.fuzzing import examples
from tests.rig.catalog.catalog_samples import PROVENANCE, fill, image, plan, record

NAMES = st.text(st.characters(exclude_categories=["C", "Z"]), min_size=1, max_size=20)
ANGLES = st.floats(-1e6, 1e6)
EVIDENCE = st.dictionaries(
    st.text(max_size=8),
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(max_size=8),
    max_size=4,
)
IMAGES = hnp.arrays(np.uint8, st.tuples(st.integers(16, 24), st.integers(16, 24), st.just(3)))


def begin(catalog: Catalog, name: str, views: int = 3, **options: object) -> OpenEnrollment:
    return catalog.begin(name, planned_azimuth_deg=plan(views), provenance=PROVENANCE, **options)  # type: ignore[arg-type]


VALUES = st.fixed_dictionaries(
    {
        **dict.fromkeys(("commanded_deg", "encoder_deg"), ANGLES),
        "azimuth_deg": st.floats(0, 360, exclude_max=True),
        "captured_ns": st.integers(0, 2**62),
        "evidence": EVIDENCE,
    }
)
IMU = st.tuples(st.none(), st.none()) | st.tuples(ANGLES, st.floats(0, 10))


@examples(7)
@given(name=NAMES.filter(lambda name: clean_name(name) == name), values=VALUES, imu=IMU, image_bgr=IMAGES)
def test_view_is_read_as_it_was_stored(name: str, values: dict[str, Any], imu: Any, image_bgr: np.ndarray) -> None:
    clock = VirtualClock()
    clock.advance_to(values["captured_ns"])
    values = {"index": 0, **values, "imu_deg": imu[0], "imu_sigma_deg": imu[1]}
    with TemporaryDirectory() as folder:
        with Catalog.open(folder, clock=clock) as catalog:
            enrollment = begin(catalog, name, views=1)
            enrollment.add(View(**values), image_bgr[::-1])
            enrollment.finish()
        with Catalog.open(folder, clock=clock, read_only=True) as catalog:
            found = catalog.object(name)
            (stored,) = found.views
            assert np.array_equal(catalog.read_image(stored.image), image_bgr[::-1])
            assert catalog.image_path(stored.image).resolve().is_relative_to(Path(folder, "images").resolve())
            assert catalog.view(stored.id).digest == stored.digest
            model = searched(catalog)
    assert {key: getattr(stored, key) for key in values} == values
    assert found.complete is not None
    assert [one.provenance for one in found.complete.sessions] == [PROVENANCE]
    assert model.object_names == (name,)
    assert np.array_equal(model.descriptors, hbr.describe(image_bgr[::-1])[None])
    assert model.azimuth_deg.tolist() == [values["azimuth_deg"]]


def test_views_are_ordered_by_object_and_index(catalog: Catalog) -> None:
    assert (len(searched(catalog)), catalog.objects(), catalog.first_views()) == (0, [], {})
    with pytest.raises(CatalogError, match="no view 5"):
        catalog.view(5)
    fill(catalog, "tin", 3)
    begin(catalog, "unfinished").add(record(0), image(0))
    mug = begin(catalog, "mug", 4)
    for index in (3, 1, 0, 2):
        mug.add(record(index), image(index))
    mug.finish()
    model = searched(catalog)
    assert model.object_names == ("tin", "mug")
    assert model.object_index.tolist() == [0, 0, 0, 1, 1, 1, 1]
    assert model.azimuth_deg.tolist() == [0, 5, 10, 0, 5, 10, 15]
    assert [view.index for view in catalog.object("mug").views] == [0, 1, 2, 3]
    assert {name: catalog.view(view_id).index for name, view_id in catalog.first_views().items()} == {
        "tin": 0,
        "mug": 0,
    }


def test_times_come_from_the_injected_clock(catalog: Catalog, clock: VirtualClock) -> None:
    enrollment = begin(catalog, "mug", 1)
    clock.sleep(2.0)
    exposed_ns = clock.now_ns()
    clock.sleep(0.25)
    enrollment.add(record(0, captured_ns=exposed_ns), image(0))
    clock.sleep(1.0)
    enrollment.finish()
    details = catalog.object("mug")
    assert details.summary.created_utc == EPOCH
    assert details.summary.enrolled_utc == EPOCH + timedelta(seconds=3.25)
    assert details.views[0].captured_utc == EPOCH + timedelta(seconds=2)
    assert details.views[0].captured_utc.tzinfo is UTC
    noon = datetime(2026, 7, 1, 12, tzinfo=timezone(timedelta(hours=2)))
    with Catalog.open(catalog.path, clock=VirtualClock(noon)) as elsewhere:
        begin(elsewhere, "tin")
        assert elsewhere.object("tin").summary.created_utc == datetime(2026, 7, 1, 10, tzinfo=UTC)


def test_replacement_keeps_the_old_views_until_it_is_complete(catalog: Catalog) -> None:
    fill(catalog, "mug", 2, label="cup", note="chipped")
    with pytest.raises(ObjectExists, match="2 views") as error:
        begin(catalog, "mug")
    assert Do.ENROLL_AGAIN(name="mug") in error.value.steps
    again = begin(catalog, "mug", 3, replace=True, label="mug")
    for index in range(3):
        assert len(searched(catalog)) == 2
        again.add(record(index), image(index))
    again.finish()
    details = catalog.object("mug")
    assert (details.summary.views, details.summary.label, details.summary.note) == (3, "mug", "chipped")
    assert [e.status for e in details.enrollments] == [EnrollmentStatus.COMPLETE, EnrollmentStatus.SUPERSEDED]
    assert len(searched(catalog)) == 3


def test_unfinished_enrollment_is_resumed_on_another_bench(tmp_path: Path, clock: VirtualClock) -> None:
    with Catalog.open(tmp_path, clock=clock) as catalog:
        enrollment = begin(catalog, "mug", 4)
        enrollment.add(record(0), image(0))
        enrollment.add(record(2), image(2))
    with Catalog.open(tmp_path, clock=clock) as catalog:
        with pytest.raises(CatalogError, match="2 of 4") as error:
            begin(catalog, "mug", 4)
        assert Do.CONTINUE_ENROLLMENT(name="mug") in error.value.steps
        unfinished = catalog.resumable("mug")
        assert unfinished is not None
        assert (unfinished.enrollment.present, unfinished.enrollment.missing) == ((0, 2), (1, 3))
        assert catalog.objects()[0].unfinished_views == 2
        elsewhere = Provenance("bench-2", {"servo": {"model": "XM430", "id": 7}})
        enrollment = catalog.resume("mug", provenance=elsewhere)
        with pytest.raises(CatalogError, match="2 of the 4") as error:
            enrollment.finish()
        assert error.value.evidence == {"missing_views": [1, 3]}
        assert len(searched(catalog)) == 0
        assert enrollment.planned_azimuth_deg == tuple(plan(4))
        for index in enrollment.missing():
            enrollment.add(record(index), image(index))
        enrollment.finish()
        assert catalog.resumable("mug") is None
        complete = catalog.object("mug").complete
        assert complete is not None
        benches = [complete.sessions[view.session].provenance.bench for view in complete.views]
    assert benches == ["bench-1", "bench-2", "bench-1", "bench-2"]


@pytest.mark.parametrize(
    ("asked", "known"), [("mug-whit", "mug-white"), ("MUG-WHITE", "mug-white"), ("tea tin", "Tea-Tin")]
)
def test_unknown_name_suggests_similar_names(catalog: Catalog, asked: str, known: str) -> None:
    fill(catalog, known, 1)
    with pytest.raises(ObjectNotFound) as error:
        catalog.object(asked)
    assert repr(known) in error.value.next_step
    fill(catalog, " Ta\u0308sse ", 1)  # names are composed and stripped
    assert catalog.object("T\u00e4sse").summary.views == 1


@pytest.mark.parametrize("name", ["", "  ", "a\nb", "a\x00b", "\ud800", "x" * 101])
def test_begin_rejects_invalid_names_texts_and_plans(catalog: Catalog, name: str) -> None:
    for words, azimuths_deg in ((name, [0.0]), ("mug", []), ("mug", [360.0])):
        with pytest.raises(UsageError):
            catalog.begin(words, planned_azimuth_deg=azimuths_deg, provenance=PROVENANCE)
    with pytest.raises(UsageError, match="label"):
        begin(catalog, "mug", label="\udcff")
    with pytest.raises(UsageError, match="control characters"):
        begin(catalog, "mug", note="\x9b31m")
    assert catalog.objects() == []


FRAME = np.zeros((4, 4, 3), np.uint8)


@pytest.mark.parametrize(
    ("changes", "bad"),
    [
        *(({"index": -1}, FRAME), ({"index": 3}, FRAME), ({"azimuth_deg": 360.0}, FRAME)),
        *(({"azimuth_deg": -1e-9}, FRAME), ({"azimuth_deg": np.nan}, FRAME), ({"encoder_deg": np.inf}, FRAME)),
        *(({"imu_deg": 1.0}, FRAME), ({"imu_sigma_deg": 1.0}, FRAME), ({"imu_deg": 1.0, "imu_sigma_deg": -0.1}, FRAME)),
        *(({"evidence": {"sharpness": np.nan}}, FRAME), ({"evidence": {"frame": np.zeros(3)}}, FRAME)),
        *(({}, np.zeros((4, 4), np.uint8)), ({}, np.zeros((4, 4, 4), np.uint8))),
        *(({}, np.zeros((0, 4, 3), np.uint8)), ({}, np.zeros((4, 4, 3)))),
    ],
)
def test_add_rejects_invalid_views_and_images(catalog: Catalog, changes: dict[str, Any], bad: np.ndarray) -> None:
    enrollment = begin(catalog, "mug")
    with pytest.raises(UsageError):
        enrollment.add(record(0, **changes), bad)
    if not changes:
        with ThreadPoolExecutor(1) as encoding, pytest.raises(UsageError):
            enrollment.add(record(0), bad, encoding.submit(encode, bad))
    assert enrollment.missing() == (0, 1, 2)
    assert not list(catalog.path.rglob("*.png"))


def test_add_accepts_numpy_scalars(catalog: Catalog) -> None:
    numbers = {"azimuth_deg": np.float32(0.5), "captured_ns": np.int64(7), "imu_deg": np.float32(2)}
    evidence = {"locked": np.bool_(True), "gain": np.float32(0.5)}
    enrollment = begin(catalog, "mug", 1)
    enrollment.add(record(0, imu_sigma_deg=np.int8(1), evidence=evidence, **numbers), image(0))
    enrollment.finish()
    stored = catalog.object("mug").views[0]
    assert stored.evidence == {"locked": True, "gain": 0.5}
    assert (stored.azimuth_deg, stored.captured_ns, stored.imu_deg, stored.imu_sigma_deg) == (0.5, 7, 2.0, 1.0)


class CatalogMachine(RuleBasedStateMachine):
    """Enroll, abandon, resume and reopen in any order, and compare with a model of two dictionaries."""

    names = st.sampled_from(["mug", "tin"])

    def __init__(self) -> None:
        super().__init__()
        self.folder = TemporaryDirectory()
        self.clock = VirtualClock()
        self.catalog = Catalog.open(self.folder.name, clock=self.clock)
        self.complete: dict[str, int] = {}
        self.unfinished: dict[str, tuple[int, set[int]]] = {}

    def teardown(self) -> None:
        self.catalog.close()
        self.folder.cleanup()

    @rule(name=names, views=st.integers(1, 3), replace=st.booleans())
    def begin(self, name: str, views: int, replace: bool) -> None:
        if not replace and (name in self.complete or name in self.unfinished):
            with pytest.raises(CatalogError):
                begin(self.catalog, name, views)
            return
        begin(self.catalog, name, views, replace=replace)
        self.unfinished[name] = (views, set())

    @rule(name=names, index=st.integers(0, 2))
    @precondition(lambda self: self.unfinished)
    def add(self, name: str, index: int) -> None:
        if name not in self.unfinished:
            return
        views, present = self.unfinished[name]
        enrollment = self.catalog.resume(name, provenance=PROVENANCE)
        if index >= views or index in present:
            with pytest.raises((UsageError, CatalogError)):
                enrollment.add(record(index), image(index))
            return
        enrollment.add(record(index), image(index))
        present.add(index)

    @rule(name=names, abandon=st.booleans())
    @precondition(lambda self: self.unfinished)
    def end(self, name: str, abandon: bool) -> None:
        if name not in self.unfinished:
            return
        views, present = self.unfinished[name]
        enrollment = self.catalog.resume(name, provenance=PROVENANCE)
        if abandon:
            enrollment.abandon()
        elif len(present) < views:
            with pytest.raises(CatalogError):
                enrollment.finish()
            return
        else:
            enrollment.finish()
            self.complete[name] = views
        del self.unfinished[name]

    @rule()
    def reopen(self) -> None:
        self.catalog.close()
        self.catalog = Catalog.open(self.folder.name, clock=self.clock)

    @invariant()
    def agrees_with_the_dictionaries(self) -> None:
        summaries = {summary.name: summary for summary in self.catalog.objects()}
        assert {name: s.views for name, s in summaries.items() if s.enrolled_utc} == self.complete
        assert {name: s.unfinished_views for name, s in summaries.items() if s.unfinished_views is not None} == {
            name: len(present) for name, (_, present) in self.unfinished.items()
        }
        model = searched(self.catalog)
        counts = np.bincount(model.object_index, minlength=len(model.object_names))
        assert dict(zip(model.object_names, counts.tolist(), strict=True)) == self.complete


TestCatalogMachine = CatalogMachine.TestCase
TestCatalogMachine.settings = settings(examples(6), stateful_step_count=20)


def test_discard_rejects_enrollment_with_views(catalog: Catalog) -> None:
    begin(catalog, "typo").discard()
    assert catalog.objects() == []
    fill(catalog, "mug", 3)
    begin(catalog, "mug", replace=True).discard()
    assert catalog.object("mug").summary.views == 3
    again = begin(catalog, "mug", replace=True)
    again.add(record(0), image(0))
    with pytest.raises(CatalogError, match="has views"):
        again.discard()
