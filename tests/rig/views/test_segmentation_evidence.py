"""The summary of segmentation evidence."""

from hbr.segmentation import IssueCode
from rig.views.segmentation_evidence import _TEXT, SegmentationSummary


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
    summary = SegmentationSummary.of(views)
    assert (summary.views, summary.found, summary.guessed, summary.corrected) == (3, 1, 1, 2)
    assert summary.issues == {"empty-table-differs": 1, "background-not-plain": 1, "newer-issue": 1}
    assert summary.text == (
        "object found in 1 of 3 views, guessed in 1, illumination corrected in 2; the surroundings do not look like "
        "the empty-table image (1); the background is not plain (1); newer-issue (1)"
    )
    assert SegmentationSummary.of([None]).text == ""
