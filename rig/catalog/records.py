"""The records that the catalog stores and returns."""

import json
import math
import operator
import unicodedata
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from enum import StrEnum
from importlib import metadata
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rig.core.control_characters import has_control_characters
from rig.core.errors import UsageError
from rig.core.next_steps import Do

MAX_NAME_LENGTH: Final = 100

JsonObject = Mapping[str, Any]
Region = tuple[int, int, int, int]
"""Part of an image: x, y, width, height in pixels."""


def is_region(value: Sequence[object]) -> bool:
    """Return whether these are x, y, width and height of a part of some image."""
    numbers = [number for number in value if type(number) is int]
    return len(numbers) == len(value) == 4 and min(numbers[:2]) >= 0 and min(numbers[2:]) >= 1


class EnrollmentStatus(StrEnum):
    """State of an enrollment. Searches use the one complete enrollment of each object."""

    IN_PROGRESS = "in progress"
    COMPLETE = "complete"
    ABANDONED = "abandoned"
    SUPERSEDED = "superseded"


class Outcome(StrEnum):
    """Outcome of an identification."""

    FOUND = "found"
    AMBIGUOUS = "ambiguous"
    UNKNOWN = "unknown"


def this_software() -> str:
    """Return the name and version of this program."""
    try:
        return f"hbr-rig {metadata.version('hbr-rig')}"
    except metadata.PackageNotFoundError:
        return "hbr-rig, not installed"


class PackedDescriptor(NamedTuple):
    """The levels of a view by one version of one descriptor, packed.

    ``settings`` name the region of the image that is described (`rig.catalog.describing.region_of`).
    """

    name: str
    version: int
    settings: JsonObject
    packed: bytes


class ImageFile(NamedTuple):
    """An image file of the catalog: its path relative to the catalog's folder, its SHA-256 and its size in bytes."""

    path: str
    sha256: str
    size: int


@dataclass(frozen=True, slots=True)
class Provenance:
    """The bench, devices and settings that took a view.

    Parameters
    ----------
    bench
        Name of the bench.
    devices
        Identities of servo, IMU and camera (models, serials, firmware), as JSON values.
    conditions
        Noise model, calibrations in force and settings, as JSON values.
    software
        Name and version of the program.

    Raises
    ------
    UsageError
        The devices or conditions are not JSON values.
    """

    bench: str
    devices: JsonObject
    conditions: JsonObject = field(default_factory=dict)
    software: str = field(default_factory=this_software)

    def __post_init__(self) -> None:
        object.__setattr__(self, "devices", as_json(self.devices, "The identities of the devices"))
        object.__setattr__(self, "conditions", as_json(self.conditions, "The conditions"))


@dataclass(frozen=True, slots=True)
class Session:
    """An uninterrupted part of an enrollment. Its views share one origin of the bench clock.

    `empty_table_image` is a path relative to the catalog's folder; None if the session has no empty-table image.
    """

    id: int
    started_utc: datetime
    provenance: Provenance
    empty_table_image: str | None = None


@dataclass(frozen=True, slots=True, eq=False)
class ViewRecord:
    """A view of an object, its descriptors and the evidence on which it was accepted.

    Parameters
    ----------
    index
        Position in the plan of the enrollment, from 0.
    commanded_deg, encoder_deg
        Commanded and measured table angle, unwrapped; None for a view that was not taken by a bench.
    azimuth_deg
        Orientation of the camera around the object, in [0, 360).
    descriptors : mapping of name to uint8 array (length,)
        Levels of each descriptor (`hbr.descriptors`). A new view needs ``cedd``. A stored view has those that this
        program can compare; `rig catalog redescribe` adds the others.
    captured_ns
        Start of the exposure on the bench's clock; None for a view that was not taken by a bench.
    imu_deg, imu_sigma_deg
        Table angle measured by the IMU, unwrapped, and its standard uncertainty; both None without an IMU.
    evidence
        The numbers for which the view was accepted (sharpness, exposure, settling, locks) as JSON values. The keys
        contain the units.
    region
        The part of the image that is described: x, y, width, height in pixels; None for the whole image.
    segmentation
        Result of the segmentation as JSON values (`hbr.Segmentation.evidence`); None if no segmentation was made.

    Raises
    ------
    UsageError
        A number is out of range or not finite, or the evidence is not JSON.
    """

    index: int
    commanded_deg: float | None
    encoder_deg: float | None
    azimuth_deg: float
    descriptors: Mapping[str, NDArray[np.uint8]]
    captured_ns: int | None
    imu_deg: float | None = None
    imu_sigma_deg: float | None = None
    evidence: JsonObject = field(default_factory=dict)
    region: Region | None = None
    segmentation: JsonObject | None = None

    def __post_init__(self) -> None:
        def convert(to: Callable[[Any], object], *names: str) -> None:
            for name in names:
                if (value := getattr(self, name)) is not None:
                    object.__setattr__(self, name, to(value))

        convert(operator.index, "index", "captured_ns")
        convert(float, "commanded_deg", "encoder_deg", "azimuth_deg", "imu_deg", "imu_sigma_deg")
        if self.index < 0:
            raise UsageError(f"View index {self.index} is negative.", next_step="Number the views of a plan from 0.")
        for name in ("commanded_deg", "encoder_deg", "azimuth_deg", "imu_deg", "imu_sigma_deg"):
            if not math.isfinite(getattr(self, name) or 0.0):
                raise UsageError(
                    f"View {self.index} has {name} = {getattr(self, name)}.", next_step="Store measured angles."
                )
        check_azimuth(self.azimuth_deg)
        if (self.imu_deg is None) != (self.imu_sigma_deg is None) or (self.imu_sigma_deg or 0.0) < 0:
            raise UsageError(
                f"View {self.index} has an IMU angle of {self.imu_deg} with an uncertainty of {self.imu_sigma_deg}.",
                next_step="Give both, with an uncertainty of 0 or more, or None for both.",
            )
        convert(lambda values: as_json(values, f"The evidence of view {self.index}"), "evidence", "segmentation")
        convert(lambda region: tuple(map(operator.index, region)), "region")
        if self.region is not None and not is_region(self.region):
            raise UsageError(
                f"View {self.index} has the region {self.region}.", next_step="Give x, y, width, height in pixels."
            )


@dataclass(frozen=True, slots=True, eq=False)
class StoredView:
    """A view as the catalog stores it. `image` is a path relative to the catalog's folder."""

    id: int
    object_name: str
    enrollment_id: int
    session: Session
    record: ViewRecord
    captured_utc: datetime | None
    image: str
    image_sha256: str
    image_bytes: int


@dataclass(frozen=True, slots=True)
class EnrollmentSummary:
    """An enrollment: the planned azimuth of view 0, 1, ..., and the indices of the stored views, ascending."""

    id: int
    status: EnrollmentStatus
    started_utc: datetime
    finished_utc: datetime | None
    planned_azimuth_deg: tuple[float, ...]
    present: tuple[int, ...]
    sessions: tuple[Session, ...]

    @property
    def missing(self) -> tuple[int, ...]:
        """Indices of the planned views that are not stored yet, ascending."""
        return tuple(sorted(set(range(len(self.planned_azimuth_deg))) - set(self.present)))


@dataclass(frozen=True, slots=True)
class ObjectSummary:
    """An object: the number of views of its complete enrollment, and of an unfinished one (None if there is none)."""

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
    """An object with its enrollments, newest first, and the views of the complete enrollment, by index."""

    summary: ObjectSummary
    enrollments: tuple[EnrollmentSummary, ...]
    views: tuple[StoredView, ...]


def clean_name(name: str) -> str:
    """Return the name of an object as the catalog stores and compares it: composed (NFC), without outer spaces.

    Raises
    ------
    UsageError
        The name is empty, is longer than 100 characters or contains characters that cannot be printed.
    """
    cleaned = unicodedata.normalize("NFC", name).strip()
    if not cleaned:
        raise UsageError("The name of the object is empty.", next_step="Give a name, such as mug-white.")
    if not cleaned.isprintable():
        raise UsageError(
            f"The name {cleaned!r} contains characters that cannot be printed.", next_step="Remove them from the name."
        )
    if len(cleaned) > MAX_NAME_LENGTH:
        raise UsageError(
            f"The name has {len(cleaned)} characters; at most {MAX_NAME_LENGTH} are allowed.",
            next_step="Shorten the name and put the rest into the note.",
        )
    return cleaned


def check_text(text: str, what: str) -> None:
    """Raise `UsageError` for text that cannot be stored: bytes of another encoding, or control characters."""
    try:
        text.encode()
    except UnicodeEncodeError as error:
        raise UsageError(f"The {what} {text!r} is not valid text.", next_step="Type it in UTF-8.") from error
    if has_control_characters(text):
        raise UsageError(
            f"The {what} {text!r} contains control characters.",
            next_step=("Remove them. Of an enrolled object,", Do.LABEL()),
        )


def checked_texts(label: str | None, note: str | None) -> dict[str, str]:
    """Return the texts of an object that are not None; a `UsageError` if one cannot be stored."""
    given = {key: text for key, text in (("label", label), ("note", note)) if text is not None}
    for key, text in given.items():
        check_text(text, key)
    return given


def check_azimuth(azimuth_deg: float) -> None:
    """Raise `UsageError` for an azimuth outside [0, 360)."""
    if not 0 <= azimuth_deg < 360:
        raise UsageError(f"The azimuth {azimuth_deg}° is not in [0°, 360°).", next_step="Wrap azimuths to [0°, 360°).")


def as_json(values: JsonObject, what: str) -> dict[str, Any]:
    """Return the values as they will be read back from JSON. Numpy scalars become Python scalars."""
    try:
        plain: dict[str, Any] = json.loads(json.dumps(dict(values), allow_nan=False, default=_plain_scalar))
    except (TypeError, ValueError) as error:
        raise UsageError(
            f"{what} cannot be stored as JSON: {error}.",
            next_step="Use text, finite numbers, true, false, None, lists and mappings.",
        ) from error
    return plain


def _plain_scalar(value: object) -> object:
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{value!r} is of type {type(value).__name__}")
