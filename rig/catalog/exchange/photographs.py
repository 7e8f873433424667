"""Photographs that are imported, as a batch of objects."""

from collections.abc import Iterable, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple

from rig.catalog.exchange.batch import (
    Enrollment,
    ImageSource,
    ImportBatch,
    ImportProblem,
    Object,
    Reason,
    RejectedFile,
    Session,
    View,
    gaps,
)
from rig.catalog.records import (
    EnrollmentStatus,
    Region,
    check_azimuth,
    clean_name,
)
from rig.core.errors import UsageError


class Photograph(NamedTuple):
    """An image file of an object at an azimuth. ``values`` are other fields of `View`."""

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
    origin: str, photographs: Iterable[Photograph], rejected: Sequence[RejectedFile], now: datetime, software: str
) -> ImportBatch:
    """Return a batch of photographs. Each object becomes one complete enrollment with views by ascending azimuth.

    If two photographs show an object from the same azimuth, the second one is rejected.
    """
    by_name: dict[str, dict[float, Photograph]] = {}
    all_rejected = list(rejected)
    for photograph in photographs:
        try:
            name = clean_name(photograph.name)
            check_azimuth(photograph.azimuth_deg)
        except UsageError as error:
            all_rejected.append(
                RejectedFile(
                    str(photograph.path), Reason(ImportProblem.INVALID_VALUE, {"error": error.what.rstrip(".")})
                )
            )
            continue
        taken = by_name.setdefault(name, {})
        if photograph.azimuth_deg in taken:
            other = taken[photograph.azimuth_deg].path.name
            reason = Reason(ImportProblem.SAME_AZIMUTH, {"name": name, "other": other})
            all_rejected.append(RejectedFile(str(photograph.path), reason))
            continue
        taken[photograph.azimuth_deg] = photograph
    objects = tuple(
        _object(name, [taken[azimuth_deg] for azimuth_deg in sorted(taken)], origin, now, software)
        for name, taken in by_name.items()
    )
    used = [photograph for taken in by_name.values() for photograph in taken.values()]
    return ImportBatch(
        origin,
        objects,
        {str(photograph.path): ImageSource(str(photograph.path)) for photograph in used},
        {str(photograph.path): photograph.region for photograph in used if photograph.region is not None},
        tuple(all_rejected),
        tuple(gaps(objects)),
    )


def _object(name: str, photographs: Sequence[Photograph], origin: str, now: datetime, software: str) -> Object:
    taken_with = list(dict.fromkeys((photograph.bench, photograph.software) for photograph in photographs))
    enrollment = Enrollment(
        status=EnrollmentStatus.COMPLETE,
        started_utc=now,
        finished_utc=now,
        planned_azimuth_deg=tuple(photograph.azimuth_deg for photograph in photographs),
        sessions=tuple(
            Session(started_utc=now, bench=bench, software=by or software, conditions={"imported_from": origin})
            for bench, by in taken_with
        ),
        views=tuple(
            View(
                index=index,
                session=taken_with.index((photograph.bench, photograph.software)),
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
