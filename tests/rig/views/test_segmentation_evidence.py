"""The summary of segmentation evidence, and evidence that older versions stored."""

import pytest

from hbr.segmentation import IssueCode
from rig.views.segmentation_evidence import _TEXT, SegmentationSummary, upgrade_evidence

OLD = [
    (
        "the reference: it has 320 x 240 pixels, the frame 640 x 480",
        {"code": "empty-table-size", "table_px": [320, 240], "frame_px": [640, 480]},
    ),
    (
        "the reference: only 42% of the frame's border looks like it",
        {"code": "empty-table-differs", "agreement": 0.417},
    ),
    ("the backdrop is too dark or overexposed to tell the light's colour", {"code": "backdrop-exposure"}),
    ("the backdrop has several colours; none is sure to be grey", {"code": "backdrop-several-colours"}),
    ("the backdrop is too colourful to be taken for grey", {"code": "backdrop-colourful"}),
    ("the backdrop is too dark or too bright to take the exposure from", {"code": "backdrop-level"}),
    ("the silhouette: the background is not plain enough", {"code": "background-not-plain"}),
    ("the silhouette: the background is not plain enough; guessed from colours", {"code": "background-not-plain"}),
    ("the guess: no part of the frame stands out", {"code": "no-guess"}),
    ("the silhouette: nothing differs from the background", {"code": "no-difference"}),
    ("the grey patch: it is not even", {"code": "grey-patch-uneven"}),
    ("the grey patch: it is overexposed or too dark", {"code": "grey-patch-exposure"}),
    ("a sentence of another program", {"code": "other", "text": "a sentence of another program"}),
]


def old(*refused: str, box: bool = True, agreement: float | None = None) -> dict[str, object]:
    return {
        "box_px": [1, 2, 30, 40] if box else None,
        "gains_bgr": [1.0, 1.1, 0.9],
        "agreement": agreement,
        "refused": list(refused),
    }


@pytest.mark.parametrize(("sentence", "issue"), OLD)
def test_old_sentence_becomes_an_issue_code(sentence, issue):
    assert upgrade_evidence(old(sentence, agreement=0.417))["issues"] == [issue]


def test_every_issue_code_has_an_old_sentence_and_a_text():
    later = {IssueCode.NO_OBJECT}
    assert {issue["code"] for _, issue in OLD} | later == set(IssueCode) == set(_TEXT)


def test_agreement_comes_from_the_percentage_if_it_was_not_stored():
    evidence = upgrade_evidence({"refused": [OLD[1][0]]})
    assert evidence["issues"] == [{"code": "empty-table-differs", "agreement": 0.42}]


@pytest.mark.parametrize(
    ("evidence", "method"),
    [
        (old(agreement=1.0), "empty-table"),
        (old(OLD[3][0], agreement=0.667), "empty-table"),
        (old(), "plain-background"),
        (old(OLD[1][0], agreement=0.417), "plain-background"),
        (old(OLD[1][0], OLD[7][0], agreement=0.417), "guess"),
        (old(OLD[9][0], box=False), "none"),
        (old(OLD[7][0], OLD[8][0], box=False), "none"),
    ],
)
def test_method_of_old_evidence_follows_from_box_sentences_and_agreement(evidence, method):
    upgraded = upgrade_evidence(evidence)
    assert upgraded["method"] == method
    assert list(upgraded) == ["method", "box_px", "gains_bgr", "agreement", "issues"]
    assert upgrade_evidence(upgraded) == upgraded


@pytest.mark.parametrize("foreign", [{}, {"quality": 3}, {"refused": None}, {"refused": "no object"}])
def test_evidence_of_other_programs_is_kept(foreign):
    upgraded = upgrade_evidence(foreign)
    assert all(upgraded[name] == value for name, value in foreign.items() if name != "refused")
    assert [issue["text"] for issue in upgraded.get("issues", [])] == (["no object"] if foreign.get("refused") else [])


def test_summary_counts_views_and_names_the_issues():
    views = [
        upgrade_evidence(old(agreement=1.0)),
        upgrade_evidence(old(OLD[1][0], OLD[7][0], agreement=0.3)),
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
