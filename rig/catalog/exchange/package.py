"""Objects on their way into or out of a catalog; in JSON one line of a bundle's ``objects.jsonl`` each."""

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, NamedTuple, Self

from pydantic import AliasChoices, AwareDatetime, BaseModel, ConfigDict, Field, field_validator, model_validator

from hbr.descriptors import descriptor, names
from rig.catalog.describing import region_of
from rig.catalog.records import EnrollmentStatus, Region, as_json, check_azimuth, check_text, clean_name
from rig.core.errors import UsageError

Degrees = Annotated[float, Field(allow_inf_nan=False)]
Azimuth = Annotated[float, Field(ge=0, lt=360)]
Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
Json = dict[str, Any]

MAX_VIEWS = 10_000
"""Of one enrollment: a view every 0.036°."""


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class ImageSource(NamedTuple):
    """Where the bytes of an image are: a file, or a member of a bundle."""

    file: str
    member: str | None = None


class Levels(_Part):
    """What one version of one descriptor says of a view; ``packed`` in hexadecimal digits."""

    name: Annotated[str, Field(min_length=1, max_length=100)]
    version: Annotated[int, Field(ge=1)]
    settings: Json
    packed: Annotated[str, Field(pattern=r"^([0-9a-f]{2})+$", max_length=100_000)]

    @model_validator(mode="after")
    def _is_of_its_descriptor(self) -> Self:
        if self.name in names() and descriptor(self.name).version == self.version:
            descriptor(self.name).unpack(bytes.fromhex(self.packed))
        as_json(self.settings, "the settings of a descriptor")
        return self


class View(_Part):
    """A view; ``image`` is where its image is in the bundle, ``sitting`` the place of its sitting in the enrollment."""

    index: Annotated[int, Field(ge=0, lt=MAX_VIEWS)]
    sitting: Annotated[int, Field(ge=0)]
    azimuth_deg: Azimuth
    commanded_deg: Degrees | None = None
    encoder_deg: Degrees | None = None
    imu_deg: Degrees | None = None
    imu_sigma_deg: Annotated[float, Field(ge=0, allow_inf_nan=False)] | None = None
    captured_utc: AwareDatetime | None = None
    captured_ns: Annotated[int, Field(ge=-(2**63), lt=2**63)] | None = None
    image: str
    image_sha256: Sha256 | None = None
    image_bytes: Annotated[int, Field(ge=1)] | None = None
    evidence: Json = {}
    segmentation: Json | None = Field(
        default=None,
        validation_alias=AliasChoices("segmentation", "front_end"),  # bundles before version 2
    )
    descriptors: tuple[Levels, ...] = ()

    @model_validator(mode="after")
    def _is_whole(self) -> Self:
        if (self.imu_deg is None) != (self.imu_sigma_deg is None):
            raise ValueError("imu_deg and imu_sigma_deg: both or none")
        if len({(levels.name, levels.version) for levels in self.descriptors}) < len(self.descriptors):
            raise ValueError("the same version of a descriptor is there twice")
        as_json(self.evidence, "the evidence")
        as_json(self.segmentation or {}, "the segmentation")
        return self


class Sitting(_Part):
    """What views were taken with."""

    started_utc: AwareDatetime
    bench: str
    software: str
    devices: Json = {}
    conditions: Json = {}
    reference_image: str | None = None
    reference_image_sha256: Sha256 | None = None
    reference_image_bytes: Annotated[int, Field(ge=1)] | None = None

    @model_validator(mode="after")
    def _is_json(self) -> Self:
        as_json(self.devices, "the devices")
        as_json(self.conditions, "the conditions")
        return self


class Enrollment(_Part):
    """An enrollment with its sittings and views."""

    status: EnrollmentStatus
    started_utc: AwareDatetime
    finished_utc: AwareDatetime | None = None
    planned_azimuth_deg: Annotated[tuple[Azimuth, ...], Field(min_length=1, max_length=MAX_VIEWS)]
    sittings: Annotated[tuple[Sitting, ...], Field(max_length=MAX_VIEWS)]
    views: Annotated[tuple[View, ...], Field(max_length=MAX_VIEWS)]

    @model_validator(mode="after")
    def _is_whole(self) -> Self:
        indices = {view.index for view in self.views}
        if len(indices) < len(self.views):
            raise ValueError("a view is there twice")
        if not indices <= set(range(len(self.planned_azimuth_deg))):
            raise ValueError(f"a view is not one of the {len(self.planned_azimuth_deg)} planned ones")
        if any(view.sitting >= len(self.sittings) for view in self.views):
            raise ValueError("a view is of a sitting that is not there")
        if self.status == EnrollmentStatus.COMPLETE and len(indices) < len(self.planned_azimuth_deg):
            raise ValueError(
                f"it is said to be complete, with {len(indices)} of {len(self.planned_azimuth_deg)} planned views"
            )
        if (self.finished_utc is None) != (self.status == EnrollmentStatus.IN_PROGRESS):
            raise ValueError("an enrollment has a time of its end unless it is in progress")
        return self


class Object(_Part):
    """An object with its enrollments, oldest first."""

    name: str
    label: str = ""
    note: str = ""
    created_utc: AwareDatetime
    enrollments: Annotated[tuple[Enrollment, ...], Field(max_length=MAX_VIEWS)]

    @field_validator("name")
    @classmethod
    def _is_clean(cls, name: str) -> str:
        if clean_name(name) != name:
            raise ValueError("the name has outer blanks or is not composed (NFC)")
        return name

    @model_validator(mode="after")
    def _is_whole(self) -> Self:
        check_text(self.label, "label")
        check_text(self.note, "note")
        for status in (EnrollmentStatus.COMPLETE, EnrollmentStatus.IN_PROGRESS):
            if sum(enrollment.status == status for enrollment in self.enrollments) > 1:
                raise ValueError(f"two enrollments are {status}")
        return self


@dataclass(frozen=True, slots=True)
class Refused:
    """A file that is not taken, and why."""

    path: str
    reason: str


@dataclass(frozen=True, slots=True)
class Gap:
    """A view that lacks in the even spacing of the others."""

    object_name: str
    azimuth_deg: float


@dataclass(frozen=True, slots=True)
class Package:
    """Objects that are to come into a catalog.

    ``sources`` has for every ``image`` of theirs where its bytes are, ``regions`` which part of those to describe that
    are not described yet, where that is not all; ``strict`` says that one bad image spoils all: a bundle is whole or it
    is not one.
    """

    origin: str
    objects: tuple[Object, ...]
    sources: dict[str, ImageSource]
    regions: dict[str, Region] = field(default_factory=dict)
    refused: tuple[Refused, ...] = ()
    gaps: tuple[Gap, ...] = ()
    strict: bool = False

    @property
    def views(self) -> int:
        return sum(len(enrollment.views) for item in self.objects for enrollment in item.enrollments)


class Photograph(NamedTuple):
    """A file that shows an object from an azimuth, and what else is known: fields of `View`, and these texts."""

    path: Path
    name: str
    azimuth_deg: float
    values: dict[str, Any]
    label: str = ""
    note: str = ""
    bench: str = ""
    software: str = ""
    region: Region | None = None


def assemble(
    origin: str, photographs: Iterable[Photograph], refused: Sequence[Refused], now: datetime, software: str
) -> Package:
    """Make a package of photographs: each object one complete enrollment, its views by rising azimuth.

    Two photographs of one object from one azimuth: the first is taken, the other refused.
    """
    by_name: dict[str, dict[float, Photograph]] = {}
    spoiled = list(refused)
    for photograph in photographs:
        try:
            name = clean_name(photograph.name)
            check_azimuth(photograph.azimuth_deg)
        except UsageError as error:
            spoiled.append(Refused(str(photograph.path), error.what))
            continue
        taken = by_name.setdefault(name, {})
        if photograph.azimuth_deg in taken:
            other = taken[photograph.azimuth_deg].path.name
            spoiled.append(Refused(str(photograph.path), f"shows {name!r} from the same azimuth as {other}"))
            continue
        taken[photograph.azimuth_deg] = photograph
    objects = tuple(
        _object(name, [taken[azimuth_deg] for azimuth_deg in sorted(taken)], origin, now, software)
        for name, taken in by_name.items()
    )
    used = [photograph for taken in by_name.values() for photograph in taken.values()]
    return Package(
        origin,
        objects,
        {str(photograph.path): ImageSource(str(photograph.path)) for photograph in used},
        {str(photograph.path): photograph.region for photograph in used if photograph.region is not None},
        tuple(spoiled),
        tuple(gaps(objects)),
    )


def _object(name: str, photographs: Sequence[Photograph], origin: str, now: datetime, software: str) -> Object:
    sat = list(dict.fromkeys((photograph.bench, photograph.software) for photograph in photographs))
    enrollment = Enrollment(
        status=EnrollmentStatus.COMPLETE,
        started_utc=now,
        finished_utc=now,
        planned_azimuth_deg=tuple(photograph.azimuth_deg for photograph in photographs),
        sittings=tuple(
            Sitting(started_utc=now, bench=bench, software=by or software, conditions={"imported_from": origin})
            for bench, by in sat
        ),
        views=tuple(
            View(
                index=index,
                sitting=sat.index((photograph.bench, photograph.software)),
                azimuth_deg=photograph.azimuth_deg,
                image=str(photograph.path),
                **photograph.values,
            )
            for index, photograph in enumerate(photographs)
        ),
    )
    return Object(
        name=name,
        label=next((photograph.label for photograph in photographs if photograph.label), ""),
        note=next((photograph.note for photograph in photographs if photograph.note), ""),
        created_utc=now,
        enrollments=(enrollment,),
    )


def region_of_view(view: View) -> Region | None:
    """Return the part of its image that a view is described within; None for all of it."""
    return region_of(view.descriptors[0].settings) if view.descriptors else None


def gaps(objects: Sequence[Object]) -> list[Gap]:
    """Return the views that lack where an object is to be seen all around at the usual step of all."""
    rings = {item.name: sorted(item.enrollments[-1].planned_azimuth_deg) for item in objects}
    steps = sorted(
        step
        for ring in rings.values()
        if len(ring) > 1
        for step in ((after - before) % 360 for before, after in zip(ring, [*ring[1:], ring[0]], strict=True))
    )
    if not steps:
        return []
    step_deg = steps[len(steps) // 2]
    slots = round(360 / step_deg)
    if slots < 4 or abs(360 / slots - step_deg) > 0.1 * step_deg:
        return []  # no even spacing
    step_deg = 360 / slots
    lacking = []
    for name, ring in rings.items():
        if len(ring) < 2:
            continue
        start_deg = ring[0] % step_deg
        seen = {round((azimuth_deg - start_deg) / step_deg) % slots for azimuth_deg in ring}
        lacking += [
            Gap(name, math.fmod(start_deg + slot * step_deg, 360.0)) for slot in range(slots) if slot not in seen
        ]
    return lacking


def region_words(region: Region | None) -> str:
    """Write a region as it stands in a table: x y width height; nothing for the whole image."""
    return "" if region is None else " ".join(map(str, region))


def parse_region(text: str) -> Region | None:
    """Read a region from a table; ValueError where it is none."""
    if not text.strip():
        return None
    numbers = re.split(r"[ ,]+", text.strip())
    if len(numbers) != 4 or not all(re.fullmatch("[0-9]{1,6}", number) for number in numbers):
        raise ValueError(f"region {text!r} is not x y width height in pixels")
    x, y, width, height = map(int, numbers)
    return x, y, width, height
