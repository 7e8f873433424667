"""The schema of events in the OpenAPI document: those of a saved run, and those of the stream."""

from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from pydantic import BaseModel, Discriminator, GetJsonSchemaHandler, RootModel
from pydantic_core import CoreSchema

from rig.events.events import DESCRIBED, Event, JsonEvent


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
