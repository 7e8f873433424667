"""The events of a running plan: small frozen dataclasses, the same for the terminal, for files and for tests."""

import re
from dataclasses import dataclass, field, fields, is_dataclass
from enum import Enum, StrEnum
from math import isfinite
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hbr import Outcome, StopDecision, StopReason
from rig.events.compared import Compared, Verified
from rig.motion.scan_speed import SpeedLimit
from rig.views.capture import ViewEvidence

SCHEMA = 1
"""Version of the JSON form (docs/events.md): it rises when a field is removed or changes its meaning."""

_OUTSIDE = {"json": False}


class NoteCode(StrEnum):
    """The subjects of notes; `rig.events.note_wording.note_words` has their sentences."""

    PAPER_SEARCH = "paper-search"
    MIXED_EMPTY_TABLE = "mixed-empty-table"
    ENROLLED_WITHOUT_EMPTY_TABLE = "enrolled-without-empty-table"
    ENROLLED_BY_GUESS = "enrolled-by-guess"
    EMPTY_TABLE_DOUBTED = "empty-table-doubted"
    EMPTY_TABLE_MISSING = "empty-table-missing"
    EMPTY_TABLE_OF_ENROLLMENT = "empty-table-of-enrollment"
    EMPTY_TABLE_CHANGED = "empty-table-changed"
    TABLE_DIFFERS = "table-differs"
    STOPPING_RULE_UNREADABLE = "stopping-rule-unreadable"
    STOPPING_RULE_OUTDATED = "stopping-rule-outdated"
    RATES_NOT_GUARANTEED = "rates-not-guaranteed"
    NOT_RECORDED = "not-recorded"
    NOT_COMPARED = "not-compared"
    LOCAL_COPY = "local-copy"


@dataclass(frozen=True, slots=True)
class Note:
    """A note for the operator: a code, and the numbers and names for its sentence."""

    code: NoteCode
    values: dict[str, Any] = field(default_factory=dict)


class RotationReason(StrEnum):
    """Why a strategy chose a rotation."""

    FIRST_STEP = "first-step"
    LESS_SIMILAR_SIDE = "less-similar-side"
    ONE_CANDIDATE = "one-candidate"
    SEPARATES_CANDIDATES = "separates-candidates"
    NEW_SIDE = "new-side"
    SEVERAL_POSES = "several-poses"
    EVEN_STEPS = "even-steps"
    RANDOM = "random"
    CUSTOM = "custom"


class WaitReason(StrEnum):
    """What `rig identify --watch` waits for."""

    FIRST_OBJECT = "first-object"
    NEXT_OBJECT = "next-object"


@dataclass(frozen=True, slots=True)
class Started:
    """A plan starts: ``plan`` is "enroll" or "identify", ``views`` the largest number of views.

    ``angles_deg`` are the table angles of an enrollment; with ``in_motion`` all views are taken in one revolution. An
    identification has a ``strategy`` with its ``seed``, the ``descriptor`` that views are compared by, and ``notes`` on
    how reliable its answer is.
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
    notes: tuple[Note, ...] = ()
    in_motion: bool = False


@dataclass(frozen=True, slots=True)
class Moved:
    """The table has rotated and is at rest.

    Angles of the table in degrees, unwrapped. ``agrees`` is whether encoder and gyro measured the same rotation within
    ``bound_deg``; if they did not, the gyro on the platter is trusted.
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
class ScanStarted:
    """The table begins a rotation during which views are taken.

    Angles of the table in degrees, unwrapped. ``limit`` names the cause that limits the speed, and ``value`` is its
    number: the exposure in ms, the frames per second, the table's or the gyro's speed in °/s, or the uncertainty of a
    frame's time in ms.
    """

    speed_dps: float
    limit: SpeedLimit
    value: float
    from_deg: float
    to_deg: float


@dataclass(frozen=True, slots=True)
class Unwinding:
    """The table rotates back by whole ``revolutions`` to free its cable.

    Angles of the table in degrees, unwrapped; ``limits_deg`` are the limits of the cable.
    """

    index: int
    from_deg: float
    to_deg: float
    revolutions: int
    limits_deg: tuple[float, float]


@dataclass(frozen=True, slots=True)
class Rejected:
    """A frame was rejected, with the reasons."""

    index: int
    attempt: int
    reasons: tuple[str, ...]
    evidence: ViewEvidence


@dataclass(frozen=True, slots=True)
class Accepted:
    """A view was taken (and, when enrolling, is durable).

    ``segmentation`` is `hbr.Segmentation.evidence` as JSON values; None if no segmentation was made. ``same_bench``
    is whether a search's first view shows the bench of the enrollment; None: not known.
    """

    index: int
    azimuth_deg: float
    evidence: ViewEvidence
    image_bgr: NDArray[np.uint8] = field(metadata=_OUTSIDE, repr=False)
    segmentation: dict[str, Any] | None = None
    same_bench: bool | None = None


@dataclass(frozen=True, slots=True)
class Candidate:
    """An object with its score per view and its pose: the azimuth at which the camera sees it now.

    ``probability`` is that of being the object on the table, among the enrolled ones; None if the search computes none.
    """

    name: str
    score: float
    pose_deg: float
    probability: float | None = None


@dataclass(frozen=True, slots=True)
class Ranked:
    """The candidates after a view, the best first.

    ``margin`` is the smallest lead of the first one over any other enrolled object, in score per view; it may be
    negative. ``decision`` is the stopping rule's decision in the dense search.
    """

    index: int
    candidates: tuple[Candidate, ...]
    margin: float
    decision: StopDecision | None = None


@dataclass(frozen=True, slots=True)
class FrameUsed:
    """A search in motion used a frame; the fields are its state after the frame.

    ``seconds`` is the time since the search began, ``rejected`` the number of frames that were not used so far.
    ``name`` is the best candidate with its ``probability``. ``outcome`` is what the stopping rule would decide at this
    frame; it decides only when the frames have covered another step of the circle.
    """

    index: int
    azimuth_deg: float
    seconds: float
    rejected: int
    name: str
    probability: float
    outcome: Outcome


@dataclass(frozen=True, slots=True)
class Weighed:
    """All rotations that the dense search weighed before it chose one.

    ``rotations_deg`` are the camera's, positive to the left. ``confusion`` is the logarithm of the probability that two
    objects are still confused after each rotation, ``cost`` the cost of its motion in the same unit. The rotation with
    the lowest sum was chosen. ``similarity`` is the similarity of the two candidates after each rotation; None if it
    compares no two candidates.
    """

    rotations_deg: tuple[float, ...]
    confusion: tuple[float, ...]
    cost: tuple[float, ...]
    similarity: tuple[float, ...] | None = None


@dataclass(frozen=True, slots=True)
class Decided:
    """The rotation to the next view, and the ``reason`` for it.

    ``rotation_deg`` is the camera's around the object, positive to the left; the table rotates the other way, to
    ``target_deg``. ``s_left`` and ``s_right`` are the similarities of the ``candidates`` from each side (Eq. 6), if
    AHBR compared the sides. ``note`` is the explanation of a user's own strategy.
    """

    index: int
    side: str
    rotation_deg: float
    target_deg: float
    s_left: float | None
    s_right: float | None
    candidates: tuple[str, ...]
    reason: RotationReason
    note: str = ""
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
    """The next object of a tray: ``number``, from 1, ``of`` all.

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

    ``arcs_deg`` are those sides, azimuths from and to, counter-clockwise, and ``differs_deg`` the others;
    ``other_differs_deg`` are the sides of the enrolled object that look like none of the new one. ``share`` is the
    share of the new object's views that look the same; ``similarity`` is the largest of any two views.
    """

    name: str
    arcs_deg: tuple[tuple[float, float], ...]
    differs_deg: tuple[tuple[float, float], ...]
    other_differs_deg: tuple[tuple[float, float], ...]
    share: float
    similarity: float


@dataclass(frozen=True, slots=True)
class SimilarObjects:
    """Confusions of a new object: with itself, rotated by ``period_deg``, and with other objects.

    ``period_deg`` is 360 if the object has no symmetry, 0 if it looks the same from all sides, None if it has too few
    views. ``neighbour_similarity`` is the mean of neighbouring views, ``period_similarity`` of views a period apart.
    """

    name: str
    period_deg: float | None
    neighbour_similarity: float | None
    period_similarity: float | None
    objects: tuple[SimilarObject, ...]


@dataclass(frozen=True, slots=True)
class EmptyTableImage:
    """The empty-table image was taken and stored. Segmentation compares views with it.

    ``turning_share`` is the share of the image that changed while the table rotated a little, ``agreement`` the share
    of its border that did not; None if the table could not rotate. ``replaced`` has the problems of the previous image.
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
    """A warning for the operator while the plan continues; ``index`` is the view at which it was noticed."""

    index: int | None
    note: Note


@dataclass(frozen=True, slots=True)
class Waiting:
    """The plan waits for the operator."""

    reason: WaitReason


@dataclass(frozen=True, slots=True)
class Failed:
    """An object could not be identified, and the plan continues with the next one; the fields are the error's."""

    error: str
    code: int
    what: str
    evidence: dict[str, Any]
    next_step: str


@dataclass(frozen=True, slots=True)
class Identified:
    """The answer: an object's name, or None for an unknown object.

    ``outcome`` is whether the object was found, is ambiguous, or is unknown. ``possible`` names the objects that it may
    be: one, several, or none. The ``name`` of an ambiguous object is the first of them.

    ``score`` and ``margin`` are per view. ``pose_deg`` is the azimuth of the last view, in the catalog's frame.
    ``yaw_deg`` is the object's rotation relative to its enrollment, counter-clockwise, with the standard uncertainty
    ``yaw_sigma_deg``. It is None if the views do not determine it, or if the object looks the same every
    ``period_deg``; ``yaw_set_deg`` then has all equivalent rotations. ``period_deg`` is 360 without symmetry, 0 if the
    object looks the same from all sides, None if that is not known. The paper's search has no uncertainty.

    ``reason`` is why the search ended; ``note`` is the explanation of a user's own strategy.
    The paper's search compares the score with ``min_score`` and the margin with ``min_margin``; the dense search
    compares the probability of the first candidate with ``min_confidence`` and the open-set score with
    ``open_set_threshold``, None if no object is called unknown. That probability is the ``confidence`` if the object
    was found; otherwise it is None, and the probabilities of the ``candidates`` are shares among the enrolled objects.
    """

    name: str | None
    candidates: tuple[Candidate, ...]
    score: float
    margin: float
    pose_deg: float
    yaw_deg: float | None
    views: int
    travelled_deg: float
    seconds: float
    reason: StopReason
    outcome: Outcome
    possible: tuple[str, ...]
    yaw_sigma_deg: float | None = None
    yaw_set_deg: tuple[float, ...] = ()
    period_deg: float | None = None
    note: str = ""
    min_score: float | None = None
    min_margin: float | None = None
    confidence: float | None = None
    min_confidence: float | None = None
    open_set_score: float | None = None
    open_set_threshold: float | None = None


@dataclass(frozen=True, slots=True)
class Recorded:
    """The answer is recorded in the catalog under a number (`rig results show`), with the sample that was given."""

    result: int
    sample: str | None


Event = (
    Started
    | Moved
    | ScanStarted
    | Unwinding
    | Rejected
    | Accepted
    | Ranked
    | FrameUsed
    | Verified
    | Compared
    | Decided
    | Enrolled
    | Identified
    | Item
    | SimilarObjects
    | EmptyTableImage
    | Warned
    | Waiting
    | Failed
    | Recorded
)


def event_kind(kind: type) -> str:
    """Return the name of a kind of event in JSON: ``"empty_table_image"`` of `EmptyTableImage`."""
    return re.sub(r"(?<!^)(?=[A-Z])", "_", kind.__name__).lower()


def event_dict(event: Event) -> dict[str, Any]:
    """Return an event as plain data for JSON, its kind under ``"event"``; pictures are left out."""
    return {"event": event_kind(type(event)), **plain(event)}


def plain(value: Any) -> Any:
    """Return ``value`` as JSON values: dataclasses as dicts, tuples as lists, numbers that are not finite as None.

    Fields marked ``json=False`` are left out.
    """
    if is_dataclass(value) and not isinstance(value, type):
        return {f.name: plain(getattr(value, f.name)) for f in fields(value) if f.metadata.get("json", True)}
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, tuple | list):
        return [plain(v) for v in value]
    if isinstance(value, dict):
        return {k: plain(v) for k, v in value.items()}
    if isinstance(value, float) and not isfinite(value):
        return None
    return value
