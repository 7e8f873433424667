"""What a plan tells while it runs: small frozen events, the one stream that people, files and tests see."""

import re
from dataclasses import dataclass, field, fields, is_dataclass
from enum import StrEnum
from math import isfinite
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rig.views.capture import ViewEvidence

SCHEMA = 1
"""Version of the JSON form (docs/events.md): raised when a field goes or changes its meaning, not when one comes."""

_OUTSIDE = {"json": False}


@dataclass(frozen=True, slots=True)
class Started:
    """A plan begins: ``plan`` is "enroll" or "identify", ``views`` how many views it takes at most.

    ``angles_deg`` are the table angles that an enrollment goes to; ``strategy`` and ``seed`` decide where an
    identification looks, ``descriptor`` is what it compares views by, and ``notes`` say, for people, what its answer
    will be worth.
    """

    plan: str
    name: str | None
    views: int
    conditions: dict[str, Any]
    strategy: str | None = None
    seed: int | None = None
    angles_deg: tuple[float, ...] = ()
    schema: int = SCHEMA
    descriptor: str | None = None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Moved:
    """The table turned and is at rest.

    Angles of the table in degrees, unwrapped. ``agrees`` says whether encoder and gyro measured the same rotation
    within ``bound_deg``; when they do not, the platter's gyro is believed.
    """

    index: int
    commanded_deg: float
    encoder_deg: float
    rotation_encoder_deg: float
    rotation_imu_deg: float | None
    imu_sigma_deg: float | None
    bound_deg: float | None
    agrees: bool
    seconds: float


@dataclass(frozen=True, slots=True)
class Unwinding:
    """The table is about to go the long way round, because its cable reaches no further: ``turns`` whole turns back.

    Angles of the table in degrees, unwrapped; ``limits_deg`` is how far the cable reaches.
    """

    index: int
    from_deg: float
    to_deg: float
    turns: int
    limits_deg: tuple[float, float]


@dataclass(frozen=True, slots=True)
class Rejected:
    """A frame was not taken, and why."""

    index: int
    attempt: int
    reasons: tuple[str, ...]
    evidence: ViewEvidence


@dataclass(frozen=True, slots=True)
class Accepted:
    """A view was taken (and, when enrolling, is durable).

    ``segmentation`` is `hbr.Segmentation.evidence` as JSON values; None if no segmentation was made.
    """

    index: int
    azimuth_deg: float
    evidence: ViewEvidence
    image_bgr: NDArray[np.uint8] = field(metadata=_OUTSIDE, repr=False)
    segmentation: dict[str, Any] | None = None


@dataclass(frozen=True, slots=True)
class Candidate:
    """An object with its score per view and its pose: the azimuth at which the camera sees it now.

    ``probability`` is that of being what stands there, among the enrolled objects; None where the search has none.
    """

    name: str
    score: float
    pose_deg: float
    probability: float | None = None


@dataclass(frozen=True, slots=True)
class Ranked:
    """What is thought after a view; ``margin`` is how far, in score per view, the first candidate surely leads.

    It leads any other enrolled object by at least that (`hbr.score_margin`); it may be negative. ``verdict`` is the
    stopping rule's decision, in words.
    """

    index: int
    candidates: tuple[Candidate, ...]
    margin: float
    verdict: str = ""


@dataclass(frozen=True, slots=True)
class Weighed:
    """All turns that were weighed before one was decided on.

    ``rotations_deg`` are the camera's, positive to the left; ``confusion`` is the logarithm of the probability of still
    taking one object for another after each, ``cost`` what its motion costs, in the same unit: the lowest sum was
    chosen. ``alike`` is how alike the two rivals look there; None where no second object is likely.
    """

    rotations_deg: tuple[float, ...]
    confusion: tuple[float, ...]
    cost: tuple[float, ...]
    alike: tuple[float, ...] | None = None


@dataclass(frozen=True, slots=True)
class Decided:
    """Where to look next, and ``why`` in words: of AHBR, the side on which the ``rivals`` look less alike (Eq. 6-7).

    ``rotation_deg`` is the camera's around the object, positive to the left; the table turns the other way, to
    ``target_deg``. ``s_left`` and ``s_right`` are None where the sides were not compared, ``weighed`` where not all
    turns were.
    """

    index: int
    side: str
    rotation_deg: float
    target_deg: float
    s_left: float | None
    s_right: float | None
    rivals: tuple[str, ...]
    why: str = ""
    weighed: Weighed | None = None


@dataclass(frozen=True, slots=True)
class Enrolled:
    """An object is complete in the catalog."""

    name: str
    views: int
    retakes: int
    seconds: float


class SkipReason(StrEnum):
    """Why an object of a tray is skipped."""

    ALREADY_ENROLLED = "already_enrolled"
    OPERATOR = "operator"
    ERROR = "error"


@dataclass(frozen=True, slots=True)
class Item:
    """The next object of a tray, ``number`` (from 1) ``of`` so many.

    ``action`` is "enroll", "resume" (take the missing views), "replace" (repeat an interrupted enrollment, because
    the object was moved), or "skip". A skipped object has a ``reason``, and after an error its ``error_code``.
    """

    number: int
    of: int
    name: str
    action: str
    reason: SkipReason | None = None
    error_code: int | None = None


@dataclass(frozen=True, slots=True)
class SimilarObject:
    """An enrolled object that looks the same from some sides.

    ``arcs_deg`` are those sides, azimuths from and to, counter-clockwise; ``share`` of the views; ``similarity`` is the
    largest of any two views.
    """

    name: str
    arcs_deg: tuple[tuple[float, float], ...]
    share: float
    similarity: float


@dataclass(frozen=True, slots=True)
class SimilarObjects:
    """What a new object will be taken for: itself, turned by ``period_deg``, and other objects.

    ``period_deg`` is 360 where no turn makes it look the same, 0 where it looks alike from everywhere, None where there
    are too few views to tell. ``neighbours`` is how alike neighbouring views are, ``alike`` those a period apart.
    """

    name: str
    period_deg: float | None
    neighbours: float | None
    alike: float | None
    lookalikes: tuple[SimilarObject, ...]


@dataclass(frozen=True, slots=True)
class EmptyTableImage:
    """The empty table was photographed, and the picture is kept: objects are found by what differs from it.

    ``turning_share`` is how much of the picture changed as the table turned a little, ``agreement`` how much of its
    border did not; None where the table could not turn. ``replaced`` has the problems of the previous image.
    """

    taken_utc: str
    width: int
    height: int
    turning_share: float | None
    agreement: float | None
    evidence: ViewEvidence
    replaced: tuple[dict[str, Any], ...]
    seconds: float
    image_bgr: NDArray[np.uint8] = field(metadata=_OUTSIDE, repr=False)


@dataclass(frozen=True, slots=True)
class Warned:
    """Something that a person should see to; the plan goes on meanwhile. ``index`` is the view that it was seen at."""

    index: int | None
    what: str
    next_step: str


@dataclass(frozen=True, slots=True)
class Waiting:
    """Nothing happens until somebody does something: ``why`` says what."""

    why: str


@dataclass(frozen=True, slots=True)
class Failed:
    """An object could not be identified, and the plan goes on with the next one; the fields are the error's."""

    error: str
    code: int
    what: str
    evidence: dict[str, Any]
    next_step: str


@dataclass(frozen=True, slots=True)
class Identified:
    """The answer: an object's name, or None for "unknown".

    ``score``, ``margin`` and ``min_score`` (below which an object counts as unknown) are per view; ``pose_deg`` the
    azimuth the camera sees last, in the catalog's frame, ``yaw_deg`` how far the object stands turned counter-clockwise
    against its enrollment; ``reason`` why the search ended. Of the dense search ``probability`` is the first
    candidate's, ``familiarity`` how much this looks like an enrolled object, and ``min_familiarity`` the least that
    those have; None where nothing may be called unknown.
    """

    name: str | None
    candidates: tuple[Candidate, ...]
    score: float
    margin: float
    min_score: float
    pose_deg: float
    yaw_deg: float
    views: int
    travelled_deg: float
    seconds: float
    reason: str
    probability: float | None = None
    familiarity: float | None = None
    min_familiarity: float | None = None


Event = (
    Started
    | Moved
    | Unwinding
    | Rejected
    | Accepted
    | Ranked
    | Decided
    | Enrolled
    | Identified
    | Item
    | SimilarObjects
    | EmptyTableImage
    | Warned
    | Waiting
    | Failed
)


def event_kind(kind: type) -> str:
    """Return the name of a kind of event in JSON: ``"empty_table_image"`` of `EmptyTableImage`."""
    return re.sub(r"(?<!^)(?=[A-Z])", "_", kind.__name__).lower()


def event_dict(event: Event) -> dict[str, Any]:
    """Return an event as plain data for JSON, its kind under ``"event"``; pictures are left out."""
    return {"event": event_kind(type(event)), **plain(event)}


def plain(value: Any) -> Any:
    """Return ``value`` as JSON has it: dataclasses as dicts, tuples as lists, what is not finite (unknown) as None.

    Fields marked ``json=False`` are left out.
    """
    if is_dataclass(value) and not isinstance(value, type):
        return {f.name: plain(getattr(value, f.name)) for f in fields(value) if f.metadata.get("json", True)}
    if isinstance(value, tuple | list):
        return [plain(v) for v in value]
    if isinstance(value, dict):
        return {k: plain(v) for k, v in value.items()}
    if isinstance(value, float) and not isfinite(value):
        return None
    return value
