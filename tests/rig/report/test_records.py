"""A record has thumbnails instead of images, and compares an answer with the truth."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.events.events import Accepted, Rejected, Started
from rig.report import TILE, Correctness, Meta, Record, Truth, render_report
from rig.report.records import FRAME
from rig.report.report import totals
from rig.views.capture import RejectReason
from tests.rig.report.report_samples import ambiguous, enrolled, evidence, identified


def by_label(pairs: list) -> dict[str, str]:
    return {item.label: item.value for item in pairs}


def test_record_has_thumbnails_of_the_region_instead_of_images() -> None:
    image = np.zeros((480, 640, 3), dtype=np.uint8)
    image[:, 80:560] = 200
    for size in (TILE, FRAME):
        record = Record(size, region=(80, 0, 480, 480))
        record.add(Accepted(0, 0.0, evidence(), image))
        picture = record.views[0].image_bgr
        assert picture.shape == (size[1], size[0], 3)
        assert picture.base is None
        assert (picture == 200).all()


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
    answer: str | None, truth: Truth | None, correctness: Correctness | None
) -> None:
    assert identified(answer, truth=truth).correctness is correctness


@pytest.mark.parametrize("truth", [Truth("mug-white", 30.0), Truth("mug-star", 30.0), Truth(None)])
def test_ambiguous_answer_is_not_found_whatever_its_first_name(truth: Truth) -> None:
    record = ambiguous(truth)
    assert record.correctness is Correctness.AMBIGUOUS
    assert record.pose_error_deg is None


def test_search_without_answer_is_neither_correct_nor_wrong() -> None:
    record = Record(truth=Truth("mug-white", 10.0))
    record.add(Started("identify", None, 8, {}))
    assert record.correctness is None
    assert record.pose_error_deg is None


@given(fold=st.integers(1, 12), revolutions=st.integers(-5, 5), error=st.floats(-0.49, 0.49))
def test_pose_error_is_the_smaller_angle_modulo_the_symmetry(fold: int, revolutions: int, error: float) -> None:
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
def test_pose_error_is_undefined_without_a_pose(answer: str | None, truth: Truth) -> None:
    assert identified(answer, truth=truth).pose_error_deg is None


def test_totals_count_known_and_unknown_objects_separately() -> None:
    records = [
        identified("mug-white", (90.0,), yaw_deg=10.0, truth=Truth("mug-white", 13.0)),
        identified("mug-white", (90.0, 30.0), yaw_deg=10.0, truth=Truth("mug-white", 9.0)),
        identified("mug-white", (90.0,), truth=Truth("teapot", 0.0)),
        identified(None, (90.0,), truth=Truth(None)),
        identified("lamp", (90.0,), truth=Truth(None)),
        ambiguous(Truth("mug-white", 30.0)),
    ]
    assert by_label(totals([enrolled(), enrolled()], records)) == {
        "objects enrolled": "2",
        "found": "2/4",
        "ambiguous": "1/4",
        "unknown objects recognised": "1/2",
        "views to an answer": "2.2",
        "rotation": "95°",
        "pose error": "2.0°",
    }
    alone = by_label(totals([], [identified(None)]))
    assert (alone["answer"], alone["views"]) == ("unknown", "4")


def test_rejected_frames_are_named_before_their_view() -> None:
    record = Record()
    record.add(Rejected(0, 1, (RejectReason.TOO_DARK, RejectReason.BLURRED), evidence()))
    record.add(Rejected(0, 2, (RejectReason.BLURRED,), evidence()))
    for index in range(2):
        record.add(Accepted(index, 0.0, evidence(), np.zeros((9, 9, 3), np.uint8)))
    page = render_report("t", "s", [], [record], meta=Meta())
    words = "too dark (mean level 90.0, 0 % black), blurred (sharpness 100.0); blurred (sharpness 100.0)"
    assert page.count("Frames rejected before this view:") == 1
    assert f"Frames rejected before this view: {words}." in page
