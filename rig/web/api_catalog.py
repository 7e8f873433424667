"""The REST API: objects, views, import and export."""

import asyncio
from collections.abc import AsyncIterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, Final

from fastapi import Query, Request, Response
from fastapi.responses import StreamingResponse
from pydantic import Field
from starlette.background import BackgroundTask

from rig.catalog import ObjectSummary
from rig.catalog.derived import views
from rig.catalog.exchange.bundle import read_bundle, write_bundle
from rig.catalog.jobs import finished
from rig.catalog.transfer import CatalogSource, Conflict, transfer
from rig.core.json_form import plain
from rig.plans.enroll import similar_objects
from rig.views.description import BENCH_DESCRIPTOR, PAPER_DESCRIPTOR
from rig.web.picture import jpeg
from rig.web.server import API, NameBody, ObjectBody, Page, Routes, Server, cached, long_work, time_text

THUMB_PX: Final = 256
UPLOAD: Final = f"{API}/import"
CHUNK_BYTES: Final = 65_536
BYTES_PER_S: Final = 30_000_000


class _Download:
    """Sends files at `BYTES_PER_S` for all receivers together, so that STOP does not wait behind their data."""

    def __init__(self) -> None:
        self._next_s = 0.0

    async def stream(self, path: Path) -> AsyncIterator[bytes]:
        """Yield the content of a file."""
        from anyio import open_file

        loop = asyncio.get_running_loop()
        async with await open_file(path, "rb") as file:
            while chunk := await file.read(CHUNK_BYTES):
                begin_s = max(loop.time(), self._next_s)
                self._next_s = begin_s + len(chunk) / BYTES_PER_S
                await asyncio.sleep(begin_s - loop.time())
                yield chunk


def add_catalog(routes: Routes, server: Server) -> None:
    download = _Download()

    @routes.watch.get("/objects", tags=["catalog"])
    def objects(
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
            {**_summary(one), "picture": pictures.get(one.name)}
            for one in found
            if wanted in f"{one.name}\n{one.label}\n{one.note}".casefold()
        ]
        return page.of(sorted(rows, key=lambda row: row["name"]), "name")

    @routes.watch.get("/objects/{name:path}", tags=["catalog"])
    def one_object(name: str) -> dict[str, Any]:
        """Return an object with its enrollments and views."""
        with server.catalog.open_to_read() as catalog:
            found = catalog.object(name)
            similar = similar_objects(views(catalog, BENCH_DESCRIPTOR), found.summary.name) if found.views else None
        return {
            **_summary(found.summary),
            "enrollments": [
                {
                    "status": one.status,
                    "started_utc": time_text(one.enrollment.started_utc),
                    "finished_utc": time_text(one.finished_utc),
                    "planned_views": len(one.enrollment.planned_azimuth_deg),
                    "stored_views": len(one.enrollment.views),
                    "sessions": [plain(session.provenance) for session in one.enrollment.sessions],
                }
                for one in found.enrollments
            ],
            "views_taken": [
                {
                    "id": view.id,
                    "index": view.index,
                    "azimuth_deg": view.azimuth_deg,
                    "evidence": view.evidence,
                    "captured_utc": time_text(view.captured_utc),
                }
                for view in found.views
            ],
            "similar": plain(similar) if similar else None,
        }

    @routes.operate.patch("/objects/{name:path}", tags=["catalog"])
    def change(name: str, body: ObjectBody) -> dict[str, Any]:
        """Rename or label an object."""
        with server.catalog.open_to_change() as catalog:
            catalog.set_texts(name, label=body.label, note=body.note)
            if body.name is not None:
                catalog.rename(name, body.name)
            return _summary(catalog.summary(body.name or name))

    @routes.operate.delete("/objects/{name:path}", tags=["catalog"])
    def remove(name: str) -> dict[str, Any]:
        """Delete an object. It can be restored until rig catalog gc removes it."""
        with server.catalog.open_to_change() as catalog:
            catalog.delete(name)
        return {"deleted": name}

    @routes.operate.post("/undelete", tags=["catalog"])
    def restore(body: NameBody) -> dict[str, Any]:
        """Restore a deleted object."""
        with server.catalog.open_to_change() as catalog:
            catalog.undelete(body.name)
            return _summary(catalog.summary(body.name))

    @routes.watch.get("/views/{view_id}/image", tags=["catalog"], response_class=Response)
    def image(
        request: Request,
        view_id: Annotated[int, Field(ge=0, lt=2**62)],
        full: Annotated[bool, Query(description="the stored PNG instead of a small JPEG")] = False,
    ) -> Response:
        """Return the image of a view."""
        with server.catalog.open_to_read() as catalog:
            name = catalog.view(view_id).image
            digest = f"{name}-{'full' if full else THUMB_PX}"

            def answer() -> Response:
                pixels = catalog.read_image(name)  # and check them
                if full:
                    kind = "image/png" if name.endswith(".png") else "image/jpeg"
                    return Response(catalog.database.images.content(name), media_type=kind)
                return Response(jpeg(pixels, THUMB_PX), media_type="image/jpeg")

            return cached(request, digest, answer, {"Cache-Control": "private, max-age=86400"})

    @routes.operate.post("/import", tags=["catalog"])
    async def import_bundle(
        request: Request,
        on_conflict: Annotated[str, Query(pattern="^(reject|skip|replace)$")] = "reject",
    ) -> dict[str, Any]:
        """Import a bundle (.rigcat.zip); the body is the file. It is checked as rig import checks it."""
        from anyio import to_thread

        with TemporaryDirectory(prefix="rig-import-") as folder:
            path = Path(folder) / "upload.rigcat.zip"
            with path.open("wb") as file:
                async for chunk in request.stream():
                    await to_thread.run_sync(file.write, chunk)
            return await long_work(lambda: _import(server, path, on_conflict))

    @routes.watch.get("/export", tags=["catalog"], response_class=StreamingResponse)
    async def export(
        name: Annotated[list[str] | None, Query(description="default: all objects")] = None,
    ) -> StreamingResponse:
        """Return a bundle with objects."""
        folder = TemporaryDirectory(prefix="rig-export-")
        path = Path(folder.name) / "catalog.rigcat.zip"

        def write() -> None:
            with server.catalog.open_to_read() as catalog:
                write_bundle(path, CatalogSource(catalog, name or ()))

        try:
            await long_work(write)
        except BaseException:
            folder.cleanup()
            raise
        headers = {
            "Content-Length": str(path.stat().st_size),
            "Content-Disposition": 'attachment; filename="catalog.rigcat.zip"',
        }
        return StreamingResponse(
            download.stream(path),
            media_type="application/zip",
            headers=headers,
            background=BackgroundTask(folder.cleanup),
        )


def _import(server: Server, path: Path, on_conflict: str) -> dict[str, Any]:
    with server.catalog.open_to_change() as catalog, read_bundle(path, catalog.clock) as source:
        job = transfer(
            source, catalog, conflict=Conflict(on_conflict), descriptors=(PAPER_DESCRIPTOR,), strict=True, jobs=1
        )
        return dict(plain(finished(job)))


def _summary(one: ObjectSummary) -> dict[str, Any]:
    return {
        **plain(one),
        **{key: time_text(getattr(one, key)) for key in ("created_utc", "enrolled_utc", "deleted_utc")},
    }
