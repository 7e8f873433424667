"""What the API answers, but for errors: lists, persons, objects, and events of a saved run and of the stream."""

from dataclasses import dataclass, field
from datetime import datetime
from typing import Annotated, Any, Generic, Literal, TypeVar

from fastapi import Response
from fastapi.responses import StreamingResponse
from pydantic import BaseModel, ConfigDict, Discriminator, GetJsonSchemaHandler, PlainSerializer, RootModel
from pydantic_core import CoreSchema

from rig.catalog.facts import Action
from rig.catalog.records import EnrollmentStatus, Provenance, RecordedOutcome
from rig.catalog.results import ResultRow
from rig.core.errors import Problem
from rig.core.next_steps import NextSteps
from rig.devices.camera import CameraIdentity
from rig.events.events import DESCRIBED, Event, JsonEvent, SimilarObjects
from rig.safety.saved_state import LatchedFault
from rig.safety.supervisor import TableState
from rig.web.access import Role

Row = TypeVar("Row")


def time_text(at: datetime) -> str:
    return at.isoformat(timespec="seconds").replace("+00:00", "Z")


Time = Annotated[datetime, PlainSerializer(time_text, when_used="json")]


class ListOf(BaseModel, Generic[Row]):
    """A page of a list; ``next`` is the value of ``after`` for the next page, or null."""

    items: list[Row]
    total: int
    next: str | None


class Health(BaseModel):
    """The health of the server."""

    status: Literal["ok"] = "ok"
    version: str
    bench_open: bool


class Login(BaseModel):
    """Who is logged in: the name and the role of the token."""

    name: str
    role: Role


class TokenRow(Login):
    """A token without its secret.

    ``expires_utc`` is null if it is always valid, ``used_utc`` if it was not used since the server started.
    """

    created_utc: Time
    expires_utc: Time | None
    used_utc: Time | None


class NewToken(Login):
    """A new token. No other answer has its secret, ``token``."""

    token: str


class LeaseHolder(BaseModel):
    """A person at a browser or program, which ``client`` distinguishes."""

    name: str
    client: str


class LeaseState(BaseModel):
    """Who operates the bench, and for how long without a request; ``taken_from`` had the lease before."""

    holder: str | None
    client: str | None
    taken_from: LeaseHolder | None
    seconds: float


class Me(Login):
    """Who is logged in, and who has the lease."""

    has_lease: bool
    lease: LeaseState


class ServoReading(BaseModel):
    """The last reading of the servo."""

    model: str
    load_percent: float
    voltage_v: float
    temperature_c: float
    moving: bool


class BenchStatus(BaseModel):
    """The state of the bench, the data of the messages ``status``.

    ``job`` is the id of the running job. ``error`` says why the bench is not open; then all that only an open bench
    knows is null. With an open bench, ``error`` says why the queue could not be stored. ``doubt`` says why the table's
    angle must be referenced: then ``table_deg`` is null. ``steps`` are the next steps of the operator. ``region`` is
    the part of the picture that is described: x, y, width and height in pixels. ``locks`` are the settings that the
    camera holds.
    """

    model_config = ConfigDict(extra="forbid", json_schema_serialization_defaults_required=True)

    open: bool = False
    job: str | None = None
    error: Problem | None = None
    picture_age_s: float | None = None
    bench: str | None = None
    state: TableState | None = None
    fault: LatchedFault | None = None
    doubt: str | None = None
    steps: NextSteps | None = None
    limits_deg: tuple[float, float] | None = None
    findings: list[str] | None = None
    camera: CameraIdentity | None = None
    locks: dict[str, Any] | None = None
    region: tuple[int, int, int, int] | None = None
    table_deg: float | None = None
    velocity_dps: float | None = None
    servo: ServoReading | None = None


class OtherBench(BaseModel):
    """A bench of the overview. ``problem`` says why its state is not known; then the rest is null.

    ``job`` is the running job, ``answer`` the last answer of a recent identification, both in words; ``answered_utc``
    is null while that job runs.
    """

    name: str
    address: str
    problem: str | None = None
    status: BenchStatus | None = None
    job: str | None = None
    answer: str | None = None
    answered_utc: str | None = None


class CatalogState(BaseModel):
    """Whether the catalog's server answers: else ``local_copy_utc`` is the time of the copy that is shown.

    ``waiting`` changes are not delivered yet, for these ``reasons``.
    """

    local_copy_utc: str | None
    waiting: int
    reasons: list[str]


class ServerState(BaseModel):
    """The state of the server: the number of open streams of events."""

    listeners: int


class Status(BenchStatus):
    """The state of the bench, of its server and of its catalog."""

    server: ServerState
    catalog: CatalogState


class Stopped(BaseModel):
    """The answer to STOP: with ``ended``, the torque is off. ``answer`` is null if the bench has not confirmed it."""

    ended: bool
    answer: str | None
    status: BenchStatus


class Move(BaseModel):
    """A move of the table, from its beginning at ``utc``. Times are seconds since then, angles the table's.

    Each of the ``goals`` is its time, angle, velocity (°/s) and acceleration (°/s²). The lists from ``time_s`` to
    ``load_percent`` have a value for each reading of the servo, those of the gyro one for each of its samples.
    ``arrived_s`` is the end of the servo's profile, ``settled_s`` the rest, null if the move failed.
    """

    utc: str
    from_deg: float
    to_deg: float | None
    arrived_s: float | None
    settled_s: float | None
    goals: list[tuple[float, float, float, float]]
    time_s: list[float]
    encoder_deg: list[float]
    profile_deg: list[float | None]
    load_percent: list[float]
    gyro_s: list[float]
    gyro_dps: list[float]


class ObjectRow(BaseModel):
    """An object, as `rig.catalog.ObjectSummary`."""

    model_config = ConfigDict(from_attributes=True)

    name: str
    label: str
    note: str
    created_utc: Time
    enrolled_utc: Time | None
    views: int
    unfinished_views: int | None
    deleted_utc: Time | None


class ListedObject(ObjectRow):
    """An object of a list; ``picture`` is the id of its first view."""

    picture: int | None


class EnrollmentRow(BaseModel):
    """An enrollment of an object; ``sessions`` say on which bench, and with which software and calibrations."""

    status: EnrollmentStatus
    started_utc: Time
    finished_utc: Time | None
    planned_views: int
    stored_views: int
    sessions: list[Provenance]


class ViewRow(BaseModel):
    """A view of an object with the measurements of its checks; its image is at ``/views/{id}/image``."""

    model_config = ConfigDict(from_attributes=True)

    id: int
    index: int
    azimuth_deg: float
    evidence: dict[str, Any]
    captured_utc: Time | None


class ObjectWithViews(ObjectRow):
    """An object with its enrollments, the newest first, its views, and the objects that it resembles."""

    enrollments: list[EnrollmentRow]
    views_taken: list[ViewRow]
    similar: SimilarObjects | None


class CorrectionRow(BaseModel):
    """A correction of an answer, with the values after it."""

    time_utc: Time
    operator: str
    outcome: RecordedOutcome
    object: str | None
    sample: str | None
    reason: str


class ListedResult(ResultRow):
    """A recorded answer of a list; ``id`` is its number as a text, for ``after``."""

    id: str


class ResultDetails(ResultRow):
    """A recorded answer with its row, and the ``history`` of its corrections, the oldest first.

    ``answer`` is the event `identified` as it was recorded.
    """

    answer: dict[str, Any]
    history: list[CorrectionRow]


class Deleted(BaseModel):
    """The name of what was deleted."""

    deleted: str


class LogRow(BaseModel):
    """A line of the catalog's log; passwords in its ``details`` are hidden."""

    id: str
    time_utc: Time
    user: str
    host: str
    software: str
    action: Action
    object_name: str | None
    details: dict[str, Any]


class BudgetRow(BaseModel):
    """A source of an uncertainty budget: the ``contribution`` is its standard uncertainty times the ``sensitivity``.

    The contribution is in the unit of the quantity.
    """

    source: str
    kind: Literal["A", "B"]
    uncertainty: float
    unit: str
    sensitivity: float
    contribution: float


class Quantity(BaseModel):
    """A calibrated quantity with its standard ``uncertainty``, and the ``expanded`` one, which is ``k`` times as large.

    ``text`` is value and standard uncertainty in words. The uncertainty is the root of the sum of the squared
    contributions.
    """

    value: float
    unit: str
    text: str
    uncertainty: float
    k: float
    expanded: float
    budget: list[BudgetRow]


class CalibrationRow(BaseModel):
    """A calibration that was run, with its worst ``residual`` and the ``limit`` for it.

    ``id`` is the name by which a stored view refers to it. It was compared with the ``reference``. If ``valid_until``
    is null, it is valid until a device changes.
    """

    id: str
    name: str
    when_utc: Time
    passed: bool
    residual: float | None
    limit: float | None
    unit: str
    valid_until: Time | None
    reference: str
    operator: str
    software: str
    rejections: list[str]
    quantities: dict[str, Quantity]


class Calibrations(BaseModel):
    """The calibrations that were run, the newest first.

    ``available`` are those that a job can run, with their titles; ``unreadable`` says which files cannot be read.
    """

    history: list[CalibrationRow]
    available: dict[str, str]
    unreadable: list[str]


class Setting(BaseModel):
    """A key of the configuration: ``value`` is in force, ``saved`` is that of the file; null if it has none.

    ``editable`` says whether a page may change it. ``choices`` are its values as text if they are few, else empty.
    """

    key: str
    value: Any
    saved: Any
    default: Any
    allowed: str
    choices: list[str]
    unit: str
    description: str
    editable: bool


class Settings(BaseModel):
    """The keys of the configuration, and its ``file``, which pages change."""

    keys: list[Setting]
    file: str | None


class SettingChange(BaseModel):
    """The lines of the file that were changed: removed ones with ``-``, added ones with ``+``."""

    changed: list[str]


class ShelfState(BaseModel):
    """A simulated bench: the ``things`` on its shelf, the ``object`` on the table, its light and its faults."""

    things: list[str]
    object: str | None
    light: float
    faults: list[str]


class RunCheck(BaseModel):
    """What a saved run gives when it is computed again: the ``differences`` in words, none if all is as saved."""

    views: int
    decisions: int
    is_complete: bool
    differences: list[str]


class RunName(BaseModel):
    """The name of a saved run."""

    name: str


class JobEvents(BaseModel):
    """The events of a job so far, as the messages ``plan`` of the stream, and the id after which a stream continues."""

    items: list[dict[str, Any]]
    last: str


class SavedRunBody(BaseModel):
    """The events of a saved run. Each also has ``text``: the event in words, empty if it has none."""

    model_config = DESCRIBED

    name: str
    started_utc: str
    bench: str
    events: list[JsonEvent]


@dataclass(frozen=True, slots=True)
class NoteMessage:
    """A remark or a progress of a job, with its words in ``text`` and ``steps``."""

    event: Literal["note"] = field(default="note", init=False)


class JobMessage(RootModel[Annotated[Event | NoteMessage, Discriminator("event")]]):
    """An event of the running job: the data of the messages ``plan`` of the stream, as JSON text.

    It also has ``job`` (the id) and ``text`` (the event in words), and if the operator should do something, ``steps``
    as an error has them. ``accepted`` also has ``picture`` (the number of the
    view in ``/jobs/{job_id}/views/{number}``) and ``outline_px`` of the object: ``box`` (x, y, width, height) and
    ``points``, or null.
    """

    model_config = DESCRIBED

    @classmethod
    def __get_pydantic_json_schema__(cls, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        return {"type": "string", "contentMediaType": "application/json", "contentSchema": handler(schema)}


# -- other content than JSON: FastAPI describes a response by its media type -------------------------------------------


class Jpeg(Response):
    """A picture."""

    media_type = "image/jpeg"


class Svg(Response):
    """A chart."""

    media_type = "image/svg+xml"


class Bundle(StreamingResponse):
    """A catalog in a file."""

    media_type = "application/zip"


class EventStream(StreamingResponse):
    """Server-sent events."""

    media_type = "text/event-stream"
