"""The REST API: state, STOP, events, pictures, jobs."""

import asyncio
import json
from contextlib import aclosing
from typing import Annotated, Any

from fastapi import Header, Request, Response, WebSocket, WebSocketDisconnect
from fastapi.responses import StreamingResponse

from rig.core.errors import JobNotFound, TooManyListeners
from rig.web.event_schema import JobMessage
from rig.web.hub import MAX_LISTENERS
from rig.web.problems import problem
from rig.web.remote_bench import BOUNDARY
from rig.web.requests import Job, JobRequest
from rig.web.server import AnswerBody, OperatorPerson, Page, Routes, Server

MAX_VIEWERS = 50


class EventStream(StreamingResponse):
    """Server-sent events."""

    media_type = "text/event-stream"


def add_bench(routes: Routes, server: Server) -> None:
    @routes.watch.get("/status", tags=["bench"])
    def status() -> dict[str, Any]:
        """Return the state of the bench, as of the last second."""
        return _status(server)

    @routes.watch.post("/stop", tags=["bench"])
    async def stop() -> dict[str, Any]:
        """Stop the table, and cancel all jobs. Needs no lease. The answer says whether the bench has confirmed it."""
        return {**await server.remote.stop(), "status": server.remote.status}

    @routes.watch.get("/events", tags=["bench"], response_class=EventStream, responses={200: {"model": JobMessage}})
    async def events(
        request: Request, last_event_id: Annotated[str | None, Header(max_length=64)] = None
    ) -> EventStream:
        """Send events: plan, job, status, lease, stop. `Last-Event-ID` continues after a lost connection."""
        _check_number(server.hub.listeners, MAX_LISTENERS)
        headers = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}
        return EventStream(server.hub.stream(last_event_id, lambda: server.still_allowed(request)), headers=headers)

    @routes.public.websocket("/socket")
    async def socket(socket: WebSocket) -> None:
        """Send the events to a page, and take its STOP: the connection is open already, and no other can occupy it."""
        if not server.still_allowed(socket) or server.hub.listeners >= MAX_LISTENERS:
            await socket.close(1008)
            return
        await socket.accept()
        sending = asyncio.ensure_future(_send_events(server, socket))
        try:
            while not sending.done():
                received = await socket.receive_json()
                if isinstance(received, dict) and "stop" in received and server.still_allowed(socket):
                    done = await server.remote.stop()
                    await socket.send_json({"kind": "stopped", "data": {**done, "stop": received["stop"]}})
        except (WebSocketDisconnect, RuntimeError, ValueError):  # it is closed, or what came is not JSON
            pass
        finally:
            sending.cancel()

    @routes.watch.get("/picture", tags=["bench"], response_class=Response)
    async def picture() -> Response:
        """Return the newest frame of the camera as JPEG; the header X-Rig-Picture-Age has its age in seconds."""
        _, content, age_s = await server.remote.picture()
        if not content:
            raise JobNotFound("The camera has given no frame yet.", next_step="Try again in a second.")
        headers = {"Cache-Control": "no-store", "X-Rig-Picture-Age": f"{age_s or 0.0:.2f}"}
        return Response(content, media_type="image/jpeg", headers=headers)

    @routes.watch.get("/live", tags=["bench"], response_class=StreamingResponse)
    async def live(request: Request) -> StreamingResponse:
        """Send the camera's frames as MJPEG."""
        _check_number(server.remote.viewers, MAX_VIEWERS)
        kind = f"multipart/x-mixed-replace; boundary={BOUNDARY}"
        pictures = server.remote.pictures(lambda: server.still_allowed(request))
        return StreamingResponse(pictures, media_type=kind, headers={"Cache-Control": "no-store"})


def _status(server: Server) -> dict[str, Any]:
    return {
        **server.remote.status,
        "bench": server.bench,
        "server": {"viewers": server.remote.viewers, "listeners": server.hub.listeners},
        "catalog": server.catalog.state,
        "problem": server.remote.status.get("problem") or (problem(server.damage) if server.damage else None),
    }


async def _send_events(server: Server, socket: WebSocket) -> None:
    """Send the hub's messages to a page until it has gone or may not listen any more."""
    last = socket.query_params.get("last")
    async with aclosing(server.hub.messages(last, lambda: server.still_allowed(socket))) as messages:
        async for message in messages:
            if message is not None:
                head = json.dumps({"kind": message.kind, "id": server.hub.id_of(message)})
                await socket.send_text(f'{head[:-1]}, "data": {message.data}}}')
    await socket.close(1008)


def _check_number(present: int, most: int) -> None:
    if present >= most:
        raise TooManyListeners(
            f"{present} streams of this kind are open already.",
            next_step="Close some pages or programs, then try again.",
        )


def add_jobs(routes: Routes, server: Server) -> None:
    @routes.watch.get("/jobs", tags=["jobs"])
    def jobs(page: Page) -> Response:
        """List the jobs, the newest first."""
        return page.of(server.remote.ask("jobs"), "id")

    @routes.operate.post("/jobs", tags=["jobs"], status_code=201, response_model=Job)
    def submit(body: JobRequest, person: OperatorPerson) -> Any:
        """Add a job to the queue."""
        return server.remote.ask("submit", request=body, operator=person.name)

    @routes.watch.get("/jobs/{job_id}", tags=["jobs"], response_model=Job)
    def job(job_id: str) -> Any:
        """Return a job."""
        return server.remote.ask("job", job_id=job_id)

    @routes.operate.post("/jobs/{job_id}/cancel", tags=["jobs"], response_model=Job)
    def cancel(job_id: str) -> Any:
        """Cancel a job. A running one ends at its next step; views that were taken stay stored."""
        return server.remote.ask("cancel", job_id=job_id)

    @routes.operate.post("/jobs/{job_id}/pause", tags=["jobs"], response_model=Job)
    def pause(job_id: str) -> Any:
        """Pause a job after its present view; the table holds its angle."""
        return server.remote.ask("pause", job_id=job_id)

    @routes.operate.post("/jobs/{job_id}/resume", tags=["jobs"], response_model=Job)
    def resume(job_id: str) -> Any:
        """Resume a paused job."""
        return server.remote.ask("resume", job_id=job_id)

    @routes.operate.post("/jobs/{job_id}/answer", tags=["jobs"], response_model=Job)
    def answer(job_id: str, body: AnswerBody) -> Any:
        """Answer the question of a job."""
        return server.remote.ask("answer", job_id=job_id, choice=body.choice)

    @routes.watch.get("/jobs/{job_id}/views/{number}", tags=["jobs"], response_class=Response)
    def view(job_id: str, number: int) -> Response:
        """Return a picture of a recent job as JPEG, the first with number 0."""
        _, found = server.remote.link.call("view", job_id=job_id, number=number)
        return Response(found, media_type="image/jpeg", headers={"Cache-Control": "private, max-age=3600"})

    @routes.watch.get("/jobs/{job_id}/candidates", tags=["jobs"], response_class=Response)
    def candidates(job_id: str) -> Response:
        """Return the chart of the candidates of a recent search as SVG, after its last view."""
        svg = server.remote.ask("candidates", job_id=job_id)
        return Response(svg, media_type="image/svg+xml", headers={"Cache-Control": "no-store"})
