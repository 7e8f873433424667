"""Results: the recorded answers about samples, and their later corrections by operators.

An answer and a correction are lines of the log. Results are numbered from 1.

Decision: docs/decisions/0009.
"""

import secrets
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict
from sqlalchemy import ColumnElement, and_, func, or_, select
from sqlalchemy.orm import Session as Transaction

from rig.catalog import digests, log
from rig.catalog.catalog import Catalog
from rig.catalog.columns import damaged, image_name
from rig.catalog.facts import Action, Entry
from rig.catalog.images import path_of
from rig.catalog.records import JsonObject, Provenance, RecordedOutcome, as_json
from rig.core.errors import CatalogDamaged, CatalogError, UsageError
from rig.core.next_steps import Do
from rig.views import image_files as images

MAX_TEXT_LENGTH: Final = 1000  # a reason or a barcode, and not a document


class Answer(NamedTuple):
    """The object of a sample: ``object_name`` is None for an unknown object, the likeliest for an ambiguous one."""

    outcome: RecordedOutcome
    object_name: str | None
    sample: str | None


@dataclass(frozen=True, slots=True)
class NewResult:
    """An answer to be recorded, with the event `identified` as its ``details``, JSON values."""

    answered: Answer
    details: JsonObject
    azimuths_deg: tuple[float, ...]
    """Azimuths of the views, from any zero."""
    provenance: Provenance
    catalog_version: str
    """`Catalog.version` when the enrolled views were loaded."""
    operator: str | None = None
    """None for the user's account."""
    key: str = field(default_factory=lambda: secrets.token_hex(32))
    """The same in every catalog that has the answer."""


@dataclass(frozen=True, slots=True)
class Correction:
    """A correction of a result by an operator, with the reason."""

    time_utc: datetime
    operator: str
    user: str
    host: str
    corrected: Answer
    reason: str


class ResultRow(BaseModel):
    """A result as one row of a table.

    ``outcome``, ``object`` and ``sample`` are those after the last correction. Rotation and probabilities are those of
    the answer: they are null if a correction names another object. ``confidence`` is null if no object was found;
    ``not_enrolled`` is the probability that the object is not enrolled, null in searches that know no such probability.
    """

    model_config = ConfigDict(use_enum_values=True)

    result: int
    time_utc: datetime
    sample: str | None
    outcome: RecordedOutcome
    object: str | None
    yaw_deg: float | None
    yaw_sigma_deg: float | None
    period_deg: float | None
    confidence: float | None
    not_enrolled: float | None
    score: float | None
    margin: float | None
    views: int
    operator: str
    user: str
    host: str
    bench: str
    software: str
    catalog_version: str
    image: str | None
    image_sha256: str | None
    answered_sample: str | None
    answered_outcome: RecordedOutcome
    answered_object: str | None
    corrections: int
    corrected_utc: datetime | None
    corrected_by: str | None
    correction_reason: str | None


@dataclass(frozen=True, slots=True)
class Result:
    """A recorded answer with its corrections, oldest first. ``image`` is the name of the image of its first view."""

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
    corrections: tuple[Correction, ...]

    @property
    def image_path(self) -> str | None:
        """Path of the image in the catalog's folder."""
        return None if self.image is None else path_of(self.image)

    @property
    def image_sha256(self) -> str | None:
        return None if self.image is None else self.image.partition(".")[0]

    @property
    def current(self) -> Answer:
        """The answer after the last correction."""
        return self.corrections[-1].corrected if self.corrections else self.answered

    def as_row(self) -> ResultRow:
        now, last = self.current, self.corrections[-1] if self.corrections else None
        same = now[:2] == self.answered[:2]
        return ResultRow(
            result=self.id,
            time_utc=self.time_utc,
            sample=now.sample,
            outcome=now.outcome,
            object=now.object_name,
            **{name: _number(self.details, name) if same else None for name in _OF_ITS_OBJECT},
            **{name: _number(self.details, name) for name in ("score", "margin")},
            views=len(self.azimuths_deg),
            **{name: getattr(self, name) for name in ("operator", "user", "host")},
            **{name: getattr(self.provenance, name) for name in ("bench", "software")},
            catalog_version=self.catalog_version,
            image=self.image_path,
            image_sha256=self.image_sha256,
            answered_sample=self.answered.sample,
            answered_outcome=self.answered.outcome,
            answered_object=self.answered.object_name,
            corrections=len(self.corrections),
            corrected_utc=last and last.time_utc,
            corrected_by=last and last.operator,
            correction_reason=last and last.reason,
        )


_OF_ITS_OBJECT: Final = ("yaw_deg", "yaw_sigma_deg", "period_deg", "confidence", "not_enrolled")


@dataclass(frozen=True, slots=True)
class ResultFilter:
    """Which results to list; None means all. Samples, objects and outcomes are those after corrections."""

    sample: str | None = None
    object_name: str | None = None
    outcome: RecordedOutcome | None = None
    since: datetime | None = None
    before: datetime | None = None

    def lines(self) -> ColumnElement[bool]:
        """Return which answers have the right time; the other values may be corrected."""
        times = [] if self.since is None else [Entry.time_utc >= self.since]
        times += [] if self.before is None else [Entry.time_utc < self.before]
        return and_(Entry.result.is_not(None), *times)

    def accepts(self, result: Result) -> bool:
        """Return whether the values after the last correction are the wanted ones."""
        wanted = (self.outcome, self.object_name, self.sample)
        return all(one in (None, value) for one, value in zip(wanted, result.current, strict=True))


def clean_text(text: str, what: str) -> str:
    """Return a sample, an operator or a reason as it is stored, without outer spaces.

    Raises `UsageError`: it is empty, too long, or contains characters that cannot be printed.
    """
    cleaned = text.strip()
    if not cleaned:
        problem = "is empty"
    elif len(cleaned) > MAX_TEXT_LENGTH:
        problem = f"has {len(cleaned)} characters; at most {MAX_TEXT_LENGTH} are allowed"
    elif not cleaned.isprintable():
        problem = f"contains characters that cannot be printed: {cleaned[:100]!a}"
    else:
        return cleaned
    raise UsageError(f"The {what} {problem}.", next_step=f"Give the {what} as one line of text.")


def record(catalog: Catalog, new: NewResult, image_bgr: NDArray[np.uint8] | None) -> int:
    """Store an answer with the image of its first view, uint8 (H, W, 3) BGR, and return its number.

    Both are durable when this returns. The image is complete under its name before the line is committed. A crash in
    between leaves an image that no line names, which is harmless.

    Raises `UsageError`: the sample or the operator is not valid text.
    """
    sample = None if new.answered.sample is None else clean_text(new.answered.sample, "sample")
    fact: dict[str, Any] = {"answer": new.details, "image": None, "image_bytes": None}
    fact |= {name: getattr(new, name) for name in ("key", "azimuths_deg", "catalog_version")}
    fact |= {name: getattr(new.provenance, name) for name in ("bench", "devices", "conditions")}
    operator = _operator(new.operator)
    store, png = catalog.database.images, None if image_bgr is None else images.encode(image_bgr)
    if png is not None:
        with catalog.database.catalog_errors():
            fact |= {"image": store.put(png), "image_bytes": len(png)}
    with catalog.database.write() as transaction:
        if png is not None and store.size(fact["image"]) != len(png):  # `collect_garbage` removed it meanwhile
            store.put(png)
        number = 1 + (transaction.scalar(select(func.max(Entry.result))) or 0)
        _append(catalog, transaction, Action.IDENTIFIED, number, new.answered._replace(sample=sample), operator, fact)
    return number


def find_results(catalog: Catalog, wanted: ResultFilter = ResultFilter()) -> list[Result]:
    """Return results with their corrections, oldest first."""
    with catalog.database.read() as transaction:
        log.check_complete(transaction)
        found = _load(transaction, or_(wanted.lines(), Entry.action == Action.RESULT_CORRECTED))
    return [result for result in found if wanted.accepts(result)]


def find_result(catalog: Catalog, result_id: int) -> Result:
    """Return a result.

    Raises `CatalogError`: there is no result of this number.
    """
    with catalog.database.read() as transaction:
        return _find(transaction, result_id)


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

    The ``reason`` is stored with the correction and in the log. An ``unknown`` object is not in the catalog. The
    ``operator`` corrects it; None for the user's account.

    Raises `UsageError`: a text is not valid, nothing is corrected, or the object is both named and unknown.
    `ObjectNotFound`: there is no object of that name. `CatalogError`, `CatalogBusy`: there is no such result, or the
    catalog cannot be written.
    """
    reason = clean_text(reason, "reason")
    operator = _operator(operator)
    if unknown and object_name is not None:
        raise UsageError("--object and --unknown are both given.", next_step="Give one of them.")
    with catalog.writing() as state:
        transaction = state.transaction
        now = before = _find(transaction, result_id).current
        if object_name is not None:
            right = state.find(object_name).object_name
            now = now._replace(outcome=RecordedOutcome.FOUND, object_name=right)
        if unknown:
            now = now._replace(outcome=RecordedOutcome.UNKNOWN, object_name=None)
        if sample is not None:
            now = now._replace(sample=clean_text(sample, "sample"))
        if now == before:
            raise UsageError(
                f"Result {result_id} has these values already.",
                next_step="Give the right object, unknown, or the right sample.",
            )
        _append(
            *(catalog, transaction, Action.RESULT_CORRECTED, result_id, now, operator, {"reason": reason}),
            before=[part for part in before if part is not None],
            reason=reason,
        )
    return now


def _operator(operator: str | None) -> str:
    return log.operator() if operator is None else clean_text(operator, "operator")


def _append(
    catalog: Catalog,
    transaction: Transaction,
    action: Action,
    number: int,
    answer: Answer,
    operator: str,
    fact: Mapping[str, Any],
    **details: Any,
) -> None:
    """Add the line of an answer or a correction to the log; its ``key`` is the same in every catalog that has it."""
    own = {"outcome": answer.outcome, "sample": answer.sample, "operator": operator}
    shown = {"result": number, **own, **details}
    log.append(
        transaction,
        catalog.clock,
        action,
        answer.object_name,
        result=number,
        details={key: value for key, value in shown.items() if value is not None},
        record=as_json({"key": secrets.token_hex(32), **fact, **own, "object": answer.object_name}, "The answer"),
    )


def _find(transaction: Transaction, result_id: int) -> Result:
    found = _load(transaction, Entry.result == result_id)
    if not found:
        raise CatalogError(f"There is no result {result_id} in the catalog.", next_step=Do.LIST_RESULTS())
    return found[0]


def _load(transaction: Transaction, wanted: ColumnElement[bool]) -> list[Result]:
    """Return the answers among these lines of the log, with the corrections among them."""
    lines = transaction.scalars(select(Entry).where(wanted).order_by(Entry.id)).all()
    if wrong := digests.wrong_lines(transaction, [line.id for line in lines]):
        numbers = [line.result for line in lines if line.id in wrong]
        raise CatalogDamaged(
            f"Result {numbers[0]} in the catalog changed after it was recorded.",
            next_step=(Do.VERIFY_CATALOG(), "Then use a backup."),
            evidence={"results": numbers[:20]},
        )
    corrections, answers = defaultdict[int | None, list[Correction]](list), list[Result]()
    for line in sorted(lines, key=lambda line: line.action == Action.IDENTIFIED):  # the corrections first
        try:
            found: Mapping[str, Any] = line.record or {}
            said = (line.time_utc, str(found["operator"]), line.user, line.host, _answer(found))
            if line.action == Action.RESULT_CORRECTED:
                corrections[line.result].append(Correction(*said, str(found["reason"])))
            elif line.action == Action.IDENTIFIED and line.result is not None:
                details, azimuths_deg = dict(found["answer"]), tuple(map(float, found["azimuths_deg"]))
                bench = Provenance(str(found["bench"]), found["devices"], found["conditions"], line.software)
                version, image, later = str(found["catalog_version"]), found["image"], tuple(corrections[line.result])
                if image is not None:
                    image_name(image)
                answers.append(Result(line.result, *said, details, azimuths_deg, bench, version, image, later))
        except (KeyError, TypeError, ValueError, UsageError) as error:  # this program has not written it
            raise damaged(f"the record of result {line.result}", line.record) from error
    return answers


def _answer(found: Mapping[str, Any]) -> Answer:
    name, sample = (None if found[key] is None else str(found[key]) for key in ("object", "sample"))
    return Answer(RecordedOutcome(found["outcome"]), name, sample)


def _number(details: Mapping[str, Any], name: str) -> float | None:
    value = details.get(name)
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None
