"""Results: the recorded answers about samples, and their later corrections by operators.

Decision: docs/decisions/0036.
"""

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import ColumnElement, Connection, func, insert, or_, select

from rig.catalog import audit
from rig.catalog.catalog import Catalog
from rig.catalog.database import given_id, insert_row
from rig.catalog.queries import check_complete, find
from rig.catalog.records import JsonObject, Outcome, Provenance, as_json
from rig.catalog.schema import corrections, results
from rig.catalog.seal import seal_appended
from rig.core.errors import CatalogError, UsageError
from rig.core.next_steps import Do
from rig.views import image_files as images

MAX_TEXT_LENGTH: Final = 1000
_FOLDER_SIZE: Final = 1000


class Answer(NamedTuple):
    """The object of a sample: ``object_name`` is None for an unknown object, the likeliest for an ambiguous one."""

    outcome: Outcome
    object_name: str | None
    sample: str | None


@dataclass(frozen=True, slots=True)
class NewResult:
    """An answer to be recorded.

    Attributes
    ----------
    answered
        The outcome, the object, and the sample, as the operator typed or scanned it.
    details
        The event `identified` as JSON values.
    azimuths_deg
        Azimuths of the views, from any zero.
    provenance
        The bench that took the views.
    catalog_version
        `Catalog.version` when the enrolled views were loaded.
    operator
        None for the user's account.
    """

    answered: Answer
    details: JsonObject
    azimuths_deg: tuple[float, ...]
    provenance: Provenance
    catalog_version: str
    operator: str | None = None


@dataclass(frozen=True, slots=True)
class Correction:
    """A correction of a result by an operator, with the reason."""

    time_utc: datetime
    operator: str
    user: str
    host: str
    corrected: Answer
    reason: str


@dataclass(frozen=True, slots=True)
class Result:
    """A recorded answer with its corrections, oldest first. ``image`` is a path relative to the catalog's folder."""

    id: int
    time_utc: datetime
    operator: str
    user: str
    host: str
    answered: Answer
    details: JsonObject
    azimuths_deg: tuple[float, ...]
    provenance: Provenance
    catalog_version: str
    image: str | None
    image_sha256: str | None
    corrections: tuple[Correction, ...]

    @property
    def current(self) -> Answer:
        """The answer after the last correction."""
        return self.corrections[-1].corrected if self.corrections else self.answered

    def as_row(self) -> dict[str, Any]:
        """Return the result as one row of a table.

        Rotation and confidence are those of the answer: they are left out if a correction names another object.
        """
        last = self.corrections[-1] if self.corrections else None
        same = self.current[:2] == self.answered[:2]
        own = {name: _number(self.details, name) if same else None for name in _OF_ITS_OBJECT}
        numbers = {name: _number(self.details, name) for name in ("score", "margin")}
        return {
            "result": self.id,
            "time_utc": self.time_utc,
            "sample": self.current.sample,
            "outcome": self.current.outcome.value,
            "object": self.current.object_name,
            **own,
            **numbers,
            "views": len(self.azimuths_deg),
            "operator": self.operator,
            "user": self.user,
            "host": self.host,
            "bench": self.provenance.bench,
            "software": self.provenance.software,
            "catalog_version": self.catalog_version,
            "image": self.image,
            "image_sha256": self.image_sha256,
            "answered_sample": self.answered.sample,
            "answered_outcome": self.answered.outcome.value,
            "answered_object": self.answered.object_name,
            "corrections": len(self.corrections),
            "corrected_utc": last and last.time_utc,
            "corrected_by": last and last.operator,
            "correction_reason": last and last.reason,
        }


_OF_ITS_OBJECT: Final = ("yaw_deg", "yaw_sigma_deg", "period_deg", "confidence")


@dataclass(frozen=True, slots=True)
class ResultFilter:
    """Which results to list; None and False mean all. Samples, objects and outcomes are those after corrections."""

    sample: str | None = None
    object_name: str | None = None
    outcome: Outcome | None = None
    bench: str | None = None
    since: datetime | None = None
    before: datetime | None = None
    corrected: bool = False

    def accepts(self, result: Result) -> bool:
        now = result.current
        return (
            self.sample in (None, now.sample)
            and self.object_name in (None, now.object_name)
            and self.outcome in (None, now.outcome)
            and (not self.corrected or bool(result.corrections))
        )


def clean_text(text: str, what: str) -> str:
    """Return a sample, an operator or a reason as it is stored, without outer spaces.

    Raises
    ------
    UsageError
        It is empty, too long, or contains characters that cannot be printed.
    """
    cleaned = text.strip()
    if not cleaned or len(cleaned) > MAX_TEXT_LENGTH or not cleaned.isprintable():
        problem = (
            "is empty"
            if not cleaned
            else f"has {len(cleaned)} characters; at most {MAX_TEXT_LENGTH} are allowed"
            if len(cleaned) > MAX_TEXT_LENGTH
            else f"contains characters that cannot be printed: {cleaned[:100]!a}"
        )
        raise UsageError(f"The {what} {problem}.", next_step=f"Give the {what} as one line of text.")
    return cleaned


def record(catalog: Catalog, new: NewResult, image_bgr: NDArray[np.uint8] | None) -> int:
    """Store an answer with the image of its first view, uint8 (H, W, 3) BGR, and return its number.

    Both are durable when this returns. The image is complete under its name before the row is committed. A crash in
    between leaves an image without a row, which the next result replaces.

    Raises
    ------
    UsageError
        The sample or the operator is not valid text.
    CatalogError, CatalogBusy
        The catalog cannot be written.
    """
    png = None if image_bgr is None else images.encode(image_bgr)
    author = audit.author()
    operator = author["user"] if new.operator is None else clean_text(new.operator, "operator")
    sample = None if new.answered.sample is None else clean_text(new.answered.sample, "sample")
    with catalog.database.write() as connection:
        given = given_id(connection, results)
        result_id = given["id"] if given else 1 + (connection.scalar(select(func.max(results.c.id))) or 0)
        image = None if png is None else _write_image(catalog, result_id, png)
        connection.execute(
            insert(results).values(
                **author,
                id=result_id,
                time_utc=catalog.clock.utc(),
                operator=operator,
                **new.answered._replace(sample=sample)._asdict(),
                answer=as_json(new.details, "The answer"),
                azimuths_deg=new.azimuths_deg,
                bench=new.provenance.bench,
                devices=new.provenance.devices,
                conditions=new.provenance.conditions,
                catalog_version=new.catalog_version,
                image=image,
                image_sha256=None if png is None else images.digest(png),
                image_bytes=None if png is None else len(png),
            )
        )
        seal_appended(connection, results)
        _note(catalog, connection, audit.Action.IDENTIFIED, new.answered._replace(sample=sample), result_id, operator)
    return result_id


def find_results(catalog: Catalog, wanted: ResultFilter = ResultFilter()) -> list[Result]:
    """Return results with their corrections, oldest first."""
    conditions = [results.c.bench == wanted.bench] if wanted.bench is not None else []
    conditions += [results.c.time_utc >= wanted.since] if wanted.since is not None else []
    conditions += [results.c.time_utc < wanted.before] if wanted.before is not None else []
    corrected = results.c.id.in_(select(corrections.c.result_id))  # their values can have changed
    conditions += [
        or_(column == value, corrected)
        for column, value in (
            (results.c.sample, wanted.sample),
            (results.c.object_name, wanted.object_name),
            (results.c.outcome, wanted.outcome),
        )
        if value is not None
    ]
    with catalog.database.read() as connection:
        return [result for result in _load(connection, *conditions) if wanted.accepts(result)]


def find_result(catalog: Catalog, result_id: int) -> Result:
    """Return a result.

    Raises
    ------
    CatalogError
        There is no result of this number.
    """
    with catalog.database.read() as connection:
        return _find(connection, result_id)


def correct(
    catalog: Catalog,
    result_id: int,
    *,
    reason: str,
    object_name: str | None = None,
    unknown: bool = False,
    sample: str | None = None,
    operator: str | None = None,
) -> Answer:
    """Correct the object or the sample of a result, and return the new answer. The recorded answer does not change.

    Parameters
    ----------
    reason
        The reason; stored with the correction and in the log.
    object_name
        The right object, which is in the catalog.
    unknown
        The object is not in the catalog.
    sample
        The right sample.
    operator
        The operator who corrects it; None for the user's account.

    Raises
    ------
    UsageError
        A text is not valid, nothing is corrected, or the object is both named and unknown.
    ObjectNotFound
        There is no object of that name.
    CatalogError, CatalogBusy
        There is no such result, or the catalog cannot be written.
    """
    reason = clean_text(reason, "reason")
    author = audit.author()
    operator = author["user"] if operator is None else clean_text(operator, "operator")
    if unknown and object_name is not None:
        raise UsageError("--object and --unknown are both given.", next_step="Give one of them.")
    with catalog.database.write() as connection:
        now = before = _find(connection, result_id).current
        if object_name is not None:
            now = now._replace(outcome=Outcome.FOUND, object_name=find(connection, object_name)[1])
        if unknown:
            now = now._replace(outcome=Outcome.UNKNOWN, object_name=None)
        if sample is not None:
            now = now._replace(sample=clean_text(sample, "sample"))
        if now == before:
            raise UsageError(
                f"Result {result_id} has these values already.",
                next_step="Give the right object, unknown, or the right sample.",
            )
        insert_row(
            connection,
            corrections,
            **given_id(connection, corrections),
            result_id=result_id,
            time_utc=catalog.clock.utc(),
            operator=operator,
            **author,
            **now._asdict(),
            reason=reason,
        )
        seal_appended(connection, corrections)
        _note(
            *(catalog, connection, audit.Action.RESULT_CORRECTED, now, result_id, operator),
            before=[part for part in before if part is not None],
            reason=reason,
        )
    return now


def _note(
    catalog: Catalog,
    connection: Connection,
    action: audit.Action,
    now: Answer,
    result_id: int,
    operator: str,
    **details: Any,
) -> None:
    details = {"result": result_id, "outcome": now.outcome, "sample": now.sample, "operator": operator, **details}
    given = {key: value for key, value in details.items() if value is not None}
    audit.append(connection, catalog.clock, action, now.object_name, **given)


def _write_image(catalog: Catalog, result_id: int, png: bytes) -> str:
    path = Path(images.IMAGE_FOLDER, "results", f"{result_id // _FOLDER_SIZE:04d}", f"{result_id:06d}.png").as_posix()
    catalog.database.images.write(path, png)
    return path


def _find(connection: Connection, result_id: int) -> Result:
    found = _load(connection, results.c.id == result_id)
    if not found:
        raise CatalogError(f"There is no result {result_id} in the catalog.", next_step=Do.LIST_RESULTS())
    return found[0]


def _load(connection: Connection, *conditions: ColumnElement[bool]) -> list[Result]:
    corrected = defaultdict(list)
    for row in connection.execute(select(corrections).order_by(corrections.c.id)):
        check_complete(row, corrections)
        answer = Answer(Outcome(row.outcome), row.object_name, row.sample)
        corrected[row.result_id].append(Correction(row.time_utc, row.operator, row.user, row.host, answer, row.reason))
    found = []
    for row in connection.execute(select(results).where(*conditions).order_by(results.c.id)):
        check_complete(row, results)
        found.append(
            Result(
                *(row.id, row.time_utc, row.operator, row.user, row.host),
                answered=Answer(Outcome(row.outcome), row.object_name, row.sample),
                details=row.answer,
                azimuths_deg=tuple(row.azimuths_deg),
                provenance=Provenance(row.bench, row.devices, row.conditions, row.software),
                catalog_version=row.catalog_version,
                image=row.image,
                image_sha256=row.image_sha256,
                corrections=tuple(corrected[row.id]),
            )
        )
    return found


def _number(details: Mapping[str, Any], name: str) -> float | None:
    value = details.get(name)
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None
