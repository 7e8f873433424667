"""The events of an enrollment or a search, as a report needs them, and the comparison of an answer with the truth."""

from dataclasses import dataclass, field, replace
from enum import StrEnum
from itertools import accumulate, pairwise
from typing import Final, TypeVar

from hbr import Outcome
from hbr.core.angles import wrap180
from rig.events.events import Accepted, Event, FrameUsed, Identified, Ranked, Rejected
from rig.report.pictures import Region, thumbnail

TILE: Final = (96, 96)
"""Width and height of a view on a contact sheet, pixels."""

FRAME: Final = (240, 240)
"""Width and height of a frame of a retrieval, pixels."""

VIEWS: Final = 12
"""Views of a search that a page shows. A search in motion takes sixty: too many to read one by one."""

Kind = TypeVar("Kind", bound=Event)


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


@dataclass(eq=False)
class Record:
    """One enrollment or search, collected event by event, with thumbnails instead of images: a long run needs little.

    ``size`` is that of the thumbnails, ``region`` the part of the images to show: x, y, width, height in pixels
    (`view.roi` of the configuration); None shows all. ``truth`` is the object on the table, None if it is not known.
    """

    size: tuple[int, int] = FRAME
    region: Region | None = None
    truth: Truth | None = None
    events: list[Event] = field(default_factory=list, init=False)

    def add(self, event: Event) -> None:
        """Add the next event of the plan."""
        if isinstance(event, Accepted):
            box = None if event.segmentation is None else event.segmentation.get("box_px")
            event = replace(event, image_bgr=thumbnail(event.image_bgr, self.size, self.region, box))
        self.events.append(event)

    def all(self, kind: type[Kind]) -> list[Kind]:
        """Return the events of a kind, in their order."""
        return [event for event in self.events if isinstance(event, kind)]

    def last(self, kind: type[Kind], index: int | None = None) -> Kind | None:
        """Return the last event of a kind, or the last one about the view of that index; None if there is none."""
        found = [event for event in self.all(kind) if index is None or getattr(event, "index", None) == index]
        return found[-1] if found else None

    @property
    def views(self) -> list[Accepted]:
        """The accepted views in the order of capture."""
        return self.all(Accepted)

    @property
    def retakes(self) -> int:
        """Number of rejected frames, of all views."""
        return len(self.all(Rejected))

    @property
    def answer(self) -> Identified | None:
        """The answer of a search."""
        return self.last(Identified)

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
    def shown(self) -> list[Accepted]:
        """The views of a page: those after which the search decided, at most `VIEWS`, evenly chosen."""
        decided = {event.index for event in self.all(Ranked)}
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
        frames = self.all(FrameUsed)
        return next((one for one in frames if one.outcome is not Outcome.CONTINUE and one.index in taken), None)

    @property
    def rotated_deg(self) -> dict[int, float]:
        """The rotation of the camera since the first view, by the index of each view; always the short way."""
        views = self.views
        ways = (abs(wrap180(b.azimuth_deg - a.azimuth_deg)) for a, b in pairwise(views))
        return dict(zip((view.index for view in views), accumulate(ways, initial=0.0), strict=False))
