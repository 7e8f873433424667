"""Description of views: the levels of several descriptors, and the evidence of the segmentation with its summary.

Decision: docs/decisions/0010.
"""

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final, TypeVar

import numpy as np
from numpy.typing import NDArray

import hbr
from hbr.descriptors import best
from hbr.descriptors.registry import FULL, LIGHT
from hbr.descriptors.together import LearnedBackground
from hbr.segmentation import MIN_AGREEMENT, BoxMethod, Issue, IssueCode
from hbr.segmentation.background import SegmentedFrame
from hbr.segmentation.segment import evidence_together, stored_segmentation
from rig.config import ViewConfig
from rig.core.errors import UsageError
from rig.views.table_problems import IN_A_ROW, TableProblem, surroundings_problem
from rig.views.table_sheet import TableSheet, table_image

Value = TypeVar("Value", bound=np.generic)
PAPER_DESCRIPTOR: Final = "cedd"
"""The paper's descriptor. It describes the whole region of interest, with the background."""
BENCH_DESCRIPTOR: Final = best()
"""The rig's own descriptor, with the network if its weights are installed. It describes only the object, with corrected
illumination."""
DENSE_DESCRIPTORS: Final = (LIGHT, FULL)
"""The descriptors of the dense search: a run may come from a computer without the network."""
DESCRIPTORS: Final = (PAPER_DESCRIPTOR, BENCH_DESCRIPTOR)
"""The descriptors of every enrolled view."""

_TEXT: Final[Mapping[str, str]] = {
    IssueCode.TABLE_SIZE: "the empty-table image has another size than the frames",
    IssueCode.TABLE_AZIMUTH: "the camera moves, and no empty-table image was taken near the azimuth",
    IssueCode.TABLE_DIFFERS: "the surroundings do not look like the empty-table image",
    IssueCode.BACKDROP_EXPOSURE: "the backdrop is too dark or overexposed to measure its colour",
    IssueCode.BACKDROP_COLOURS: "the backdrop has several colours, so none can be taken for grey",
    IssueCode.BACKDROP_COLOURFUL: "the backdrop is not grey",
    IssueCode.BACKDROP_LEVEL: "the backdrop is too dark or too bright to correct the exposure",
    IssueCode.BACKGROUND_NOT_PLAIN: "the background is not plain",
    IssueCode.DOUBTFUL_OUTLINE: "the platter or the backdrop may be inside the box",
    IssueCode.NO_GUESS: "no part of the frame stands out",
    IssueCode.NO_OBJECT: "no object was found while the table rotated",
    IssueCode.NO_DIFFERENCE: "nothing differs from the background",
}


@dataclass(frozen=True, slots=True, eq=False)
class DescribedView:
    """The description of a view."""

    levels: Mapping[str, NDArray[np.uint8]]
    """Levels of each descriptor by its name, uint8 (length,); in a search a row for each segmentation."""
    segmentation: dict[str, Any] | None
    """`hbr.Segmentation.evidence` as JSON values; None if no segmentation was made."""
    table_problem: TableProblem | None = None
    """Set for the view with which it is certain that the bench no longer looks like its empty-table image."""
    earlier: tuple[NDArray[np.uint8], ...] | None = None
    """In a search: the levels of all earlier views, uint8 (k, length) each, which were segmented again; a row
    for each segmentation."""
    reliable: bool = True
    """In a search: whether the view was segmented by a known background (`hbr.ViewsTogether.reliable`)."""
    other_bench: bool = False
    """In a search: whether the bench is certainly not that of the enrollment."""


def within(image_bgr: NDArray[Value], region: tuple[int, int, int, int] | None) -> NDArray[Value]:
    """Return the view of a region of an image (H, W, ...), or of a mask; the whole image if the region is None.

    Raises `UsageError`: the region does not lie within the image.
    """
    if region is None:
        return image_bgr
    x, y, width, height = region
    if min(x, y) < 0 or min(width, height) < 1 or x + width > image_bgr.shape[1] or y + height > image_bgr.shape[0]:
        raise UsageError(
            f"The region {list(region)} does not lie within an image of {image_bgr.shape[1]}x{image_bgr.shape[0]}.",
            next_step="Give a region within the images: x, y, width, height in pixels.",
        )
    return image_bgr[y : y + height, x : x + width]


class ViewSegmenter:
    """Segments views of one bench.

    The empty-table images are those of a `TableSheet`, of the same size as the views; the one for the azimuth of a view
    counts.
    """

    def __init__(self, config: ViewConfig, empty_table: NDArray[np.uint8] | None = None) -> None:
        self.region = config.roi
        self.empty_table = empty_table
        self._sheet: TableSheet | None = None
        self._backgrounds: dict[int, hbr.Background] = {}
        self._low: list[float] = []
        self._reported = False

    def __call__(self, image_bgr: NDArray[np.uint8], azimuth_deg: float = 0.0) -> DescribedView:
        """Segment a frame, uint8 (H, W, 3), that the camera took at an azimuth.

        Raises `UsageError`: the region does not lie within the frame. `ValueError`: the region is too small for a
        segmentation.
        """
        found = self.segment(image_bgr, azimuth_deg)
        return DescribedView({}, found.evidence(), self._table_problem(found.agreement))

    def segment(
        self, image_bgr: NDArray[np.uint8], azimuth_deg: float = 0.0, stored: Mapping[str, Any] | None = None
    ) -> hbr.Segmentation:
        """Return the segmentation of the region of interest in a frame, uint8 (H, W, 3).

        ``stored`` is the evidence of an enrolled view, which keeps its silhouette (`hbr.segmentation.segment`).

        Raises `UsageError`, `ValueError`: as for a call, or the stored evidence is damaged.
        """
        background, issues = self._prepared_table(image_bgr, azimuth_deg)
        found = stored_segmentation(within(image_bgr, self.region), stored, empty_table=background)
        return replace(found, issues=(*issues, *(one for one in found.issues if one not in issues)))

    def _table_problem(self, agreement: float | None) -> TableProblem | None:
        """Return a problem after `IN_A_ROW` frames that differ from the empty-table image, but only once."""
        if agreement is None or self._reported:
            return None
        self._low = [*self._low, agreement] if agreement < MIN_AGREEMENT else []
        if len(self._low) < IN_A_ROW:
            return None
        self._reported = True
        return surroundings_problem(max(self._low))

    def rotation_deg(self, azimuth_deg: float, rotation_deg: float) -> float:
        """Return the rotation from the azimuth of the last view that ends where an empty-table image was taken."""
        return rotation_deg if self._sheet is None else self._sheet.rotation_deg(azimuth_deg, rotation_deg)

    def _prepared_table(
        self, image_bgr: NDArray[np.uint8], azimuth_deg: float
    ) -> tuple[hbr.Background | None, tuple[Issue, ...]]:
        """Return the empty-table image of the region at an azimuth, or the issue why there is none."""
        if self.empty_table is None:
            return None, ()
        self._sheet = sheet = TableSheet.of(self.empty_table, *image_bgr.shape[:2])
        if sheet is None:
            sizes = {"table_px": list(self.empty_table.shape[1::-1]), "frame_px": list(image_bgr.shape[1::-1])}
            return None, (Issue(IssueCode.TABLE_SIZE, sizes),)
        table_bgr, (number, away_deg) = sheet.at(azimuth_deg), sheet.nearest(azimuth_deg)
        if table_bgr is None:
            return None, (Issue(IssueCode.TABLE_AZIMUTH, {"away_deg": round(away_deg, 1)}),)
        if number not in self._backgrounds:
            self._backgrounds[number] = hbr.Background(within(table_bgr, self.region))
        return self._backgrounds[number], ()


class EnrollmentDescriber(ViewSegmenter):
    """Describes the views of one enrollment together by several descriptors, as a search segments its views.

    First it learns the background from all images, one after the other, then it describes each image. It holds no image
    in memory. The paper's descriptors describe the whole region of interest, all others only the object.

    Raises `ValueError`: a descriptor is unknown.
    """

    def __init__(
        self, config: ViewConfig, names: tuple[str, ...], empty_table: NDArray[np.uint8] | None = None
    ) -> None:
        super().__init__(config, empty_table)
        self._descriptors = [hbr.descriptor(name) for name in names]
        self._learned = LearnedBackground()

    def learn(self, image_bgr: NDArray[np.uint8]) -> int:
        """Learn the background from the next view, uint8 (H, W, 3); return the number of the view.

        Raises `UsageError`, `ValueError`: as for `ViewSegmenter`, or the view has another size than the others.
        """
        self._learned.add(within(image_bgr, self.region))
        return len(self._learned) - 1

    def describe(self, view: int, image_bgr: NDArray[np.uint8], azimuth_deg: float = 0.0) -> DescribedView:
        """Describe the image that `learn` got as the view of this number."""
        frame = SegmentedFrame(within(image_bgr, self.region))
        background, issues = self._prepared_table(image_bgr, azimuth_deg)
        (found,) = hbr.hypotheses(frame, empty_table=background, learned=self._learned.of(view), most=1)
        if found.box is None:
            found = hbr.segment(frame, empty_table=background)
        found = replace(found, issues=(*issues, *found.issues))
        levels = {one.name: one.describe(frame.image if one.whole_image else found) for one in self._descriptors}
        return DescribedView(levels, evidence_together(found, len(self._learned)))


class SearchDescriber(ViewSegmenter):
    """Describes the views of one search by one descriptor, with several segmentations of each view.

    The paper's descriptors need no segmentation: they describe the whole region of interest.

    The background is learned from all views of the search, so that each view also improves the earlier ones
    (`hbr.ViewsTogether`). The levels have a row for each segmentation.

    With ``revise`` earlier views are segmented again with each new one; not in a search in motion, which has many
    views. The empty-table image is compared with that of the enrollment, ``enrolled_table``.
    """

    def __init__(
        self,
        config: ViewConfig,
        name: str,
        empty_table: NDArray[np.uint8] | None = None,
        *,
        revise: bool = True,
        enrolled_table: NDArray[np.uint8] | None = None,
    ) -> None:
        self._kind = hbr.descriptor(name)
        super().__init__(config, None if self._kind.whole_image else empty_table)
        self._revise = revise
        self._enrolled_table = enrolled_table
        self._other_bench = False
        self._views: hbr.ViewsTogether | None = None

    @property
    def hypotheses(self) -> list[tuple[hbr.Segmentation, ...]]:
        """All segmentations of each view so far, in the order of its levels; empty if the descriptor needs none."""
        return [] if self._views is None else self._views.segmentations

    def __call__(self, image_bgr: NDArray[np.uint8], azimuth_deg: float = 0.0) -> DescribedView:
        """Describe the next frame of the search; errors as for `ViewSegmenter`."""
        part = within(image_bgr, self.region)
        if self._kind.whole_image:
            return DescribedView({self._kind.name: self._kind.describe(part)}, None)
        background, issues = self._prepared_table(image_bgr, azimuth_deg)
        if self._views is None:
            self._views = hbr.ViewsTogether(self._kind.name)
        found = self._views.add(part, background, revise=self._revise, keep=self._revise)[0]
        # Whether this is the bench of the enrollment does not change during a search: the first view decides it.
        if len(self._views.segmentations) == 1:
            before, now = (table_image(one, image_bgr, azimuth_deg) for one in (self._enrolled_table, self.empty_table))
            if before is not None and now is not None:
                table = hbr.Background(within(before, self.region))
                self._other_bench = table.shows_another_bench(within(now, self.region))
        found = replace(found, issues=(*issues, *found.issues))
        *earlier, levels = self._views.levels
        problem = self._table_problem(found.agreement)
        revised = tuple(earlier) if self._revise else None
        return DescribedView(
            {self._kind.name: levels}, found.evidence(), problem, revised, self._views.reliable, self._other_bench
        )


def segmentation_summary(evidence: Iterable[Mapping[str, Any] | None]) -> dict[str, Any]:
    """Return numbers of views, from the stored evidence of several; None is a view without segmentation.

    ``views`` have evidence; in ``found`` of them the object was found reliably, in ``guessed`` it was only guessed. In
    ``corrected`` the illumination was corrected. ``issues`` counts the views with each `hbr.segmentation.IssueCode`,
    the most frequent first.
    """
    views = [one for one in evidence if one is not None]
    boxes = [one for one in views if one.get("box_px") is not None]
    guessed = sum(one.get("method") == BoxMethod.GUESS for one in boxes)
    codes = Counter(code for one in views for code in {issue["code"]: None for issue in one.get("issues", ())})
    return {
        "views": len(views),
        "found": len(boxes) - guessed,
        "guessed": guessed,
        "corrected": sum(one.get("gains_bgr") is not None for one in views),
        "issues": dict(codes.most_common()),
    }


def segmentation_words(summary: Mapping[str, Any]) -> str:
    """Return a `segmentation_summary` in one line; empty if no view has segmentation evidence."""
    if not summary["views"]:
        return ""
    guessed = f", guessed in {summary['guessed']}" if summary["guessed"] else ""
    issues = "".join(f"; {_TEXT.get(code, code)} ({count})" for code, count in summary["issues"].items())
    return (
        f"object found in {summary['found']} of {summary['views']} views{guessed}, illumination corrected in "
        f"{summary['corrected']}{issues}"
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
