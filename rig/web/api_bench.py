"""The REST API: state, STOP, events, pictures, jobs."""

from typing import Annotated, Any

from fastapi import APIRouter, Header, Query, Request, Response
from fastapi.responses import StreamingResponse

from rig.core.errors import JobNotFound
from rig.web.picture import BOUNDARY
from rig.web.problems import problem
from rig.web.requests import Job, JobRequest
from rig.web.server import AnswerBody, Limit, OperatorPerson, Server, Watcher, page_of


def add_bench(api: APIRouter, server: Server) -> None:
    @api.get("/status", tags=["bench"])
    def status(_person: Watcher) -> dict[str, Any]:
        """Return the state of the bench, as of the last second."""
        problem_now = server.queue.problem or server.damage
        return {
            **server.worker.status,
            "bench": server.bench,
            "server": {"viewers": server.picture.viewers, "listeners": server.hub.listeners},
            "catalog": server.catalog.state,
            "problem": problem(problem_now) if problem_now else None,
        }

    @api.post("/stop", tags=["bench"])
    def stop(_person: Watcher) -> dict[str, Any]:
        """Stop the table, and cancel all jobs. Needs no lease. The answer says whether the running job has ended."""
        return {"ended": server.worker.stop(), "status": server.worker.status}

    @api.get("/events", tags=["bench"], response_class=StreamingResponse)
    async def events(
        _person: Watcher, last_event_id: Annotated[str | None, Header(max_length=64)] = None
    ) -> StreamingResponse:
        """Send events: plan, job, status, lease, stop. `Last-Event-ID` continues after a lost connection."""
        headers = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}
        return StreamingResponse(server.hub.stream(last_event_id), media_type="text/event-stream", headers=headers)

    @api.get("/picture", tags=["bench"], response_class=Response)
    def picture(_person: Watcher) -> Response:
        """Return the newest frame of the camera as JPEG."""
        server.picture.want()
        found = server.picture.jpeg()
        if found is None:
            raise JobNotFound("The camera has given no frame yet.", next_step="Try again in a second.")
        return Response(found[1], media_type="image/jpeg", headers={"Cache-Control": "no-store"})

    @api.get("/live", tags=["bench"], response_class=StreamingResponse)
    async def live(_person: Watcher) -> StreamingResponse:
        """Send the camera's frames as MJPEG."""
        kind = f"multipart/x-mixed-replace; boundary={BOUNDARY}"
        return StreamingResponse(server.picture.stream(), media_type=kind, headers={"Cache-Control": "no-store"})


def add_jobs(api: APIRouter, server: Server) -> None:
    @api.get("/jobs", tags=["jobs"])
    def jobs(
        request: Request, _person: Watcher, limit: Limit = 50, after: Annotated[str | None, Query(max_length=32)] = None
    ) -> Response:
        """List the jobs, the newest first."""
        found = [job.model_dump(mode="json") for job in server.queue.jobs()]
        return page_of(request, found, "id", limit, after)

    @api.post("/jobs", tags=["jobs"], status_code=201)
    def submit(body: JobRequest, person: OperatorPerson) -> Job:
        """Add a job to the queue."""
        return server.queue.submit(body, person.name)

    @api.get("/jobs/{job_id}", tags=["jobs"])
    def job(job_id: str, _person: Watcher) -> Job:
        """Return a job."""
        return server.queue.job(job_id)

    @api.post("/jobs/{job_id}/cancel", tags=["jobs"])
    def cancel(job_id: str, _person: OperatorPerson) -> Job:
        """Cancel a job. A running one ends at its next step; views that were taken stay stored."""
        return server.queue.cancel(job_id)

    @api.post("/jobs/{job_id}/pause", tags=["jobs"])
    def pause(job_id: str, _person: OperatorPerson) -> Job:
        """Pause a job after its present view; the table holds its angle."""
        return server.queue.pause(job_id)

    @api.post("/jobs/{job_id}/resume", tags=["jobs"])
    def resume(job_id: str, _person: OperatorPerson) -> Job:
        """Resume a paused job."""
        return server.queue.resume(job_id)

    @api.post("/jobs/{job_id}/answer", tags=["jobs"])
    def answer(job_id: str, body: AnswerBody, _person: OperatorPerson) -> Job:
        """Answer the question of a job."""
        return server.queue.answer(job_id, body.choice)

    @api.get("/jobs/{job_id}/views/{number}", tags=["jobs"], response_class=Response)
    def view(job_id: str, number: int, _person: Watcher) -> Response:
        """Return a picture of a recent job as JPEG, the first with number 0."""
        found = server.worker.view(job_id, number)
        if found is None:
            raise JobNotFound("There is no such picture (any more).", next_step="The catalog has all enrolled views.")
        return Response(found, media_type="image/jpeg", headers={"Cache-Control": "private, max-age=3600"})
