"""What goes into a catalog and what comes out of it."""

import json
import math
import operator
import unicodedata
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime
from enum import StrEnum
from importlib import metadata
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rig.core.errors import UsageError

MAX_NAME_LENGTH: Final = 100

JsonObject = Mapping[str, Any]
Region = tuple[int, int, int, int]
"""Part of an image: x, y, width, height in pixels."""


class EnrollmentStatus(StrEnum):
    """Where an enrollment stands; an object is retrieved through its one complete enrollment."""

    IN_PROGRESS = "in progress"
    COMPLETE = "complete"
    ABANDONED = "abandoned"
    SUPERSEDED = "superseded"


def this_software() -> str:
    """Return the name and version of this program."""
    try:
        return f"hbr-rig {metadata.version('hbr-rig')}"
    except metadata.PackageNotFoundError:
        return "hbr-rig, not installed"


@dataclass(frozen=True, slots=True)
class Provenance:
    """What views were taken with.

    Parameters
    ----------
    bench
        Name of the bench.
    devices
        Identities of servo, IMU and camera (models, serials, firmware), as JSON values.
    conditions
        Noise model, calibrations and settings in use, as JSON values.
    software
        Name and version of the program.

    Raises
    ------
    UsageError
        The devices or conditions are not JSON.
    """

    bench: str
    devices: JsonObject
    conditions: JsonObject = field(default_factory=dict)
    software: str = field(default_factory=this_software)

    def __post_init__(self) -> None:
        object.__setattr__(self, "devices", as_json(self.devices, "the identities of the devices"))
        object.__setattr__(self, "conditions", as_json(self.conditions, "the conditions"))


@dataclass(frozen=True, slots=True)
class Sitting:
    """An uninterrupted part of an enrollment; the bench clock of its views has one origin.

    `reference_image` shows the empty table, relative to the catalog's folder, where one was stored.
    """

    id: int
    started_utc: datetime
    provenance: Provenance
    reference_image: str | None = None


@dataclass(frozen=True, slots=True, eq=False)
class ViewRecord:
    """A view of an object, its descriptor and the evidence on which it was accepted.

    Parameters
    ----------
    index
        Place in the plan of the enrollment, from 0.
    commanded_deg, encoder_deg
        Table angle asked for and read, unwrapped; None of views that no bench has taken.
    azimuth_deg
        Orientation of the camera around the object, in [0, 360).
    descriptor : uint8 array (144,)
        CEDD levels 0..7; None of a stored view that has none (`rig catalog redescribe`).
    captured_ns
        Start of the exposure on the bench's clock; None of views that no bench has taken.
    imu_deg, imu_sigma_deg
        Table angle by the IMU, unwrapped, and its standard uncertainty; both None where there is none.
    evidence
        The numbers it was judged by (sharpness, exposure, settling, locks), units in the keys, as JSON values.
    region
        The part of the image that is described: x, y, width, height in pixels; None for all of it.
    segmentation
        What found the object in the image and balanced its colours, or why it did not, as JSON values; None where
        nothing tried.
    further : mapping of name to uint8 array
        Levels by further descriptors (`hbr.descriptors`), to be stored beside CEDD.

    Raises
    ------
    UsageError
        A number is out of range or not finite, or the evidence is not JSON.
    """

    index: int
    commanded_deg: float | None
    encoder_deg: float | None
    azimuth_deg: float
    descriptor: NDArray[np.uint8] | None
    captured_ns: int | None
    imu_deg: float | None = None
    imu_sigma_deg: float | None = None
    evidence: JsonObject = field(default_factory=dict)
    region: Region | None = None
    segmentation: JsonObject | None = None
    further: Mapping[str, NDArray[np.uint8]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ("index", "captured_ns"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, operator.index(getattr(self, name)))
        for name in ("commanded_deg", "encoder_deg", "azimuth_deg", "imu_deg", "imu_sigma_deg"):
            value = getattr(self, name)
            if value is None:
                continue
            if not math.isfinite(value):
                raise UsageError(
                    f"view {self.index} has {name} = {value}", next_step="store views with angles that were measured"
                )
            object.__setattr__(self, name, float(value))
        if self.index < 0:
            raise UsageError(f"view index {self.index} is negative", next_step="number the views of a plan from 0")
        if (self.imu_deg is None) != (self.imu_sigma_deg is None):
            raise UsageError(
                f"view {self.index} has an IMU angle of {self.imu_deg} with an uncertainty of {self.imu_sigma_deg}",
                next_step="give both, or None for both where the IMU has no answer",
            )
        check_azimuth(self.azimuth_deg)
        if self.imu_sigma_deg is not None and self.imu_sigma_deg < 0:
            raise UsageError(
                f"view {self.index} has imu_sigma_deg = {self.imu_sigma_deg}",
                next_step="give the standard uncertainty, which is not negative",
            )
        object.__setattr__(self, "evidence", as_json(self.evidence, f"the evidence of view {self.index}"))
        if self.segmentation is not None:
            object.__setattr__(
                self, "segmentation", as_json(self.segmentation, f"what the front end says of view {self.index}")
            )
        if self.region is not None:
            object.__setattr__(self, "region", tuple(operator.index(number) for number in self.region))


@dataclass(frozen=True, slots=True, eq=False)
class StoredView:
    """A view as the catalog keeps it; `image` is relative to the catalog's folder."""

    id: int
    object_name: str
    enrollment_id: int
    sitting: Sitting
    record: ViewRecord
    captured_utc: datetime | None
    image: str
    image_sha256: str
    image_bytes: int


@dataclass(frozen=True, slots=True)
class EnrollmentSummary:
    """An enrollment: `planned_azimuth_deg` of view 0, 1, ..., and which of them are `present`, ascending."""

    id: int
    status: EnrollmentStatus
    started_utc: datetime
    finished_utc: datetime | None
    planned_azimuth_deg: tuple[float, ...]
    present: tuple[int, ...]
    sittings: tuple[Sitting, ...]

    @property
    def missing(self) -> tuple[int, ...]:
        """Indices of the planned views that are not stored yet, ascending."""
        return tuple(sorted(set(range(len(self.planned_azimuth_deg))) - set(self.present)))


@dataclass(frozen=True, slots=True)
class ObjectSummary:
    """An object: `views` of its complete enrollment, and those of an `unfinished` one where there is one."""

    name: str
    label: str
    note: str
    created_utc: datetime
    enrolled_utc: datetime | None
    views: int
    unfinished_views: int | None
    deleted_utc: datetime | None = None


@dataclass(frozen=True, slots=True, eq=False)
class ObjectDetails:
    """An object with its enrollments, newest first, and the views of the complete one, by index."""

    summary: ObjectSummary
    enrollments: tuple[EnrollmentSummary, ...]
    views: tuple[StoredView, ...]


def clean_name(name: str) -> str:
    """Return the name of an object as the catalog stores and compares it: composed (NFC), without outer blanks.

    Raises
    ------
    UsageError
        The name is empty, longer than 100 characters or holds characters that cannot be printed.
    """
    cleaned = unicodedata.normalize("NFC", name).strip()
    if not cleaned:
        raise UsageError("the name of the object is empty", next_step="give a name, such as mug-white")
    if not cleaned.isprintable():
        raise UsageError(
            f"the name {cleaned!r} holds characters that cannot be printed", next_step="leave them out of the name"
        )
    if len(cleaned) > MAX_NAME_LENGTH:
        raise UsageError(
            f"the name has {len(cleaned)} characters, {MAX_NAME_LENGTH} are allowed",
            next_step="shorten the name and put the rest into the note",
        )
    return cleaned


def check_text(text: str, what: str) -> None:
    """Refuse text that cannot be stored, such as bytes of another encoding from a terminal, with a `UsageError`."""
    try:
        text.encode()
    except UnicodeEncodeError as error:
        raise UsageError(f"the {what} {text!r} is not text", next_step="type it in UTF-8") from error


def check_azimuth(azimuth_deg: float) -> None:
    """Refuse an azimuth outside [0, 360) with a `UsageError`."""
    if not 0 <= azimuth_deg < 360:
        raise UsageError(f"an azimuth of {azimuth_deg} deg", next_step="wrap azimuths to [0, 360) deg")


def as_json(values: JsonObject, what: str) -> dict[str, Any]:
    """Return the values as they will be read back from JSON; numpy scalars become Python's."""
    try:
        plain: dict[str, Any] = json.loads(json.dumps(dict(values), allow_nan=False, default=_plain_scalar))
    except (TypeError, ValueError) as error:
        raise UsageError(
            f"{what} cannot be kept as JSON: {error}",
            next_step="use text, finite numbers, true, false, lists and mappings, and None for what is unknown",
        ) from error
    return plain


def _plain_scalar(value: object) -> object:
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{value!r} is of type {type(value).__name__}")
