"""The events of a running plan: small frozen dataclasses, the same for the terminal, for files and for tests.

They are also the schema of their JSON: of `--json`, of saved runs, of the REST interface and of its documents. Names,
types and descriptions of the fields are only here.

Decision: docs/decisions/0002.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from functools import cache
from typing import Annotated, Any, Final, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Discriminator, Field, GetPydanticSchema, TypeAdapter, ValidationError
from pydantic_core import core_schema, from_json, to_json

from hbr import Outcome, StopDecision, StopReason
from hbr.model.symmetry import SimilarObject
from rig.core.errors import Problem
from rig.core.phrases import Worded
from rig.motion.scan_speed import SpeedLimit
from rig.views.capture import ViewEvidence

SCHEMA = 1
"""Version of the JSON form (docs/reference/events.md): it rises when a field is removed or changes its meaning."""

NO_JSON: Final = GetPydanticSchema(lambda _kind, _handler: core_schema.any_schema())
Image = Annotated[NDArray[np.uint8], NO_JSON, Field(exclude=True, default=np.empty((0, 0, 3), np.uint8))]
"""The image of an event. It is no part of the JSON; an event that is read has an empty one."""


class NoteCode(Worded):
    """The subjects of notes."""

    MIXED_EMPTY_TABLE = (
        "mixed-empty-table",
        "{objects} {were} enrolled {how} an empty-table image, unlike the other objects, and such views compare badly",
    )
    ENROLLED_WITHOUT_EMPTY_TABLE = (
        "enrolled-without-empty-table",
        "most objects were enrolled without an empty-table image, so the search does not use it",
    )
    EMPTY_TABLE_DOUBTED = "empty-table-doubted", "the empty-table image may be outdated ({problems})"
    EMPTY_TABLE_MISSING = "empty-table-missing", "the search has no empty-table image ({problems})"
    EMPTY_TABLE_OF_ENROLLMENT = (
        "empty-table-of-enrollment",
        "the empty-table image of the enrollment is used ({problems})",
    )
    EMPTY_TABLE_CHANGED = "empty-table-changed", "the bench no longer looks like its empty-table image: {problems}"
    TABLE_DIFFERS = (
        "table-differs",
        "the table does not look as it did at {taken_utc}; an object that is round may be on it",
    )
    NOT_RECORDED = "not-recorded", "the answer is not recorded: {detail}"
    NOT_COMPARED = "not-compared", "the leading candidates are not compared pixel by pixel: {detail}"
    LOCAL_COPY = "local-copy", "the server of the catalog cannot be used; this uses the copy of {copied_utc}"


@dataclass(frozen=True, slots=True)
class Note:
    """A note for the operator: a code, and the numbers and names for its sentence."""

    code: NoteCode
    """Subject of the note."""
    values: dict[str, Any] = field(default_factory=dict)
    """Numbers and names for the text of the note."""


class RotationReason(Worded):
    """Why a strategy chose a rotation."""

    FIRST_STEP = "first-step", "the first rotation is fixed"
    LESS_SIMILAR_SIDE = "less-similar-side"
    ONE_CANDIDATE = "one-candidate", "there is no second candidate to compare with, so a new side is viewed"
    SEPARATES_CANDIDATES = "separates-candidates"
    NEW_SIDE = "new-side", "no other enrolled object is likely, so a new side is viewed"
    SEVERAL_POSES = "several-poses", "the leading candidate fits in several poses, so a new side is viewed"
    EVEN_STEPS = "even-steps", "the views are taken in even steps"
    RANDOM = "random", "the rotation is random"
    LEAST_RISK = (
        "least-risk",
        "the expected risk of a wrong object is least there, or hardly more, and the side is new",
    )
    CUSTOM = "custom"


class WaitReason(Worded):
    """What `rig identify --watch` waits for."""

    FIRST_OBJECT = "first-object", "the first object, on the empty table"
    NEXT_OBJECT = "next-object", "the next object"


@dataclass(frozen=True, slots=True)
class Started:
    """A plan starts."""

    event: Literal["started"] = field(default="started", init=False)
    plan: Literal["enroll", "identify"]
    """Kind of plan: ``enroll`` or ``identify``."""
    name: str | None
    """Name of the object to be enrolled; null in an identification."""
    views: int
    """Number of views to be taken; in an identification, the setting ``identify.max_views``."""
    conditions: dict[str, Any]
    """Conditions of the bench: its noise model (simulator) or its calibration results. In an enrollment also settings
    and findings."""
    strategy: str | None = None
    """Strategy that chooses the views of an identification; null in an enrollment."""
    seed: Annotated[int, Field(ge=0)] | None = None
    """Seed of the random numbers of an identification; null in an enrollment."""
    angles_deg: tuple[float, ...] = ()
    """Table angles of the views to be taken; empty in an identification."""
    schema: int = SCHEMA
    """Version of this schema."""
    descriptor: str | None = None
    """Descriptor by which an identification compares views; null in an enrollment."""
    notes: tuple[Note, ...] = ()
    """Notes for the operator about how reliable the answer will be."""
    in_motion: bool = False
    """Whether an enrollment takes its views in one revolution, without stopping for each view."""


@dataclass(frozen=True, slots=True)
class Moved:
    """The table has rotated and is at rest."""

    event: Literal["moved"] = field(default="moved", init=False)
    index: int
    """Index of the view, from 0."""
    commanded_deg: float
    """Requested table angle."""
    encoder_deg: float
    """Table angle by the encoder."""
    rotation_encoder_deg: float
    """Rotation since the table was last at rest, by the encoder."""
    rotation_imu_deg: float | None
    """The same rotation by the gyro; null if the gyro has no valid value."""
    imu_sigma_deg: float | None
    """Standard uncertainty of ``rotation_imu_deg``."""
    bound_deg: float | None
    """Largest difference between encoder and gyro that their uncertainties allow; null if they were not compared."""
    agrees: bool
    """Whether the difference is within ``bound_deg``; true if they were not compared. If it is false, an identification
    uses the gyro's rotation, and an enrollment ends with an error."""
    seconds: float
    """Time from the start of the motion until the table is at rest."""


@dataclass(frozen=True, slots=True)
class ScanStarted:
    """The table begins the rotation during which the views are taken."""

    event: Literal["scan_started"] = field(default="scan_started", init=False)
    speed_dps: float
    """Speed of the table in °/s."""
    limit: SpeedLimit
    """Cause that limits the speed: ``smear``, ``frame-rate``, ``table``, ``gyro`` or ``time``."""
    value: float
    """Number for ``limit``: the exposure time in ms, the frames per second, the table's speed or the gyro's range in
    °/s, or the uncertainty of a frame's time in ms."""
    from_deg: float
    """Table angle at the beginning of the rotation."""
    to_deg: float
    """Table angle at the end of the rotation."""


@dataclass(frozen=True, slots=True)
class Unwinding:
    """The table rotates back by whole revolutions to free its cable."""

    event: Literal["unwinding"] = field(default="unwinding", init=False)
    index: int
    """Index of the view, from 0."""
    from_deg: float
    """Table angle before the rotation."""
    to_deg: float
    """Table angle after the rotation."""
    revolutions: int
    """Number of whole revolutions by which the table rotates back."""
    limits_deg: tuple[float, float]
    """Limits of the cable: the lowest and the highest table angle."""


@dataclass(frozen=True, slots=True)
class Rejected:
    """A frame was rejected. The program takes another one, or ends with an error."""

    event: Literal["rejected"] = field(default="rejected", init=False)
    index: int
    """Index of the view, from 0."""
    attempt: int
    """Number of the frame among those taken for this view, from 1."""
    reasons: tuple[str, ...]
    """Codes of the reasons: ``exposed-early``, ``gyro-incomplete``, ``table-moved``, ``repeated-frame``,
    ``locks-changed``, ``too-dark``, ``overexposed``, ``blurred``, ``noise``, ``smeared``, ``angle-uncertain``,
    ``time-uncertain``."""
    evidence: ViewEvidence
    """Measurements that led to the rejection."""


@dataclass(frozen=True, slots=True)
class Accepted:
    """A view was taken. In an enrollment it is stored: it survives a power cut."""

    event: Literal["accepted"] = field(default="accepted", init=False)
    index: int
    """Index of the view, from 0; in an enrollment, its place in the plan."""
    azimuth_deg: float
    """Azimuth of the camera around the object. In an identification, 0° is arbitrary."""
    evidence: ViewEvidence
    """Measurements that led to the acceptance."""
    image_bgr: Image = field(repr=False)
    segmentation: dict[str, Any] | None = None
    """How the program found the object in the image and corrected the illumination; ``issues`` lists the steps that
    were not possible. Null if the view was not segmented."""
    other_bench: bool = False
    """Whether the empty-table image of an identification certainly shows another bench than that of the enrollment."""


@dataclass(frozen=True, slots=True)
class Candidate:
    """An enrolled object that the object on the table may be."""

    name: str
    """Name of the enrolled object."""
    score: float
    """Score per view: the Hough score, the support in the dense search, or with ``hmm`` the similarity."""
    pose_deg: float
    """Azimuth of the camera around this object at the last view, with the 0° of the object's enrollment."""
    probability: float | None = None
    """Probability that it is the object on the table. In the dense search, the probabilities of all enrolled objects
    and ``not_enrolled`` have the sum 1; with ``hmm``, those of the enrolled objects alone. Null in the paper's
    search."""


@dataclass(frozen=True, slots=True)
class Ranked:
    """The candidates were ranked after a view."""

    event: Literal["ranked"] = field(default="ranked", init=False)
    index: int
    """Index of the view, from 0."""
    candidates: Annotated[tuple[Candidate, ...], Field(min_length=1)]
    """The leading candidates, the best first."""
    margin: float
    """Score per view of the first candidate minus the highest score of any other enrolled object. The paper's search
    uses an upper bound of that score. The margin can be negative."""
    decision: StopDecision | None = None
    """Decision of the dense search after this view, with the probability ``not_enrolled``; null in the paper's search,
    and with ``hmm``."""


@dataclass(frozen=True, slots=True)
class FrameUsed:
    """A search in motion used a frame.

    With ``--json``, and on the page of ``rig serve``, this event comes while the table rotates, and ``accepted``
    follows when the table has stopped. In a saved run, it comes after its ``accepted``.
    """

    event: Literal["frame_used"] = field(default="frame_used", init=False)
    index: int
    """Index of the view, from 0."""
    azimuth_deg: float
    """Azimuth of the camera around the object; 0° is arbitrary."""
    seconds: float
    """Time since the search began."""
    rejected: int
    """Number of frames in motion that were rejected so far."""
    name: str
    """Name of the best candidate."""
    probability: float
    """Probability of the best candidate."""
    outcome: Outcome
    """Decision that the search would make now: ``continue``, ``found``, ``ambiguous`` or ``unknown``. It decides only
    when the frames have covered another step of the circle."""


@dataclass(frozen=True, slots=True)
class ObjectChanged:
    """The newest views show another object, or the object was rotated by hand: the dense search begins again."""

    event: Literal["object_changed"] = field(default="object_changed", init=False)
    index: int
    """Index of the view that shows the change, from 0."""
    first: int
    """Index of the first view since the change. The views before do not count in the answer."""
    evidence: float
    """Natural logarithm of how much better two objects explain the views than one object."""
    needed: float
    """Evidence from which the search begins again; it is higher if the views before fit no enrolled object closely."""


@dataclass(frozen=True, slots=True)
class Verified:
    """The enrolled views of the leading candidates were compared with the views so far, pixel by pixel.

    A replay does not repeat this comparison: it uses the saved values.
    """

    event: Literal["verified"] = field(default="verified", init=False)
    index: int
    """Index of the last view, from 0."""
    name: str
    """Name of the leading candidate."""
    fit: float
    """Share of the views' contrast that the enrolled views of this candidate explain, at most 1."""
    second: float
    """The same share for the other one of the two likeliest candidates, at most 1; 0 without one."""
    others: float
    """The best of these shares for the next candidates that are no near twins of this one, at most 1; 0 without one."""
    expected: float
    """Share of the contrast that two neighbouring enrolled views of this candidate explain of each other, at most 1."""
    light: float
    """How far the light is from that of the enrollment, from 0 on (`hbr.dense.pixel_fit.PixelFit.light`)."""
    outcome: Outcome
    """Decision after the comparison: ``continue``, ``found``, ``ambiguous`` or ``unknown``."""
    probability: float
    """Probability of this candidate after the comparison."""
    not_enrolled: float
    """Probability that the object on the table is not enrolled, after the comparison."""


@dataclass(frozen=True, slots=True)
class Weighed:
    """All rotations that the dense search weighed before it chose one."""

    rotations_deg: tuple[float, ...]
    """Possible rotations of the camera around the object; positive to the left. The other lists have a value for each
    of them."""
    confusion: tuple[float, ...]
    """Natural logarithm of the probability that two objects are still confused after the rotation."""
    cost: tuple[float, ...]
    """Cost of the motion, in the same unit. The search chose the rotation with the lowest sum of confusion and cost."""
    similarity: tuple[float, ...] | None = None
    """Similarity of the two candidates after the rotation, from 0 to 1; null if no two candidates are compared, and in
    a search in motion."""


@dataclass(frozen=True, slots=True)
class Decided:
    """The search chose the rotation to the next view."""

    event: Literal["decided"] = field(default="decided", init=False)
    index: int
    """Index of the last view before the rotation, from 0."""
    side: Literal["left", "right"]
    """Direction in which the camera moves around the object: ``left`` (counter-clockwise) or ``right``."""
    rotation_deg: float
    """Rotation of the camera around the object; positive to the left."""
    target_deg: float
    """Table angle of the next view."""
    s_left: float | None
    """Sum of the similarities of all pairs of candidates, seen from the left; null if the sides were not compared."""
    s_right: float | None
    """The same sum, seen from the right; null if the sides were not compared."""
    candidates: tuple[str, ...]
    """Names of the candidates that were compared; fewer than two if there is no second candidate."""
    reason: RotationReason
    """Reason of the rotation."""
    note: str = ""
    """Explanation by a custom strategy; otherwise empty."""
    weighed: Weighed | None = None
    """All rotations that the dense search weighed; null in the paper's search, and with ``hmm``."""


@dataclass(frozen=True, slots=True)
class Enrolled:
    """The enrollment of an object is complete. Searches can find the object from now on."""

    event: Literal["enrolled"] = field(default="enrolled", init=False)
    name: str
    """Name of the object."""
    views: int
    """Number of views of the enrollment."""
    retakes: int
    """Number of images that were taken again since the enrollment started or was resumed."""
    seconds: float
    """Time since the enrollment started or was resumed, by the clock of the bench."""


class SkipReason(Worded):
    """Why an object of a tray is skipped."""

    ALREADY_ENROLLED = "already_enrolled", "it is already enrolled"
    OPERATOR = "operator", "as the operator asked"
    ERROR = "error", "because of error {}"


@dataclass(frozen=True, slots=True)
class Item:
    """The next object of a list (`rig enroll --list`)."""

    event: Literal["item"] = field(default="item", init=False)
    number: int
    """Place of the object in the list, from 1."""
    of: int
    """Number of objects in the list."""
    name: str
    """Name of the object."""
    action: str
    """What the program does with the object: ``enroll``, ``resume``, ``replace`` or ``skip``."""
    reason: SkipReason | None = None
    """Why the object is skipped: ``already_enrolled``, ``operator`` (the operator decided it) or ``error``. Null if it
    is not skipped."""
    error_code: int | None = None
    """Code of the error because of which the object is skipped; otherwise null."""


@dataclass(frozen=True, slots=True)
class SimilarObjects:
    """The program measured with the enrolled views what the new object can be confused with."""

    event: Literal["similar_objects"] = field(default="similar_objects", init=False)
    name: str
    """Name of the new object."""
    period_deg: float | None
    """Smallest rotation after which the object looks the same. 360: no such rotation. 0: it looks the same from all
    sides. Null: it has too few views."""
    neighbour_similarity: float | None
    """Mean similarity of neighbouring views; null if the object has too few views."""
    period_similarity: float | None
    """Mean similarity of views that are one period apart. For a period of 0, the lowest mean of all rotations; for 360,
    the highest mean beyond the lowest."""
    objects: tuple[SimilarObject, ...]
    """The most similar enrolled objects, at most three, the one with the largest ``share`` first."""


@dataclass(frozen=True, slots=True)
class EmptyTableImage:
    """`rig empty-table` took and stored the empty-table image. `rejected` can precede this event."""

    event: Literal["empty_table_image"] = field(default="empty_table_image", init=False)
    taken_utc: str
    """Date and time (UTC) of the image."""
    width: int
    """Width of the image in pixels."""
    height: int
    """Height of the image in pixels."""
    images: int
    """Number of images: 1, or one for each azimuth if the camera moves around the object. The measurements are those of
    the one at the table angle 0."""
    turning_share: float | None
    """Share of the image, from 0 to 1, that changed when the table rotated; null if the table could not rotate, or the
    camera moves."""
    agreement: float | None
    """Share of the image's border, from 0 to 1, that did not change when the table rotated, or until the camera came
    back; null if the table could not rotate."""
    evidence: ViewEvidence
    """Measurements of the image."""
    replaced: tuple[dict[str, Any], ...]
    """Problems of the previous empty-table image, each with its ``code`` and its parameters."""
    seconds: float
    """Duration of the command by the clock of the bench."""
    image_bgr: Image = field(repr=False)


@dataclass(frozen=True, slots=True)
class Warned:
    """The program noticed something that the operator should check. The plan continues."""

    event: Literal["warned"] = field(default="warned", init=False)
    index: int | None
    """Index of the view at which the program noticed it, from 0; null if it concerns no view."""
    note: Note
    """Code and values of the warning."""


@dataclass(frozen=True, slots=True)
class Waiting:
    """With `--watch`, the plan waits for an object."""

    event: Literal["waiting"] = field(default="waiting", init=False)
    reason: WaitReason
    """What the plan waits for: ``first-object`` (put it on the empty table) or ``next-object``."""


@dataclass(frozen=True, slots=True)
class Failed:
    """With ``--watch``, no view was acceptable (``code`` 600), or no object was on the table (606).

    The plan waits for the next object.
    """

    event: Literal["failed"] = field(default="failed", init=False)
    error: Problem
    """The error."""


class LeftOutReason(StrEnum):
    """Why a view does not count in an answer."""

    OBJECT_CHANGED = "object-changed"


@dataclass(frozen=True, slots=True)
class LeftOut:
    """A view that does not count in an answer."""

    index: int
    """Index of the view, from 0."""
    reason: LeftOutReason
    """Why it does not count: ``object-changed``, because it shows the object that was on the table before."""


@dataclass(frozen=True, slots=True)
class Identified:
    """The answer of an identification."""

    event: Literal["identified"] = field(default="identified", init=False)
    name: str | None
    """Name of the object; the likeliest one if the object is ambiguous, null if it is unknown."""
    candidates: Annotated[tuple[Candidate, ...], Field(min_length=1)]
    """The leading candidates, the best first."""
    score: float
    """Score per view of the first candidate."""
    margin: float
    """Margin after the last view, as in ``ranked``."""
    pose_deg: float
    """Azimuth of the camera around the object at the last view, with the 0° of the object's enrollment."""
    yaw_deg: float | None
    """Counter-clockwise rotation of the object relative to its enrollment; null if it is not known, or if several
    rotations look the same."""
    views: int
    """Number of views that the search used."""
    travelled_deg: float
    """Total rotation of the table, in both directions."""
    seconds: float
    """Duration of the search by the clock of the bench."""
    reason: StopReason
    """Reason why the search ended."""
    outcome: Outcome
    """Kind of answer: ``found``, ``ambiguous`` or ``unknown``."""
    possible: tuple[str, ...]
    """Names of the objects that it may be, the likeliest first: one if it was found, several if it is ambiguous, none
    if it is unknown."""
    yaw_sigma_deg: float | None = None
    """Standard uncertainty of each rotation in ``yaw_set_deg``; null if the rotation is not known, and in the paper's
    search."""
    yaw_set_deg: tuple[float, ...] = ()
    """All rotations that look the same: one without symmetry, n with an n-fold symmetry, none if the rotation is not
    known."""
    period_deg: float | None = None
    """Smallest rotation after which the object looks the same. 360: no such rotation. 0: it looks the same from all
    sides. Null: not known."""
    note: str = ""
    """Explanation by a custom strategy; otherwise empty."""
    min_score: float | None = None
    """Paper's search, and ``hmm``: score below which an object is unknown. Null in the dense search."""
    min_margin: float | None = None
    """Paper's search: margin at which the search ends. Null in the dense search, and with ``hmm``."""
    confidence: float | None = None
    """Dense search, and ``hmm``: probability of the object. Null if the object is ambiguous or unknown, and in the
    paper's search."""
    min_confidence: float | None = None
    """Dense search, and ``hmm``: confidence at which the search ends. Null in the paper's search."""
    not_enrolled: float | None = None
    """Dense search: probability that the object on the table is not enrolled. Null in the paper's search, and with
    ``hmm``."""
    left_out: tuple[LeftOut, ...] = ()
    """Views that the answer does not use; ``views`` does not count them."""


@dataclass(frozen=True, slots=True)
class Recorded:
    """The answer was stored as a result in the catalog."""

    event: Literal["recorded"] = field(default="recorded", init=False)
    result: int
    """Number of the result, for ``rig results show``."""
    sample: str | None
    """Name of the sample that the operator gave; null if none was given."""


Event = (
    Started
    | Moved
    | ScanStarted
    | Unwinding
    | Rejected
    | Accepted
    | Ranked
    | FrameUsed
    | ObjectChanged
    | Verified
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


JsonEvent = Annotated[Event, Discriminator("event")]
"""An event as a type of pydantic: its field ``event`` names its kind."""
DESCRIBED: Final = ConfigDict(
    use_attribute_docstrings=True, json_schema_serialization_defaults_required=True, defer_build=True
)
"""How pydantic describes events in a JSON schema. It parses the sources for that, so only documents use it."""


@cache
def _adapter() -> TypeAdapter[Event]:
    return TypeAdapter(JsonEvent, config=ConfigDict(allow_inf_nan=False))


def event_dict(event: Event) -> dict[str, Any]:
    """Return an event as JSON values; images are left out, and numbers that are not finite are None."""
    values: dict[str, Any] = from_json(_adapter().dump_json(event, fallback=str))
    return values


def event_of(values: Mapping[str, Any]) -> Event:
    """Return the event of JSON values from `event_dict`; its images are empty. Unknown fields are left out.

    Raises `ValueError`: the values are not an event; the text names the field.
    """
    try:
        return _adapter().validate_json(to_json(values), strict=True)
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False, include_input=False)[0]
        raise ValueError(": ".join(map(str, (*first["loc"], first["msg"])))) from error
