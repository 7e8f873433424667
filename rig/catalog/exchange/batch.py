"""Objects that are exported or imported. In a bundle each one is a line of ``objects.jsonl``."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from enum import Enum, unique
from pathlib import Path
from typing import Annotated, Any, NamedTuple, Self

from pydantic import (
    AfterValidator,
    AwareDatetime,
    BaseModel,
    ConfigDict,
    Field,
    field_validator,
    model_validator,
)

from rig.catalog.describing import region_of, unpack
from rig.catalog.records import (
    EnrollmentStatus,
    PackedDescriptor,
    Region,
    as_json,
    check_text,
    clean_name,
)
from rig.core.errors import RigError
from rig.views.segmentation_evidence import check_evidence

Degrees = Annotated[float, Field(allow_inf_nan=False)]
Azimuth = Annotated[float, Field(ge=0, lt=360)]
Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
Json = dict[str, Any]


def in_utc(time: datetime) -> datetime:
    """Return a time in UTC. ValueError if it is beyond the calendar there."""
    try:
        return time.astimezone(UTC)
    except OverflowError as error:
        raise ValueError("a time beyond the calendar") from error


Time = Annotated[AwareDatetime, AfterValidator(in_utc)]
Integer = Annotated[int, Field(strict=True, lt=2**31)]
"""An integer that every database can store."""

MAX_VIEWS = 10_000
"""Most views of one enrollment: one every 0.036°."""


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class ImageSource(NamedTuple):
    """Source of an image: a file, or a member of a bundle."""

    file: str
    member: str | None = None


class BundledDescriptor(_Part):
    """A `PackedDescriptor` in JSON: ``packed`` as hexadecimal digits."""

    name: Annotated[str, Field(min_length=1, max_length=100)]
    version: Annotated[Integer, Field(ge=1)]
    settings: Json
    packed: Annotated[str, Field(pattern=r"^([0-9a-f]{2})+$", max_length=100_000)]

    @model_validator(mode="after")
    def _is_valid(self) -> Self:
        try:
            unpack([self.as_packed()])
            region_of(self.settings)
        except RigError as error:
            raise ValueError(error.what.rstrip(".")) from error
        as_json(self.settings, "The settings of a descriptor")
        return self

    def as_packed(self) -> PackedDescriptor:
        return PackedDescriptor(self.name, self.version, self.settings, bytes.fromhex(self.packed))


class View(_Part):
    """A view; ``image`` is the path of its image in the bundle, ``session`` the index of its session."""

    index: Annotated[Integer, Field(ge=0, lt=MAX_VIEWS)]
    session: Annotated[Integer, Field(ge=0)]
    azimuth_deg: Azimuth
    commanded_deg: Degrees | None = None
    encoder_deg: Degrees | None = None
    imu_deg: Degrees | None = None
    imu_sigma_deg: Annotated[float, Field(ge=0, allow_inf_nan=False)] | None = None
    captured_utc: Time | None = None
    captured_ns: Annotated[int, Field(strict=True, ge=-(2**63), lt=2**63)] | None = None
    image: str
    image_sha256: Sha256 | None = None
    image_bytes: Annotated[Integer, Field(ge=1)] | None = None
    evidence: Json = {}
    segmentation: Json | None = None
    descriptors: tuple[BundledDescriptor, ...] = ()

    @field_validator("segmentation")
    @classmethod
    def _has_codes(cls, segmentation: Json | None) -> Json | None:
        try:
            if segmentation is not None:
                check_evidence(segmentation)
        except TypeError as error:
            raise ValueError(str(error)) from error
        return segmentation

    @model_validator(mode="after")
    def _is_whole(self) -> Self:
        if (self.imu_deg is None) != (self.imu_sigma_deg is None):
            raise ValueError("imu_deg and imu_sigma_deg: give both or none")
        if len({(one.name, one.version) for one in self.descriptors}) < len(self.descriptors):
            raise ValueError("a descriptor is listed twice in the same version")
        as_json(self.evidence, "The evidence")
        as_json(self.segmentation or {}, "The segmentation")
        return self


class Session(_Part):
    """A session: `rig.catalog.Session` in JSON."""

    started_utc: Time
    bench: str
    software: str
    devices: Json = {}
    conditions: Json = {}
    empty_table_image: str | None = None
    empty_table_image_sha256: Sha256 | None = None
    empty_table_image_bytes: Annotated[int | None, Field(ge=1)] = None

    @model_validator(mode="after")
    def _is_json(self) -> Self:
        as_json(self.devices, "The devices")
        as_json(self.conditions, "The conditions")
        return self


class Enrollment(_Part):
    """An enrollment with its sessions and views."""

    status: EnrollmentStatus
    started_utc: Time
    finished_utc: Time | None = None
    planned_azimuth_deg: Annotated[tuple[Azimuth, ...], Field(min_length=1, max_length=MAX_VIEWS)]
    sessions: Annotated[tuple[Session, ...], Field(max_length=MAX_VIEWS)]
    views: Annotated[tuple[View, ...], Field(max_length=MAX_VIEWS)]

    @model_validator(mode="after")
    def _is_whole(self) -> Self:
        indices = {view.index for view in self.views}
        if len(indices) < len(self.views):
            raise ValueError("a view is listed twice")
        if not indices <= set(range(len(self.planned_azimuth_deg))):
            raise ValueError(f"a view is not one of the {len(self.planned_azimuth_deg)} planned ones")
        if any(view.session >= len(self.sessions) for view in self.views):
            raise ValueError("the session of a view is missing")
        if self.status == EnrollmentStatus.COMPLETE and len(indices) < len(self.planned_azimuth_deg):
            raise ValueError(
                f"its status is complete, but it has {len(indices)} of {len(self.planned_azimuth_deg)} planned views"
            )
        if (self.finished_utc is None) != (self.status == EnrollmentStatus.IN_PROGRESS):
            raise ValueError("finished_utc is missing, or the enrollment is in progress and has one")
        return self


class Object(_Part):
    """An object with its enrollments, oldest first."""

    name: str
    label: str = ""
    note: str = ""
    created_utc: Time
    enrollments: Annotated[tuple[Enrollment, ...], Field(max_length=MAX_VIEWS)]

    @field_validator("name")
    @classmethod
    def _is_clean(cls, name: str) -> str:
        if clean_name(name) != name:
            raise ValueError("the name has outer spaces or is not composed (NFC)")
        return name

    @model_validator(mode="after")
    def _is_whole(self) -> Self:
        check_text(self.label, "label")
        check_text(self.note, "note")
        for status in (EnrollmentStatus.COMPLETE, EnrollmentStatus.IN_PROGRESS):
            if sum(enrollment.status == status for enrollment in self.enrollments) > 1:
                raise ValueError(f"two enrollments have the status {status}")
        return self


ExportedObject = tuple[Object, dict[str, Path]]
"""An object, and the files of its images by their paths in the export."""


@unique
class ImportProblem(Enum):
    """A reason why a file is not imported: the name is its code, the value the template of its text."""

    NOT_A_FILE = "is not a file"
    LINK_OUTSIDE = "is a link to a file outside the folder"
    NAME_PATTERN = "does not match the pattern {pattern}"
    SAME_AZIMUTH = "shows {name!r} from the same azimuth as {other}"
    INVALID_VALUE = "{error}"
    UNREADABLE = "cannot be read: {error}"
    INVALID_IMAGE = "cannot be used: {error}"
    OTHER_IMAGE = "is not the stored image"
    NOT_DESCRIBED = "cannot be described: {error}"
    DESCRIPTOR_NOT_CHECKED = "its descriptor {name} cannot be checked: {error}"
    OTHER_DESCRIPTOR = "its descriptor {name} is not that of the image"


@dataclass(frozen=True, slots=True)
class Reason:
    """An `ImportProblem` with the values of its text."""

    code: ImportProblem
    values: dict[str, Any] = field(default_factory=dict)

    def __str__(self) -> str:
        return self.code.value.format_map(self.values)


@dataclass(frozen=True, slots=True)
class RejectedFile:
    """A file that is not imported, and why."""

    path: str
    reason: Reason

    def as_json(self) -> dict[str, Any]:
        """Return the file with the code and the text of the reason."""
        code = self.reason.code.name.lower()
        return {"path": self.path, "code": code, "values": self.reason.values, "reason": str(self.reason)}


@dataclass(frozen=True, slots=True)
class Gap:
    """A view that is missing in the even spacing of the others."""

    object_name: str
    azimuth_deg: float


@dataclass(frozen=True, slots=True)
class ImportBatch:
    """Objects to be imported.

    Attributes
    ----------
    origin
        The file, folder or catalog that they come from.
    sources
        Source of each image of the objects.
    regions
        Part of the image to describe, for images without descriptors; the whole image if there is none.
    strict
        One rejected image rejects the whole batch, as for a bundle.
    """

    origin: str
    objects: tuple[Object, ...]
    sources: dict[str, ImageSource]
    regions: dict[str, Region] = field(default_factory=dict)
    rejected: tuple[RejectedFile, ...] = ()
    gaps: tuple[Gap, ...] = ()
    strict: bool = False

    @property
    def views(self) -> int:
        """Number of views of all objects."""
        return sum(len(enrollment.views) for item in self.objects for enrollment in item.enrollments)


def region_of_view(view: View) -> Region | None:
    """Return the part of its image that a view is described within; None for the whole image."""
    return region_of(view.descriptors[0].settings) if view.descriptors else None


def gaps(objects: Sequence[Object]) -> list[Gap]:
    """Return the missing views of objects that are seen from most sides at even steps; each has its own step."""
    return [Gap(item.name, azimuth_deg) for item in objects for azimuth_deg in _gaps(item)]


def _gaps(item: Object) -> list[float]:
    ring = sorted(item.enrollments[-1].planned_azimuth_deg)
    if len(ring) < 2:
        return []
    steps = sorted((after - before) % 360 for before, after in zip(ring, [*ring[1:], ring[0]], strict=True))
    step_deg = steps[(len(steps) - 1) // 2]
    slots = round(360 / step_deg) if step_deg else 0
    if slots < 4 or abs(360 / slots - step_deg) > 0.1 * step_deg:
        return []  # no even steps
    step_deg = 360 / slots
    start_deg = ring[0] % step_deg
    seen = {round((azimuth_deg - start_deg) / step_deg) % slots for azimuth_deg in ring}
    if 2 * len(seen) <= slots:
        return []  # seen from one side only, for example within the limits of a table that pans
    return [math.fmod(start_deg + slot * step_deg, 360.0) for slot in range(slots) if slot not in seen]


def region_text(region: Region | None) -> str:
    """Return a region as text for a table: x y width height; empty for the whole image."""
    return "" if region is None else " ".join(map(str, region))


def parse_region(text: str) -> Region | None:
    """Parse the text of `region_text`. ValueError if it is not a region."""
    if not text.strip():
        return None
    numbers = re.split(r"[ ,]+", text.strip())
    if len(numbers) != 4 or not all(re.fullmatch("[0-9]{1,6}", number) for number in numbers):
        raise ValueError(f"the region {text!r} is not of the form x y width height, in pixels")
    x, y, width, height = map(int, numbers)
    return x, y, width, height
