"""The segmentation evidence that is stored with views: its summary in words, and evidence of older versions."""

import re
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Final

from hbr.segmentation import MIN_AGREEMENT, Issue, IssueCode, Method

_TEXT: Final = {
    IssueCode.TABLE_SIZE: "the empty-table image has another size than the frames",
    IssueCode.TABLE_DIFFERS: "the surroundings do not look like the empty-table image",
    IssueCode.BACKDROP_EXPOSURE: "the backdrop is too dark or overexposed to measure its colour",
    IssueCode.BACKDROP_COLOURS: "the backdrop has several colours, so none can be taken for grey",
    IssueCode.BACKDROP_COLOURFUL: "the backdrop is not grey",
    IssueCode.BACKDROP_LEVEL: "the backdrop is too dark or too bright to correct the exposure",
    IssueCode.BACKGROUND_NOT_PLAIN: "the background is not plain",
    IssueCode.NO_GUESS: "no part of the frame stands out",
    IssueCode.NO_OBJECT: "no object was found while the table rotated",
    IssueCode.NO_DIFFERENCE: "nothing differs from the background",
    IssueCode.PATCH_UNEVEN: "the grey patch is uneven",
    IssueCode.PATCH_EXPOSURE: "the grey patch is overexposed or too dark",
    IssueCode.OTHER: "another issue",
}


@dataclass(frozen=True, slots=True)
class SegmentationSummary:
    """Summary of the segmentation of several views.

    Attributes
    ----------
    views
        Number of views with segmentation evidence.
    found, guessed
        Numbers of views in which the object was found reliably, and in which it was guessed.
    corrected
        Number of views whose illumination was corrected.
    issues
        Number of views for each `hbr.segmentation.IssueCode`, the most frequent first.
    """

    views: int
    found: int
    guessed: int
    corrected: int
    issues: Mapping[str, int]

    @classmethod
    def of(cls, evidence: Iterable[Mapping[str, Any] | None]) -> "SegmentationSummary":
        """Summarise the stored evidence of views; None is a view without segmentation."""
        views = [one for one in evidence if one is not None]
        boxes = [one for one in views if one.get("box_px") is not None]
        guessed = sum(one.get("method") == Method.GUESS for one in boxes)
        codes = Counter(code for one in views for code in {issue["code"]: None for issue in one.get("issues", ())})
        return cls(
            views=len(views),
            found=len(boxes) - guessed,
            guessed=guessed,
            corrected=sum(one.get("gains_bgr") is not None for one in views),
            issues=dict(codes.most_common()),
        )

    @property
    def text(self) -> str:
        """The summary in one line; empty if no view has segmentation evidence."""
        if not self.views:
            return ""
        guessed = f", guessed in {self.guessed}" if self.guessed else ""
        known = set(IssueCode)
        issues = "".join(
            f"; {_TEXT[IssueCode(code)] if code in known else code} ({count})" for code, count in self.issues.items()
        )
        return (
            f"object found in {self.found} of {self.views} views{guessed}, illumination corrected in {self.corrected}"
            f"{issues}"
        )


def check_evidence(evidence: object) -> None:
    """Raise TypeError if a JSON value is not segmentation evidence, on which a reader would fail."""
    if not isinstance(evidence, Mapping) or not isinstance(evidence.get("issues", []), list):
        raise TypeError("the evidence of a segmentation that is not one")
    for issue in evidence.get("issues", []):
        if not isinstance(issue, Mapping) or not isinstance(issue.get("code"), str):
            raise TypeError("the evidence of a segmentation with an issue without a code")
    for name, length in (("box_px", 4), ("gains_bgr", 3)):
        numbers = evidence.get(name)
        if numbers is not None and not (
            isinstance(numbers, list | tuple)
            and len(numbers) == length
            and all(isinstance(number, int | float) for number in numbers)
        ):
            raise TypeError(f"the evidence of a segmentation whose {name} is not {length} numbers")


_OLD: Final = {
    re.compile(pattern): code
    for pattern, code in {
        r"the reference: it has (\d+) x (\d+) pixels, the frame (\d+) x (\d+)": IssueCode.TABLE_SIZE,
        r"the reference: only (\d+)% of the frame's border looks like it": IssueCode.TABLE_DIFFERS,
        r"the backdrop is too dark or overexposed to tell the light's colour": IssueCode.BACKDROP_EXPOSURE,
        r"the backdrop has several colours; none is sure to be grey": IssueCode.BACKDROP_COLOURS,
        r"the backdrop is too colourful to be taken for grey": IssueCode.BACKDROP_COLOURFUL,
        r"the backdrop is too dark or too bright to take the exposure from": IssueCode.BACKDROP_LEVEL,
        r"the silhouette: the background is not plain enough(; guessed from colours)?": IssueCode.BACKGROUND_NOT_PLAIN,
        r"the guess: no part of the frame stands out": IssueCode.NO_GUESS,
        r"the silhouette: nothing differs from the background": IssueCode.NO_DIFFERENCE,
        r"the grey patch: it is not even": IssueCode.PATCH_UNEVEN,
        r"the grey patch: it is overexposed or too dark": IssueCode.PATCH_EXPOSURE,
    }.items()
}
"""Sentences of version 0.1, which stored them under ``refused``."""


def upgrade_evidence(evidence: Mapping[str, Any]) -> dict[str, Any]:
    """Return stored segmentation evidence with ``method`` and ``issues``, from any version of the program.

    Version 0.1 stored English sentences under ``refused``. Unknown sentences become issues of code "other". The method
    was not stored: a box that was not guessed comes from the empty-table image if that agreed.
    """
    if "refused" not in evidence:
        return dict(evidence)
    refused = evidence["refused"] or []
    sentences = [str(one) for one in ([refused] if isinstance(refused, str) else refused)]
    agreement = evidence.get("agreement")
    issues = [_issue(sentence, agreement) for sentence in sentences]
    if evidence.get("box_px") is None:
        method = Method.NONE
    elif any(issue.code == IssueCode.BACKGROUND_NOT_PLAIN for issue in issues):
        method = Method.GUESS
    elif agreement is not None and agreement >= MIN_AGREEMENT:
        method = Method.EMPTY_TABLE
    else:
        method = Method.PLAIN_BACKGROUND
    rest = {name: value for name, value in evidence.items() if name != "refused"}
    return {"method": method.value, **rest, "issues": [issue.as_json() for issue in issues]}


def _issue(sentence: str, agreement: float | None) -> Issue:
    for pattern, code in _OLD.items():
        if found := pattern.fullmatch(sentence):
            match code:
                case IssueCode.TABLE_SIZE:
                    sizes = [int(group) for group in found.groups()]
                    return Issue(code, {"table_px": sizes[:2], "frame_px": sizes[2:]})
                case IssueCode.TABLE_DIFFERS:
                    share = int(found[1]) / 100 if agreement is None else agreement
                    return Issue(code, {"agreement": share})
                case _:
                    return Issue(code)
    return Issue(IssueCode.OTHER, {"text": sentence})
