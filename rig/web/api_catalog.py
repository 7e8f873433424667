"""The REST API: objects, views, answers with their corrections, the log, import and export."""

import asyncio
from collections.abc import AsyncIterator
from dataclasses import asdict, dataclass
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, Final, Literal

from anyio import open_file, to_thread
from fastapi import Query, Request, Response
from fastapi.responses import StreamingResponse
from pydantic import AwareDatetime, BaseModel, ConfigDict, Field
from starlette.background import BackgroundTask

from rig.catalog import Catalog, ObjectSummary
from rig.catalog.derived import views
from rig.catalog.exchange.bundle import read_bundle, write_bundle
from rig.catalog.facts import Action
from rig.catalog.jobs import finished
from rig.catalog.log import shown
from rig.catalog.records import EnrollmentStatus, Provenance, RecordedOutcome, Region
from rig.catalog.results import Result, ResultFilter, ResultRow, correct, find_result, find_results
from rig.catalog.transfer import CatalogSource, Conflict, Transferred, transfer
from rig.charts.answers import answers_a_day, drift_of_scores
from rig.core.errors import CatalogDamaged, CatalogError, JobNotFound
from rig.events.events import SimilarObjects
from rig.plans.enroll import similar_objects
from rig.views.description import BENCH_DESCRIPTOR, DESCRIPTORS, within
from rig.web.answers import Deleted, Jpeg, ListOf
from rig.web.picture import jpeg
from rig.web.requests import RequestBody
from rig.web.server import API, OperatorPerson, Page, Routes, Server, cached, long_work

THUMB_PX: Final = 256  # larger: a long list loads slowly; smaller: blurred on dense screens
UPLOAD: Final = f"{API}/import"
# smaller: more overhead; larger: STOP waits longer for a chunk. The rate leaves room in a network of 1 Gbit/s.
CHUNK_BYTES: Final = 65_536
BYTES_PER_S: Final = 30_000_000
Number = Annotated[int, Field(ge=0, lt=2**62)]
Full = Annotated[bool, Query(description="the image as it was stored, instead of a JPEG for the eye")]


@dataclass(frozen=True, slots=True, kw_only=True)
class ListedObject(ObjectSummary):
    """An object of a list; ``picture`` is the id of its first view."""

    picture: int | None


class EnrollmentRow(BaseModel):
    """An enrollment of an object; ``sessions`` say on which bench, and with which software and calibrations."""

    status: EnrollmentStatus
    started_utc: AwareDatetime
    finished_utc: AwareDatetime | None
    planned_views: int
    stored_views: int
    sessions: list[Provenance]


class ViewRow(BaseModel):
    """A view of an object with the measurements of its checks; its image is at ``/views/{id}/image``."""

    model_config = ConfigDict(from_attributes=True)

    id: int
    index: int
    azimuth_deg: float
    evidence: dict[str, Any]
    captured_utc: AwareDatetime | None


@dataclass(frozen=True, slots=True, kw_only=True)
class ObjectWithViews(ObjectSummary):
    """An object with its enrollments, the newest first, its views, and the objects that it resembles."""

    enrollments: list[EnrollmentRow]
    views_taken: list[ViewRow]
    similar: SimilarObjects | None


class ObjectBody(RequestBody):
    """Changes of an object; what is missing stays."""

    name: Annotated[str | None, Field(max_length=1000)] = None
    label: Annotated[str | None, Field(max_length=1000)] = None
    note: Annotated[str | None, Field(max_length=10_000)] = None


class NameBody(RequestBody):
    """The name of an object."""

    name: Annotated[str, Field(max_length=1000)]


def add_objects(routes: Routes, server: Server) -> None:
    @routes.watch.get("/objects", tags=["catalog"], response_model=ListOf[ListedObject])
    def list_objects(
        page: Page,
        search: Annotated[str, Query(max_length=100, description="part of the name, label or note")] = "",
        deleted: Annotated[bool, Query(description="list the deleted objects that can be restored")] = False,
    ) -> Response:
        """List the objects by name."""
        with server.catalog.open_to_read() as catalog:
            found = catalog.objects(deleted=deleted)
            pictures = {} if deleted else catalog.first_views()
        wanted = search.casefold()
        rows = [
            ListedObject(**asdict(one), picture=pictures.get(one.name))
            for one in found
            if wanted in f"{one.name}\n{one.label}\n{one.note}".casefold()
        ]
        return page.of(sorted(rows, key=lambda row: row.name), lambda row: row.name)

    @routes.watch.get("/objects/{name:path}", tags=["catalog"])
    def get_object(name: str) -> ObjectWithViews:
        """Return an object with its enrollments and views."""
        with server.catalog.open_to_read() as catalog:
            found = catalog.object(name)
            similar = similar_objects(views(catalog, BENCH_DESCRIPTOR), found.summary.name) if found.views else None
        enrollments = [
            EnrollmentRow(
                status=one.status,
                started_utc=one.enrollment.started_utc,
                finished_utc=one.finished_utc,
                planned_views=len(one.enrollment.planned_azimuth_deg),
                stored_views=len(one.enrollment.views),
                sessions=[session.provenance for session in one.enrollment.sessions],
            )
            for one in found.enrollments
        ]
        return ObjectWithViews(
            **asdict(found.summary),
            enrollments=enrollments,
            views_taken=[ViewRow.model_validate(view) for view in found.views],
            similar=similar,
        )

    @routes.operate.patch("/objects/{name:path}", tags=["catalog"])
    def change_object(name: str, body: ObjectBody, person: OperatorPerson) -> ObjectSummary:
        """Rename or label an object."""
        with server.catalog.open_to_change(person) as catalog:
            catalog.set_texts(name, label=body.label, note=body.note)
            if body.name is not None:
                catalog.rename(name, body.name)
            return catalog.summary(body.name or name)

    @routes.operate.delete("/objects/{name:path}", tags=["catalog"])
    def delete_object(name: str, person: OperatorPerson) -> Deleted:
        """Delete an object. It can be restored until rig catalog gc removes it."""
        with server.catalog.open_to_change(person) as catalog:
            catalog.delete(name)
        return Deleted(deleted=name)

    @routes.operate.post("/undelete", tags=["catalog"])
    def restore_object(body: NameBody, person: OperatorPerson) -> ObjectSummary:
        """Restore a deleted object."""
        with server.catalog.open_to_change(person) as catalog:
            catalog.undelete(body.name)
            return catalog.summary(body.name)


def sent_image(
    request: Request, catalog: Catalog, name: str, *, full: bool, px: int, region: Region | None = None
) -> Response:
    """Return an image of the catalog, unless the sender has it already.

    It is as it was stored if it shall be ``full``; else a JPEG of its ``region`` with at most ``px``.
    """

    def answer() -> Response:
        pixels = catalog.read_image(name)  # and check them
        if full:
            kind = "image/png" if name.endswith(".png") else "image/jpeg"
            return Response(catalog.database.images.content(name), media_type=kind)
        return Jpeg(jpeg(within(pixels, region), px))

    digest = f"{name}-{'full' if full else px}"
    return cached(request, digest, answer, {"Cache-Control": "private, max-age=86400"})


def _result(catalog: Catalog, result_id: int) -> Result:
    try:
        return find_result(catalog, result_id)
    except CatalogDamaged:  # not the fault of the request
        raise
    except CatalogError as error:
        raise JobNotFound(error.what, next_step=error.steps) from error


class CorrectionRow(BaseModel):
    """A correction of an answer, with the values after it."""

    time_utc: AwareDatetime
    operator: str
    outcome: RecordedOutcome
    object: str | None
    sample: str | None
    reason: str


class ListedResult(ResultRow):
    """A recorded answer of a list; ``id`` is its number as a text, for ``after``."""

    id: str


class ResultDetails(ResultRow):
    """A recorded answer with its row, and the ``history`` of its corrections, the oldest first.

    ``answer`` is the event `identified` as it was recorded.
    """

    answer: dict[str, Any]
    history: list[CorrectionRow]


class CorrectionBody(RequestBody):
    """A correction of an answer; what is missing stays."""

    reason: Annotated[str, Field(min_length=1, max_length=1000)]
    object: Annotated[str | None, Field(max_length=100)] = None
    unknown: bool = Field(False, description="the object is an unknown one")
    sample: Annotated[str | None, Field(max_length=100)] = None


class LogRow(BaseModel):
    """A line of the catalog's log; passwords in its ``details`` are hidden."""

    id: str
    time_utc: AwareDatetime
    user: str
    host: str
    software: str
    action: Action
    object_name: str | None
    details: dict[str, Any]


class Drawing(Response):
    """A chart."""

    media_type = "image/svg+xml"


def add_results(routes: Routes, server: Server) -> None:
    @routes.watch.get("/results", tags=["results"], response_model=ListOf[ListedResult])
    def list_results(
        page: Page,
        sample: Annotated[str | None, Query(max_length=100)] = None,
        object_name: Annotated[str | None, Query(alias="object", max_length=100)] = None,
        outcome: RecordedOutcome | None = None,
    ) -> Response:
        """List the recorded answers, the newest first. Filters use the corrected values."""
        with server.catalog.open_to_read() as catalog:
            found = find_results(catalog, ResultFilter(sample, object_name, outcome))
        rows = [ListedResult(**dict(one.as_row()), id=str(one.id)) for one in found]
        return page.of(rows[::-1], lambda row: row.id)

    @routes.watch.get("/results/charts/{name}", tags=["results"], response_class=Drawing)
    def draw_results(
        name: Literal["days", "drift"],
        zone_min: Annotated[int, Query(ge=-1440, le=1440, description="minutes that the clock is ahead of UTC")] = 0,
    ) -> Response:
        """Draw the answers a day of two weeks, or the scores of the found objects and the last empty-table image."""
        with server.catalog.open_to_read() as catalog:
            rows = [one.as_row() for one in find_results(catalog)]
            photographed = [one.time_utc for one in catalog.log() if one.action == Action.TABLE_PHOTOGRAPHED]
        if name == "days":
            zone = timezone(timedelta(minutes=zone_min))
            answers = [(row.time_utc.astimezone(zone).date(), row.outcome == "found") for row in rows]
            return Drawing(answers_a_day(answers, server.clock.utc().astimezone(zone).date()).svg(alone=True))
        found = [row for row in rows if row.outcome == "found"]
        last = max(photographed, default=datetime.min.replace(tzinfo=UTC))
        before = sum(row.time_utc < last for row in found)
        return Drawing(drift_of_scores([row.score for row in found], before).svg(alone=True))

    @routes.watch.get("/results/{result_id}", tags=["results"])
    def get_result(result_id: Number) -> ResultDetails:
        """Return a recorded answer with its corrections; ``/results/{result_id}/image`` has its first view."""
        with server.catalog.open_to_read() as catalog:
            found = _result(catalog, result_id)
        history = [
            CorrectionRow(
                time_utc=one.time_utc,
                operator=one.operator,
                outcome=one.corrected.outcome,
                object=one.corrected.object_name,
                sample=one.corrected.sample,
                reason=one.reason,
            )
            for one in found.corrections
        ]
        return ResultDetails(**found.as_row().model_dump(), answer=found.details, history=history)

    @routes.watch.get("/results/{result_id}/image", tags=["results"], response_class=Jpeg)
    def get_result_image(request: Request, result_id: Number, full: Full = False) -> Response:
        """Return the image of the first view of a recorded answer."""
        with server.catalog.open_to_read() as catalog:
            name = _result(catalog, result_id).image
            if name is None:
                raise JobNotFound("The answer has no image.", next_step="Set identify.record to image for later ones.")
            return sent_image(request, catalog, name, full=full, px=THUMB_PX)

    @routes.operate.post("/results/{result_id}/correct", tags=["results"])
    def correct_result(body: CorrectionBody, person: OperatorPerson, result_id: Number) -> ResultRow:
        """Correct the object or the sample of an answer, with the reason. The answer itself stays."""
        with server.catalog.open_to_change(person) as catalog:
            _result(catalog, result_id)
            correct(
                catalog,
                result_id,
                reason=body.reason,
                object_name=body.object,
                unknown=body.unknown,
                sample=body.sample,
                operator=person.name,
            )
            return _result(catalog, result_id).as_row()

    @routes.watch.get("/log", tags=["bench"], response_model=ListOf[LogRow])
    def list_log(page: Page) -> Response:
        """List the catalog's log, the newest first."""
        with server.catalog.open_to_read() as catalog:
            entries = catalog.log()
        rows = [LogRow.model_validate({**shown(one), "id": str(one.id), "time_utc": one.time_utc}) for one in entries]
        return page.of(rows[::-1], lambda row: row.id)


# -- bundles -----------------------------------------------------------------------------------------------------------


class Bundle(StreamingResponse):
    """A catalog in a file."""

    media_type = "application/zip"


class _Download:
    """Sends files at `BYTES_PER_S` for all receivers together, so that STOP does not wait behind their data."""

    def __init__(self) -> None:
        self._next_s = 0.0

    async def stream(self, path: Path) -> AsyncIterator[bytes]:
        """Yield the content of a file."""
        loop = asyncio.get_running_loop()
        async with await open_file(path, "rb") as file:
            while chunk := await file.read(CHUNK_BYTES):
                begin_s = max(loop.time(), self._next_s)
                self._next_s = begin_s + len(chunk) / BYTES_PER_S
                await asyncio.sleep(begin_s - loop.time())
                yield chunk


def add_bundles(routes: Routes, server: Server) -> None:
    download = _Download()

    @routes.operate.post("/import", tags=["catalog"])
    async def import_bundle(
        request: Request, person: OperatorPerson, on_conflict: Conflict = Conflict.REJECT
    ) -> Transferred:
        """Import a bundle (.rigcat.zip); the body is the file. It is checked as rig import checks it."""

        def store() -> Transferred:
            with server.catalog.open_to_change(person) as catalog, read_bundle(path, catalog.clock) as source:
                return finished(transfer(source, catalog, conflict=on_conflict, descriptors=DESCRIPTORS, jobs=1))

        # The whole file first: an upload that breaks off has changed nothing.
        with TemporaryDirectory(prefix="rig-import-") as folder:
            path = Path(folder) / "upload.rigcat.zip"
            with path.open("wb") as file:
                async for chunk in request.stream():
                    await to_thread.run_sync(file.write, chunk)
            return await long_work(store)

    @routes.watch.get("/export", tags=["catalog"], response_class=Bundle)
    async def export_bundle(
        name: Annotated[list[str] | None, Query(description="default: all objects")] = None,
    ) -> Bundle:
        """Return a bundle with objects."""
        folder = TemporaryDirectory(prefix="rig-export-")
        path = Path(folder.name) / "catalog.rigcat.zip"

        def write() -> None:
            with server.catalog.open_to_read() as catalog:
                write_bundle(path, CatalogSource(catalog, name or ()))

        # The folder must stay until the last byte is sent, so no `with` block can remove it.
        try:
            await long_work(write)
        except BaseException:
            folder.cleanup()
            raise
        headers = {
            "Content-Length": str(path.stat().st_size),
            "Content-Disposition": 'attachment; filename="catalog.rigcat.zip"',
        }
        return Bundle(download.stream(path), headers=headers, background=BackgroundTask(folder.cleanup))
