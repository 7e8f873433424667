"""Records of enrollments and searches for a report, collected from the events of a running plan.

A record has thumbnails instead of images, so that a long run needs little memory.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from itertools import accumulate, pairwise
from typing import Any, ClassVar, Final

from hbr import Outcome
from hbr.core.angles import wrap180
from rig.charts.compass import PathStep
from rig.events.events import (
    Accepted,
    Decided,
    Enrolled,
    Event,
    FrameUsed,
    Identified,
    Moved,
    Note,
    Ranked,
    Rejected,
    SimilarObjects,
    Started,
    Verified,
)
from rig.report.pictures import Image, Region, thumbnail
from rig.views.capture import ViewEvidence, rejection_text

TILE: Final = (96, 96)
"""Width and height of a view on a contact sheet, pixels."""

FRAME: Final = (240, 240)
"""Width and height of a frame of a retrieval, pixels."""

VIEWS: Final = 12
"""Views of a search that a page shows. A search in motion takes sixty: too many to read one by one."""


@dataclass(frozen=True, slots=True)
class ReportView:
    """An accepted view: thumbnail, evidence, the move before it, and the reasons for rejecting frames before it."""

    index: int
    azimuth_deg: float
    picture_bgr: Image
    evidence: ViewEvidence
    move: Moved | None
    rejected: tuple[str, ...]


class _Record:
    """The views of a plan, collected event by event.

    ``region`` is the part of the images to show: x, y, width, height in pixels (`view.roi` of the configuration); None
    shows all.
    """

    size: ClassVar[tuple[int, int]]
    """Width and height of its pictures."""

    def __init__(self, *, region: Region | None = None) -> None:
        self.views: list[ReportView] = []
        """The accepted views in the order of capture."""
        self.conditions: Mapping[str, Any] = {}
        self._region = region
        self._move: Moved | None = None
        self._rejected: list[str] = []

    def add(self, event: Event) -> None:
        """Add the next event of the plan."""
        match event:
            case Started():
                self.conditions = event.conditions
            case Moved():
                self._move = event
            case Rejected():
                self._rejected.append(", ".join(rejection_text(reason, event.evidence) for reason in event.reasons))
            case Accepted():
                rejected, self._rejected = tuple(self._rejected), []
                self.views.append(self._view(event, self._move, rejected))
            case _:
                pass

    def _view(self, taken: Accepted, move: Moved | None, rejected: tuple[str, ...]) -> ReportView:
        box = None if taken.segmentation is None else taken.segmentation.get("box_px")
        picture = thumbnail(taken.image_bgr, self.size, self._region, box)
        return ReportView(taken.index, taken.azimuth_deg, picture, taken.evidence, move, rejected)


class EnrollmentRecord(_Record):
    """One enrollment, collected event by event."""

    size = TILE

    def __init__(self, *, region: Region | None = None) -> None:
        super().__init__(region=region)
        self.name = ""
        self.planned = 0
        self.result: Enrolled | None = None
        self.similar: SimilarObjects | None = None

    @property
    def retakes(self) -> int:
        """Number of rejected frames, of all views."""
        return sum(len(view.rejected) for view in self.views)

    def add(self, event: Event) -> None:
        super().add(event)
        if isinstance(event, Started):
            self.name, self.planned = event.name or "", event.views
        elif isinstance(event, Enrolled):
            self.result = event
        elif isinstance(event, SimilarObjects):
            self.similar = event


@dataclass(frozen=True, slots=True)
class Truth:
    """The object that is really on the table.

    ``name`` is None for an object that was never enrolled. ``yaw_deg`` is its rotation relative to its enrollment,
    counter-clockwise, None if it is not known. ``symmetry_deg`` is the smallest rotation after which it looks the same:
    360 for an object without symmetry, 0 for one that looks the same from all sides. ``description`` is the common
    name of an object that was never enrolled.
    """

    name: str | None
    yaw_deg: float | None = None
    symmetry_deg: float = 360.0
    description: str = ""


class Correctness(StrEnum):
    """What an answer is, compared with the object that is really on the table.

    RIGHT: the object was found under its name, or an object that was never enrolled was called unknown.
    """

    RIGHT = "right"
    AMBIGUOUS = "ambiguous"
    WRONG = "wrong"


class IdentificationRecord(_Record):
    """One search, collected event by event; ``truth`` is the object on the table, None if it is not known."""

    size = FRAME

    def __init__(self, *, truth: Truth | None = None, region: Region | None = None) -> None:
        super().__init__(region=region)
        self.truth = truth
        self.notes: tuple[Note, ...] = ()
        self.ranked: list[Ranked] = []
        self.used: list[FrameUsed] = []
        self.decided: list[Decided] = []
        self.verified: Verified | None = None
        self.answer: Identified | None = None

    def add(self, event: Event) -> None:
        super().add(event)
        match event:
            case Started():
                self.notes = event.notes
            case Ranked():
                self.ranked.append(event)
            case FrameUsed():
                self.used.append(event)
            case Verified():
                self.verified = event
            case Decided():
                self.decided.append(event)
            case Identified():
                self.answer = event
            case _:
                pass

    @property
    def correctness(self) -> Correctness | None:
        """The answer compared with the truth; None if one of them is missing."""
        if self.truth is None or self.answer is None:
            return None
        match self.answer.outcome:
            case Outcome.AMBIGUOUS:  # such an answer has a name, too: that of the leading candidate
                return Correctness.AMBIGUOUS
            case Outcome.FOUND:
                return Correctness.RIGHT if self.answer.name == self.truth.name else Correctness.WRONG
            case _:
                return Correctness.RIGHT if self.truth.name is None else Correctness.WRONG

    @property
    def pose_error_deg(self) -> float | None:
        """Distance of the answer's yaw from the true one, modulo the object's symmetry; None if it is not defined."""
        truth, answer = self.truth, self.answer
        if truth is None or answer is None or answer.name is None or self.correctness is not Correctness.RIGHT:
            return None
        if truth.yaw_deg is None or truth.symmetry_deg <= 0 or not answer.yaw_set_deg:
            return None
        # Angles are compared modulo one period of the symmetry.
        periods = 360.0 / truth.symmetry_deg
        true_deg = truth.yaw_deg
        return min(abs(wrap180((yaw_deg - true_deg) * periods)) / periods for yaw_deg in answer.yaw_set_deg)

    @property
    def yaw_deg(self) -> float | None:
        """Rotation of the object relative to its enrollment, or one of the equivalent ones; None if not known."""
        answer = self.answer
        return answer.yaw_set_deg[0] if answer is not None and answer.name is not None and answer.yaw_set_deg else None

    @property
    def shown(self) -> list[ReportView]:
        """The views of a page: those after which the search decided, at most `VIEWS`, evenly chosen."""
        decided = {event.index for event in self.ranked}
        views = [view for view in self.views if view.index in decided] or self.views
        if len(views) <= VIEWS:
            return views
        return [views[round(k * (len(views) - 1) / (VIEWS - 1))] for k in range(VIEWS)]

    @property
    def in_motion(self) -> bool:
        """Whether a view was taken in motion."""
        return any(view.evidence.motion is not None for view in self.views)

    @property
    def enough(self) -> FrameUsed | None:
        """The frame in motion after which the evidence was enough for an answer; None if there is none."""
        taken = self.rotated_deg
        return next((one for one in self.used if one.outcome is not Outcome.CONTINUE and one.index in taken), None)

    @property
    def rotated_deg(self) -> dict[int, float]:
        """The rotation of the camera since the first view, by the index of each view; always the short way."""
        ways = (abs(wrap180(b.azimuth_deg - a.azimuth_deg)) for a, b in pairwise(self.views))
        return dict(zip((view.index for view in self.views), accumulate(ways, initial=0.0), strict=False))

    @property
    def steps(self) -> list[PathStep]:
        """The camera's rotations between the views, as the table made them; in motion, those between decisions.

        The cable's limits may make the table rotate the long way: the azimuths show the end of a rotation, and the
        encoder its number of revolutions.
        """
        steps: list[PathStep] = []
        last: Decided | None = None
        for before, after in pairwise(self.views):
            rotation_deg = wrap180(after.azimuth_deg - before.azimuth_deg)
            if after.move is not None:
                rotation_deg += 360.0 * round((-after.move.rotation_encoder_deg - rotation_deg) / 360.0)
            decided = next((d for d in reversed(self.decided) if d.index <= before.index), None)
            if decided is None:  # a damaged run
                continue
            if decided is last and after.evidence.motion is not None:
                rotation_deg += steps.pop().rotation_deg
            steps.append(PathStep(after.index + 1, rotation_deg))
            last = decided
        return steps
