"""What several parts of the API answer: pages of lists, the state of the bench, events, and other content than JSON.

A model that a single route answers stands above this route.
"""

from dataclasses import dataclass, field
from typing import Annotated, Any, Generic, Literal, TypeVar

from fastapi import Response
from pydantic import BaseModel, ConfigDict, Discriminator, GetJsonSchemaHandler, RootModel
from pydantic_core import CoreSchema

from rig.core.errors import Problem
from rig.core.next_steps import NextSteps
from rig.devices.camera import CameraIdentity
from rig.events.events import DESCRIBED, Event
from rig.safety.saved_state import LatchedFault
from rig.safety.supervisor import TableState

Row = TypeVar("Row")


class ListOf(BaseModel, Generic[Row]):
    """A page of a list; ``next`` is the value of ``after`` for the next page, or null."""

    items: list[Row]
    total: int
    next: str | None


class Deleted(BaseModel):
    """The name of what was deleted."""

    deleted: str


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


@dataclass(frozen=True, slots=True)
class NoteMessage:
    """A remark or a progress of a job, with its words in ``text`` and ``steps``."""

    event: Literal["note"] = field(default="note", init=False)


class JobMessage(RootModel[Annotated[Event | NoteMessage, Discriminator("event")]]):
    """An event of the running job: the data of the messages ``plan`` of the stream, as JSON text.

    It also has ``job`` (the id) and ``text`` (the event in words), and if the operator should do something, ``steps``
    as an error has them. ``accepted`` also has ``picture``, the number of the view in
    ``/jobs/{job_id}/views/{number}``.
    """

    model_config = DESCRIBED

    @classmethod
    def __get_pydantic_json_schema__(cls, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        return {"type": "string", "contentMediaType": "application/json", "contentSchema": handler(schema)}


class Jpeg(Response):
    """A picture."""

    media_type = "image/jpeg"
