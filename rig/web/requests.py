"""The jobs that clients ask for, a model for each kind, and what a job looks like."""

from enum import StrEnum
from typing import Annotated, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from rig.core.errors import Problem
from rig.core.next_steps import NextSteps
from rig.events.events import Enrolled, Identified
from rig.jobs.doctor import Examined
from rig.jobs.enroll import ViewsTakenAgain
from rig.jobs.table import Acknowledged, TableAngle
from rig.plans.operator import Choice


class RequestBody(BaseModel):
    """A part of a request; an unknown key is a mistake."""

    model_config = ConfigDict(extra="forbid", frozen=True)


Name = Annotated[str, Field(min_length=1, max_length=100, examples=["mug-white"])]
Views = Annotated[int | None, Field(ge=4, le=720, description="views in a revolution; default: enroll.views")]
Fly = Annotated[
    bool | None, Field(description="take the views while the table rotates, or at rest; default: enroll.mode")
]


class TrayObject(RequestBody):
    """An object of a tray."""

    name: Name
    label: Annotated[str | None, Field(max_length=1000)] = None
    note: Annotated[str | None, Field(max_length=10_000)] = None
    views: Views = None


class EnrollRequest(TrayObject):
    """Enroll the object on the table."""

    kind: Literal["enroll"] = "enroll"
    resume: bool = Field(False, description="take the missing views of an interrupted enrollment")
    replace: bool = Field(False, description="enroll again; the old views stay in use until the new ones are complete")
    fly: Fly = None


class RetakeRequest(RequestBody):
    """Take views of an object again, which must stand as it stood; the present ones stay until all are taken."""

    kind: Literal["retake"] = "retake"
    name: Name
    views: Annotated[
        list[Annotated[int, Field(ge=0, lt=10_000)]],
        Field(min_length=1, max_length=10_000, description="`index` of each view in GET /api/v1/objects/{name}"),
    ]


class TrayRequest(RequestBody):
    """Enroll several objects one after the other. The job asks for each object, and skips those that are complete."""

    kind: Literal["tray"] = "tray"
    objects: Annotated[list[TrayObject], Field(min_length=1, max_length=1000)]
    views: Views = None
    fly: Fly = None


class IdentifyRequest(RequestBody):
    """Identify the object on the table. ``sample`` names one object; with ``watch``, ``scan`` asks for each one."""

    kind: Literal["identify"] = "identify"
    max_views: Annotated[int | None, Field(ge=1, le=72, description="default: identify.max_views")] = None
    strategy: Annotated[str | None, Field(max_length=100, description="default: identify.strategy")] = None
    watch: bool = Field(False, description="wait for the next object after each answer")
    sample: Annotated[
        str | None, Field(max_length=100, description="sample on the table, recorded with the answer")
    ] = None
    scan: bool = Field(False, description="ask for the sample of each object: the answer to the question names it")

    @model_validator(mode="after")
    def _sample_of_one_object(self) -> Self:
        if (self.watch or self.scan) and self.sample is not None:
            raise ValueError(
                "sample names one object, but watch identifies several, and scan asks for the sample of each. Leave "
                "sample out; with scan, the job asks for it"
            )
        return self


class EmptyTableRequest(RequestBody):
    """Take the empty-table image."""

    kind: Literal["empty-table"] = "empty-table"
    anyway: bool = Field(False, description="store the image although something rotates with the table")


class GotoRequest(RequestBody):
    """Rotate the table to an angle."""

    kind: Literal["goto"] = "goto"
    angle_deg: Annotated[float, Field(ge=-36_000, le=36_000, allow_inf_nan=False, examples=[90.0])]


class HomeRequest(RequestBody):
    """Rotate the table to its home."""

    kind: Literal["home"] = "home"


class ReferenceRequest(RequestBody):
    """Set the table's angle after the operator has looked at the cable. Moves nothing."""

    kind: Literal["reference"] = "reference"
    revolutions: Annotated[
        int | None,
        Field(ge=-100, le=100, description="revolutions that the cable is wound up"),
    ] = None
    here: bool = Field(False, description="the present angle is home, with the cable hanging free")


class AcknowledgeRequest(RequestBody):
    """Acknowledge the latched fault."""

    kind: Literal["acknowledge"] = "acknowledge"
    reboot: bool = Field(False, description="restart the servo first, which clears its hardware errors")


class DoctorRequest(RequestBody):
    """Check everything that the bench needs. Moves nothing."""

    kind: Literal["doctor"] = "doctor"


class CameraSettings(RequestBody):
    """Locked settings of the camera."""

    exposure_us: Annotated[float | None, Field(ge=1, le=1e6)] = None
    gain: Annotated[float | None, Field(ge=0, le=1e6)] = None
    white_balance_k: Annotated[float | None, Field(ge=1000, le=20_000)] = None
    focus: Annotated[float | None, Field(ge=0, le=1e6)] = None


class CameraRequest(CameraSettings):
    """Open the camera again with other locked settings; what is missing stays. They last until the server ends."""

    kind: Literal["camera"] = "camera"


class CalibrateRequest(RequestBody):
    """Run a calibration."""

    kind: Literal["calibrate"] = "calibrate"
    name: Annotated[str, Field(max_length=50, description="one of GET /api/v1/calibrations", examples=["servo"])]
    object: Annotated[str | None, Field(max_length=100, description="object to use, for the calibration noise")] = None


JobRequest = Annotated[
    EnrollRequest
    | RetakeRequest
    | TrayRequest
    | IdentifyRequest
    | EmptyTableRequest
    | GotoRequest
    | HomeRequest
    | ReferenceRequest
    | AcknowledgeRequest
    | DoctorRequest
    | CameraRequest
    | CalibrateRequest,
    Field(discriminator="kind"),
]


class JobQuestion(RequestBody):
    """What a job asks the operator. With ``takes_sample``, the answer may name the sample on the table."""

    text: str
    choices: tuple[Choice, ...]
    steps: Annotated[NextSteps, Field(description="what to do first, as the steps of an error")] = ()
    takes_sample: bool = False


class CalibrationRun(RequestBody):
    """A calibration that a job has run, with its outcome in words."""

    name: str
    passed: bool
    text: str


class Calibrated(RequestBody):
    """The result of a job ``calibrate``."""

    calibrations: list[CalibrationRun]


JobOutcome = (
    Enrolled | ViewsTakenAgain | Identified | TableAngle | Acknowledged | Examined | CameraSettings | Calibrated
)


class JobState(StrEnum):
    """State of a job."""

    PROPOSED = "proposed"
    QUEUED = "queued"
    RUNNING = "running"
    WAITING = "waiting"
    PAUSED = "paused"
    DONE = "done"
    FAILED = "failed"
    CANCELLED = "cancelled"
    INTERRUPTED = "interrupted"

    @property
    def ended(self) -> bool:
        return self in (JobState.DONE, JobState.FAILED, JobState.CANCELLED, JobState.INTERRUPTED)


class StepsDone(RequestBody):
    """Progress of a job: steps done of all steps, and the expected time left."""

    done: int
    total: int
    seconds_left: float | None = None


class Job(BaseModel):
    """A job of the bench.

    ``key`` is the header ``Idempotency-Key`` of its request. ``resume`` is the request that continues the job's work;
    None if there is nothing to continue. ``result`` is the last important event of the plan, or what a job without one
    found. A proposed job waits until an operator approves it.
    """

    id: str
    request: JobRequest
    state: JobState
    created_utc: str
    operator: str
    key: str | None = None
    approved_by: str | None = Field(None, description="who approved a proposed job")
    started_utc: str | None = None
    ended_utc: str | None = None
    progress: StepsDone | None = None
    question: JobQuestion | None = None
    result: JobOutcome | None = None
    result_text: str = ""
    error: Problem | None = None
    resume: JobRequest | None = None
    run: str | None = Field(None, description="saved run of an identification, for GET /api/v1/runs/{run}")
    views: int = Field(0, description="number of pictures at GET /api/v1/jobs/{id}/views/{n}")
