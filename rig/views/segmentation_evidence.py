"""The segmentation evidence that is stored with views: its check, and its summary in words."""

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Final

from hbr.segmentation import IssueCode, Method

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
