"""Description of views by several descriptors, with and without an empty-table image."""

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

import hbr
from hbr.segmentation import IssueCode
from rig.config import ViewConfig
from rig.core.errors import UsageError
from rig.views.description import (
    _TEXT,
    BENCH_DESCRIPTOR,
    DESCRIPTORS,
    PAPER_DESCRIPTOR,
    EnrollmentDescriber,
    SearchDescriber,
    ViewSegmenter,
    segmentation_summary,
    segmentation_words,
)

WHOLE = ViewConfig(roi=None)


def _table(height: int = 120, width: int = 160) -> NDArray[np.uint8]:
    """Return an empty table with a coarse pattern."""
    rng = np.random.default_rng(7)
    coarse = rng.integers(60, 200, (height // 10, width // 10, 3), np.uint8)
    return cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC).astype(np.uint8)


def _with_object(table: NDArray[np.uint8], left: int = 60, gain: float = 1.0) -> NDArray[np.uint8]:
    image = table.copy()
    image[40:90, left : left + 40] = (30, 30, 220)
    image[55:70, left + 10 : left + 25] = (220, 220, 40)
    return np.clip(image * gain, 0, 255).astype(np.uint8)


def test_paper_descriptor_describes_the_whole_region() -> None:
    frame = _with_object(_table())
    describer = EnrollmentDescriber(ViewConfig(roi=(20, 0, 120, 120)), DESCRIPTORS, _table())
    described = describer.describe(describer.learn(frame), frame)
    assert tuple(described.levels) == DESCRIPTORS
    assert np.array_equal(described.levels[PAPER_DESCRIPTOR], hbr.describe(frame[:, 20:140]))


def test_object_is_found_in_the_region_of_interest() -> None:
    table = _table()
    described = ViewSegmenter(ViewConfig(roi=(20, 0, 120, 120)), empty_table=table)(_with_object(table))
    assert described.segmentation is not None
    x, y, width, height = described.segmentation["box_px"]
    assert np.allclose((x, y, x + width, y + height), (40, 40, 80, 90), atol=4)
    assert described.segmentation["agreement"] > 0.9


def test_position_and_illumination_change_edges_and_colours_little() -> None:
    table = _table()
    kind = hbr.descriptor("edges=0.5,colours=0.5")  # CEDD depends more on the illumination
    images = _with_object(table), _with_object(table, left=72, gain=0.8), _with_object(table)[::-1, ::-1].copy()
    before, after, other = (kind.describe(ViewSegmenter(WHOLE, table).segment(image)) for image in images)
    assert float(kind.similarity(before[None], after[None])[0, 0]) > 0.95
    assert float(kind.similarity(before[None], other[None])[0, 0]) < 0.9


def test_descriptors_of_the_whole_image_need_no_segmentation() -> None:
    described = SearchDescriber(WHOLE, PAPER_DESCRIPTOR)(_with_object(_table())[:12, :15])
    assert described.segmentation is None


def test_search_in_motion_learns_the_background_and_leaves_earlier_views_alone() -> None:
    table = _table()
    frames = [_with_object(table, left) for left in (20, 60, 100)]
    at_rest, moving = (SearchDescriber(WHOLE, BENCH_DESCRIPTOR, revise=revises) for revises in (True, False))
    views = [(at_rest(frame), moving(frame)) for frame in frames]
    assert [view.earlier for _, view in views] == [None] * 3
    for view, other in views:  # the newest view is segmented with the same background; at rest, it is guessed, too
        rows = {row.tobytes() for row in view.levels[BENCH_DESCRIPTOR]}
        assert {row.tobytes() for row in other.levels[BENCH_DESCRIPTOR]} <= rows
    assert views[-1][0].earlier is not None
    assert len(views[-1][0].earlier) == 2


def test_empty_table_image_of_another_size_is_not_used_and_reported() -> None:
    frame = _with_object(np.full((120, 160, 3), 128, np.uint8))
    without, found = (ViewSegmenter(WHOLE, table).segment(frame) for table in (None, _table(240, 320)))
    issue = found.evidence()["issues"][0]
    assert issue == {"code": "empty-table-size", "table_px": [320, 240], "frame_px": [160, 120]}
    levels, expected = map(hbr.descriptor(BENCH_DESCRIPTOR).describe, (found, without))
    assert np.array_equal(levels, expected)


def test_region_outside_the_frame_is_rejected() -> None:
    with pytest.raises(UsageError, match="does not lie within"):
        ViewSegmenter(ViewConfig(roi=(100, 0, 100, 100)))(_table())


def test_three_frames_in_a_row_that_differ_are_reported_once() -> None:
    table = _table()
    good, bad = _with_object(table), _with_object(table[::-1, ::-1].copy())
    describe = ViewSegmenter(WHOLE, table)
    problems = [describe(frame).table_problem for frame in (bad, bad, good, bad, bad, bad, bad)]
    assert [problem is not None for problem in problems] == [False] * 5 + [True, False]
    assert problems[5] is not None
    assert problems[5].parameters["frames"] == 3
    assert problems[5].parameters["agreement"] < 0.65


def test_enrolled_view_keeps_its_silhouette() -> None:
    table = _table()
    frames = [_with_object(table, left) for left in (20, 60, 100)]
    together = EnrollmentDescriber(WHOLE, (BENCH_DESCRIPTOR,))
    for frame in frames:
        together.learn(frame)
    enrolled = together.describe(1, frames[1])
    assert enrolled.segmentation is not None
    assert enrolled.segmentation["together"] == 3
    cut = ViewSegmenter(WHOLE).segment(frames[1], 0.0, enrolled.segmentation)
    levels = hbr.descriptor(BENCH_DESCRIPTOR).describe(cut)
    assert np.array_equal(levels, enrolled.levels[BENCH_DESCRIPTOR])


def test_every_issue_code_has_a_text():
    assert set(IssueCode) == set(_TEXT)


def test_summary_counts_views_and_names_the_issues():
    found = {"box_px": [1, 2, 30, 40], "gains_bgr": [1.0, 1.1, 0.9]}
    issues = [{"code": "empty-table-differs", "agreement": 0.3}, {"code": "background-not-plain"}]
    views = [
        {**found, "method": "empty-table", "issues": []},
        {**found, "method": "guess", "issues": issues},
        {"box_px": None, "gains_bgr": None, "method": "none", "issues": [{"code": "newer-issue"}]},
        None,
    ]
    summary = segmentation_summary(views)
    counted = {"empty-table-differs": 1, "background-not-plain": 1, "newer-issue": 1}
    assert summary == {"views": 3, "found": 1, "guessed": 1, "corrected": 2, "issues": counted}
    assert segmentation_words(summary) == (
        "object found in 1 of 3 views, guessed in 1, illumination corrected in 2; the surroundings do not look like "
        "the empty-table image (1); the background is not plain (1); newer-issue (1)"
    )
    assert segmentation_words(segmentation_summary([None])) == ""
