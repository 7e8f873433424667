"""Records store the parts of an event stream that a report needs: thumbnails, evidence, and the truth."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hbr import Outcome
from rig.events.events import Accepted, Moved, Rejected, Started
from rig.report import Correctness, EnrollmentRecord, IdentificationRecord, Truth
from rig.report.records import FRAME, TILE
from rig.report.report import enrollment_items, totals
from rig.views.capture import RejectReason
from tests.rig.report.report_samples import enrolled, enrolling, evidence, identified, identifying, moved


def ambiguous(truth: Truth) -> IdentificationRecord:
    """Return a search for one of two objects; as always, the answer's name is that of the leading candidate."""
    record = identified("mug-white", (90.0,), truth=truth)
    assert record.answer is not None
    record.answer = replace(record.answer, outcome=Outcome.AMBIGUOUS, possible=("mug-white", "mug-star"))
    return record


def by_label(pairs: list) -> dict[str, str]:
    return {item.label: item.value for item in pairs}


class TestEnrollment:
    def test_views_are_in_order_with_their_retakes(self) -> None:
        record = enrolled("lamp", 8, retaken=(2, 5))
        assert record.name == "lamp"
        assert [view.index for view in record.views] == list(range(8))
        assert [bool(view.rejected) for view in record.views] == [k in (2, 5) for k in range(8)]
        assert record.views[2].rejected == ("blurred (sharpness 2.0 < 3)",)
        assert record.views[3].move == moved(3, 135.0, 45.0)
        assert record.retakes == 2
        assert record.result is not None

    def test_record_does_not_store_full_images(self) -> None:
        record = enrolled(views=4, shape=(480, 640))
        for view in record.views:
            assert view.picture_bgr.shape == (TILE[1], TILE[0], 3)
            assert view.picture_bgr.base is None

    def test_thumbnail_shows_the_region(self) -> None:
        image = np.zeros((480, 640, 3), dtype=np.uint8)
        image[:, 80:560] = 200
        record = EnrollmentRecord(region=(80, 0, 480, 480))
        record.add(Accepted(0, 0.0, evidence(), image))
        assert (record.views[0].picture_bgr == 200).all()

    def test_interrupted_enrollment_has_no_result(self) -> None:
        record = EnrollmentRecord()
        for event in list(enrolling(views=8))[:-5]:
            record.add(event)
        assert record.result is None
        assert 0 < len(record.views) < record.planned == 8
        assert by_label(totals([record, enrolled()], []))["objects enrolled"] == "1"

    def test_summary_numbers_come_from_the_evidence(self) -> None:
        record = enrolled(views=8, retaken=(1,))
        found = {item.label: (item.value, item.note) for item in enrollment_items(record)}
        assert found["views"] == ("8", "of 8 planned")
        assert found["retakes"] == ("1", "blurred (sharpness 2.0 < 3)")
        assert found["bench time"][0] == "12 s"


class TestIdentification:
    def test_steps_are_the_measured_rotations(self) -> None:
        rotations = (90.0, 47.3, -120.5)
        steps = identified(rotations_deg=rotations).steps
        assert [step.rotation_deg for step in steps] == pytest.approx(list(rotations))
        assert [step.number for step in steps] == [2, 3, 4]

    @pytest.mark.parametrize("rotation_deg", [-270.0, 250.0, 359.0])
    def test_steps_count_whole_revolutions(self, rotation_deg: float) -> None:
        assert identified(rotations_deg=(rotation_deg,)).steps[0].rotation_deg == pytest.approx(rotation_deg)

    def test_step_ends_at_the_azimuth_if_the_encoder_is_wrong(self) -> None:
        record = IdentificationRecord()
        for event in identifying(rotations_deg=(90.0,)):
            if isinstance(event, Moved) and event.index == 1:
                event = replace(event, rotation_encoder_deg=-120.0, rotation_imu_deg=-90.0, agrees=False)
            record.add(event)
        assert record.steps[0].rotation_deg == pytest.approx(90.0)

    def test_thumbnails_of_a_search_are_small(self) -> None:
        assert {view.picture_bgr.shape for view in identified(shape=(480, 640)).views} == {(FRAME[1], FRAME[0], 3)}

    @pytest.mark.parametrize(
        ("answer", "truth", "correctness"),
        [
            ("mug-white", Truth("mug-white"), Correctness.RIGHT),
            ("mug-white", Truth("mug-star"), Correctness.WRONG),
            ("mug-white", Truth(None), Correctness.WRONG),
            (None, Truth("mug-white"), Correctness.WRONG),
            (None, Truth(None), Correctness.RIGHT),
            ("mug-white", None, None),
        ],
    )
    def test_answer_is_right_if_it_equals_the_truth(
        self, answer: str | None, truth: Truth | None, correctness: Correctness | None
    ) -> None:
        assert identified(answer, truth=truth).correctness is correctness

    @pytest.mark.parametrize("truth", [Truth("mug-white", 30.0), Truth("mug-star", 30.0), Truth(None)])
    def test_ambiguous_answer_is_not_found_whatever_its_first_name(self, truth: Truth) -> None:
        record = ambiguous(truth)
        assert record.correctness is Correctness.AMBIGUOUS
        assert record.pose_error_deg is None

    def test_search_without_answer_is_neither_correct_nor_wrong(self) -> None:
        record = IdentificationRecord(truth=Truth("mug-white", 10.0))
        record.add(Started("identify", None, 8, {}))
        assert record.correctness is None
        assert record.pose_error_deg is None
        assert record.steps == []

    @given(yaw=st.floats(0, 360), error=st.floats(-179, 179))
    def test_pose_error_is_the_smaller_angle(self, yaw: float, error: float) -> None:
        record = identified(yaw_deg=yaw, truth=Truth("mug-white", yaw + error))
        assert record.pose_error_deg == pytest.approx(abs(error), abs=1e-6)

    @given(fold=st.integers(2, 12), revolutions=st.integers(-5, 5), error=st.floats(-0.49, 0.49))
    def test_pose_error_is_modulo_the_symmetry(self, fold: int, revolutions: int, error: float) -> None:
        period = 360 / fold
        record = identified(yaw_deg=100.0, truth=Truth("mug-white", 100 + (revolutions + error) * period, period))
        assert record.pose_error_deg == pytest.approx(abs(error) * period, abs=1e-6)

    @pytest.mark.parametrize(
        ("answer", "truth"),
        [
            ("mug-white", Truth("mug-white")),
            ("mug-white", Truth("mug-white", 10.0, 0.0)),
            ("mug-star", Truth("mug-white", 10.0)),
            (None, Truth(None, 10.0)),
        ],
    )
    def test_pose_error_is_undefined_without_a_pose(self, answer: str | None, truth: Truth) -> None:
        assert identified(answer, truth=truth).pose_error_deg is None

    def test_totals_count_known_and_unknown_objects_separately(self) -> None:
        records = [
            identified("mug-white", (90.0,), yaw_deg=10.0, truth=Truth("mug-white", 13.0)),
            identified("mug-white", (90.0, 30.0), yaw_deg=10.0, truth=Truth("mug-white", 9.0)),
            identified("mug-white", (90.0,), truth=Truth("teapot", 0.0)),
            identified(None, (90.0,), truth=Truth(None)),
            identified("lamp", (90.0,), truth=Truth(None)),
            ambiguous(Truth("mug-white", 30.0)),
        ]
        found = by_label(totals([enrolled(), enrolled()], records))
        assert found == {
            "objects enrolled": "2",
            "found": "2/4",
            "ambiguous": "1/4",
            "unknown objects recognised": "1/2",
            "views to an answer": "2.2",
            "rotation": "95°",
            "pose error": "2.0°",
        }

    def test_single_answer_without_truth_shows_its_numbers(self) -> None:
        found = by_label(totals([], [identified(None)]))
        assert found["answer"] == "unknown"
        assert found["views"] == "4"


def test_rejected_frames_belong_to_the_next_view() -> None:
    record = IdentificationRecord()
    record.add(Rejected(0, 1, (RejectReason.TOO_DARK, RejectReason.BLURRED), evidence()))
    record.add(Rejected(0, 2, (RejectReason.BLURRED,), evidence()))
    record.add(Accepted(0, 0.0, evidence(), np.zeros((9, 9, 3), np.uint8)))
    record.add(Accepted(1, 0.0, evidence(), np.zeros((9, 9, 3), np.uint8)))
    assert record.views[0].rejected == (
        "too dark (mean level 90.0, 0 % black), blurred (sharpness 100.0)",
        "blurred (sharpness 100.0)",
    )
    assert record.views[1].rejected == ()
