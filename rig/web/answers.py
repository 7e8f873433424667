"""What the API answers, but for errors: lists, persons, objects, and events of a saved run and of the stream."""

from dataclasses import dataclass, field
from datetime import datetime
from typing import Annotated, Any, Generic, Literal, TypeVar

from fastapi import Response
from fastapi.responses import StreamingResponse
from pydantic import BaseModel, ConfigDict, Discriminator, GetJsonSchemaHandler, PlainSerializer, RootModel
from pydantic_core import CoreSchema

from rig.catalog.records import EnrollmentStatus, RecordedOutcome
from rig.events.events import DESCRIBED, Event, JsonEvent
from rig.web.access import Role

Row = TypeVar("Row")


def time_text(at: datetime) -> str:
    return at.isoformat(timespec="seconds").replace("+00:00", "Z")


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
    """Who is logged in."""

    name: str
    role: Role


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


class Stopped(BaseModel):
    """The answer to STOP: with ``ended``, the torque is off. ``answer`` is null if the bench has not confirmed it."""

    ended: bool
    answer: str | None
    status: dict[str, Any]


Time = Annotated[datetime, PlainSerializer(time_text, when_used="json")]


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
    sessions: list[dict[str, Any]]


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
    similar: dict[str, Any] | None


class CorrectionRow(BaseModel):
    """A correction of an answer, with the values after it."""

    time_utc: Time
    operator: str
    outcome: RecordedOutcome
    object: str | None
    sample: str | None
    reason: str


class ResultDetails(BaseModel):
    """A recorded answer, with the fields of a row of ``/results``.

    ``object``, ``outcome`` and ``sample`` are those after the last of the ``history`` of corrections, which is oldest
    first. ``answer`` is the event `identified` as it was recorded, with the probability ``not_enrolled``.
    """

    model_config = ConfigDict(extra="allow")

    result: int
    outcome: RecordedOutcome
    object: str | None
    sample: str | None
    answer: dict[str, Any]
    history: list[CorrectionRow]


class Deleted(BaseModel):
    """The name of an object that was deleted."""

    deleted: str


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
