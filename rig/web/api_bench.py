"""The REST API: logins, the lease, state, STOP, events, pictures, jobs, and the shelf of a simulated bench."""

import asyncio
import json
from base64 import b64decode
from contextlib import aclosing
from importlib.metadata import version
from typing import Annotated, Any, Final, Literal

from fastapi import Header, Request, Response, WebSocket, WebSocketDisconnect
from fastapi.responses import HTMLResponse, StreamingResponse
from pydantic import AwareDatetime, BaseModel, Field

from rig.core.errors import Forbidden, JobNotFound, TooManyListeners
from rig.core.next_steps import Do
from rig.motion.traces import stored
from rig.motion.turntable import check_angle
from rig.plans.operator import Choice
from rig.safety.saved_state import FileStore
from rig.web.access import LOCAL, MAX_NAME, Person, Role
from rig.web.answers import BenchStatus, Deleted, JobMessage, Jpeg, ListOf
from rig.web.benches import BenchesInNetwork, OtherBench, OtherBenches
from rig.web.hub import MAX_LISTENERS
from rig.web.requests import GotoRequest, Job, JobRequest, JobState, RequestBody
from rig.web.server import API, COOKIE, Manager, OperatorPerson, Page, Proposer, Routes, Server, Watcher, long_work

IdempotencyKey = Annotated[str | None, Header(min_length=1, max_length=200, description="names the request")]
_LOCATION: Final[dict[int | str, dict[str, Any]]] = {
    201: {"headers": {"Location": {"description": "the job", "schema": {"type": "string"}}}}
}


class Health(BaseModel):
    """The health of the server."""

    status: Literal["ok"] = "ok"
    version: str
    bench_open: bool


class Login(BaseModel):
    """Who is logged in: the name and the role of the token."""

    name: str
    role: Role


class TokenRow(Login):
    """A token without its secret.

    ``expires_utc`` is null if it is always valid, ``used_utc`` if it was not used since the server started.
    """

    created_utc: AwareDatetime
    expires_utc: AwareDatetime | None
    used_utc: AwareDatetime | None


class NewToken(Login):
    """A new token. No other answer has its secret, ``token``."""

    token: str


class LeaseHolder(BaseModel):
    """A person at a browser or program, which ``client`` distinguishes."""

    name: str
    client: str


class LeaseState(BaseModel):
    """Who operates the bench, and for how long without a request; ``taken_from`` had the lease before."""

    holder: str | None
    client: str | None
    taken_from: LeaseHolder | None
    seconds: float


class Me(Login):
    """Who is logged in, and who has the lease."""

    has_lease: bool
    lease: LeaseState


class LoginBody(RequestBody):
    """A token."""

    token: Annotated[str, Field(max_length=200)]


class LeaseBody(RequestBody):
    """How to take the lease."""

    force: bool = Field(False, description="take it over from another operator, who is warned")


class TokenBody(RequestBody):
    """A token to be made."""

    name: Annotated[str, Field(max_length=MAX_NAME, description="of the person or program that gets it")]
    role: Role
    days: Annotated[float | None, Field(ge=0.01, le=3650, description="how long it is valid; default: always")] = None


def add_access(routes: Routes, server: Server) -> None:
    @routes.public.get("/health", tags=["server"])
    def get_health() -> Health:
        """Return whether the server works; needs no login."""
        return Health(version=version("hbr-rig"), bench_open=bool(server.status.get("open")))

    @routes.public.post("/login", tags=["access"])
    def login(body: LoginBody, response: Response) -> Login:
        """Log in with a token; the answer sets a cookie."""
        secret, person = server.sessions.login(body.token)
        secure = server.setup.certfile is not None
        response.set_cookie(COOKIE, secret, httponly=True, samesite="strict", secure=secure, path="/")
        return Login(name=person.name, role=person.role)

    @routes.public.post("/logout", tags=["access"])
    def logout(request: Request, response: Response) -> dict[str, Any]:
        """Log out. The open streams of this login end."""
        server.sessions.logout(request.cookies.get(COOKIE, ""))
        server.hub.wake()
        response.delete_cookie(COOKIE, path="/")
        return {}

    @routes.watch.get("/me", tags=["access"], response_model=Me)
    def get_me(person: Watcher) -> Any:
        """Return who is logged in, and who has the lease."""
        mine = server.lease.is_held_by(person)
        return {"name": person.name, "role": person.role, "has_lease": mine, "lease": server.lease.as_json()}

    @routes.manage.post("/lease", tags=["access"], response_model=LeaseState)
    def take_lease(body: LeaseBody, person: Manager) -> Any:
        """Take or renew the lease."""
        server.lease.take(person, force=body.force)
        return server.lease.as_json()

    @routes.watch.delete("/lease", tags=["access"], response_model=LeaseState)
    def release_lease(person: Watcher) -> Any:
        """Give the lease back."""
        server.lease.release(person)
        return server.lease.as_json()

    tokens = server.sessions.tokens

    @routes.manage.get("/tokens", tags=["access"])
    def list_tokens() -> ListOf[TokenRow]:
        """List the tokens, without their secrets."""
        rows = [TokenRow(**dict(one), used_utc=tokens.used_utc(one)) for one in tokens.stored()]
        return ListOf(items=rows, total=len(rows), next=None)

    @routes.manage.post("/tokens", tags=["access"], status_code=201)
    def make_token(body: TokenBody, person: Manager) -> NewToken:
        """Make a token. It is in this answer only."""
        _require_login(person, body.name)
        token = tokens.new(body.name, body.role, body.days, replace=False)
        return NewToken(name=body.name, role=body.role, token=token)

    @routes.manage.delete("/tokens/{name:path}", tags=["access"])
    def revoke_token(name: str, person: Manager) -> Deleted:
        """Revoke a token. Its logins and its open streams end, and its lease."""
        _require_login(person, name)
        if not tokens.remove(name):
            raise JobNotFound("There is no token with that name.", next_step="Choose one of GET /api/v1/tokens.")
        server.hub.wake()  # its streams look at once whether they may continue
        holder = server.lease.holder
        if holder is not None and holder.name == name:
            server.lease.release(holder)
        return Deleted(deleted=name)


def _require_login(person: Person, name: str) -> None:
    """Raise `Forbidden` for a user of this computer without a token: a later server may want one from each of them."""
    if person.name == LOCAL:
        raise Forbidden(
            "A server that needs no login does not change tokens.",
            next_step=("At a terminal of the bench's computer:", Do.NEW_TOKEN(name=name)),
        )


class CatalogState(BaseModel):
    """Whether the catalog's server answers: else ``local_copy_utc`` is the time of the copy that is shown.

    ``waiting`` changes are not delivered yet, for these ``reasons``.
    """

    local_copy_utc: str | None
    waiting: int
    reasons: list[str]


class ServerState(BaseModel):
    """The state of the server: the number of open streams of events."""

    listeners: int


class Status(BenchStatus):
    """The state of the bench, of its server and of its catalog."""

    server: ServerState
    catalog: CatalogState


class Stopped(BaseModel):
    """The answer to STOP: with ``ended``, the torque is off. ``answer`` is null if the bench has not confirmed it."""

    ended: bool
    answer: str | None
    status: BenchStatus


class EventStream(StreamingResponse):
    """Server-sent events."""

    media_type = "text/event-stream"


def add_bench(routes: Routes, server: Server) -> None:
    others = server.setup.config.serve
    benches = OtherBenches(others.benches, BenchesInNetwork() if others.find else None)

    @routes.watch.get("/status", tags=["bench"], response_model=Status)
    def get_status() -> Any:
        """Return the state of the bench, as of the last second."""
        return {
            **server.status,
            "bench": server.setup.bench,
            "server": {"listeners": server.hub.listeners},
            "catalog": server.catalog.state,
        }

    @routes.watch.get("/benches", tags=["bench"])
    async def list_benches() -> ListOf[OtherBench]:
        """List other benches, with state, running job and last answer of each.

        They are those of the setting `serve.benches` and, with `serve.find`, those in the local network.
        """
        found = await benches.overview()
        return ListOf(items=found, total=len(found), next=None)

    @routes.watch.post("/stop", tags=["bench"], response_model=Stopped)
    async def stop() -> Any:
        """Stop the table, and cancel all jobs. Needs no lease. The answer says whether the bench has confirmed it."""
        return {**await server.stop(), "status": server.status}

    @routes.watch.get("/events", tags=["bench"], response_class=EventStream, responses={200: {"model": JobMessage}})
    async def stream_events(
        request: Request, last_event_id: Annotated[str | None, Header(max_length=64)] = None
    ) -> EventStream:
        """Send events: plan, job, status, lease, stop. `Last-Event-ID` continues after a lost connection."""
        if server.hub.listeners >= MAX_LISTENERS:
            raise TooManyListeners(
                f"{MAX_LISTENERS} streams are open already.", next_step="Close some pages or programs, then try again."
            )
        headers = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}
        return EventStream(server.hub.stream(last_event_id, lambda: server.still_allowed(request)), headers=headers)

    @routes.public.websocket("/socket")
    async def socket(socket: WebSocket) -> None:
        """Send the events to a page, and take its STOP: the connection is open already, and no other can occupy it."""
        if not server.still_allowed(socket) or server.hub.listeners >= MAX_LISTENERS:
            await socket.close(1008)
            return
        await socket.accept()
        # Two directions at the same time: STOP must not wait for events that a slow network takes long to carry.
        sending = asyncio.ensure_future(_send_events(server, socket))
        try:
            while not sending.done():
                received = await socket.receive_json()
                # The page sends a number with its STOP, and knows by it to which press the answer belongs.
                if isinstance(received, dict) and "stop" in received and server.still_allowed(socket):
                    done = await server.stop()
                    await socket.send_json({"kind": "stopped", "data": {**done, "stop": received["stop"]}})
        except (WebSocketDisconnect, RuntimeError, ValueError):  # it is closed, or what came is not JSON
            pass
        finally:
            sending.cancel()

    @routes.watch.get("/picture", tags=["bench"], response_class=Jpeg)
    async def get_picture() -> Jpeg:
        """Return the newest frame of the camera as JPEG; the header X-Rig-Picture-Age has its age in seconds."""
        content, age_s = await server.picture()
        if not content:
            raise JobNotFound("The camera has given no frame yet.", next_step="Try again in a second.")
        return Jpeg(content, headers={"Cache-Control": "no-store", "X-Rig-Picture-Age": f"{age_s or 0.0:.2f}"})

    @routes.watch.get("/moves/report", tags=["bench"], response_class=HTMLResponse)
    async def get_move_report() -> HTMLResponse:
        """Return the report of the last moves as a page: encoder, servo profile, load and gyro over the time."""
        from rig.report.motion import motion_report

        setup = server.setup

        def page() -> str:
            # A simulated bench without a folder has them in its memory.
            moves = stored(FileStore(setup.state_folder)) or server.bench.call("moves")
            if not moves:
                raise JobNotFound("No move of the table is stored.", next_step="Rotate it, then ask again.")
            return motion_report(moves, bench=setup.bench, quiet_dps=setup.config.table.quiet_dps)

        return HTMLResponse(await long_work(page))


async def _send_events(server: Server, socket: WebSocket) -> None:
    """Send the hub's messages to a page until it has gone or may not listen any more."""
    last = socket.query_params.get("last")
    async with aclosing(server.hub.messages(last, lambda: server.still_allowed(socket))) as messages:
        async for message in messages:
            if message is not None:
                # The data are JSON text already, the same for all listeners: they are not made again for each.
                head = json.dumps({"kind": message.kind, "id": server.hub.id_of(message)})
                await socket.send_text(f'{head[:-1]}, "data": {message.data}}}')
    await socket.close(1008)


class JobEvents(BaseModel):
    """The events of a job so far, as the messages ``plan`` of the stream, and the id after which a stream continues."""

    items: list[dict[str, Any]]
    last: str


class AnswerBody(RequestBody):
    """The answer to the question of a job; without ``sample``, the sample on the table has no name."""

    choice: Choice = Choice.CONTINUE
    sample: Annotated[str | None, Field(max_length=1000, description="for a question with takes_sample")] = None


def add_jobs(routes: Routes, server: Server) -> None:
    @routes.watch.get("/jobs", tags=["jobs"], response_model=ListOf[Job])
    def list_jobs(page: Page, state: JobState | None = None) -> Response:
        """List the jobs, or those in one state, the newest first."""
        jobs = [job for job in server.bench.call("jobs") if state in (None, job["state"])]
        return page.of(jobs, lambda job: str(job["id"]))

    @routes.propose.post("/jobs", tags=["jobs"], status_code=201, response_model=Job, responses=_LOCATION)
    def submit_job(
        body: JobRequest, person: Proposer, response: Response, idempotency_key: IdempotencyKey = None
    ) -> Any:
        """Add a job to the queue. A token with the role propose needs no lease, and its job waits for an approval.

        The same request with the same header `Idempotency-Key` returns the job of the first one: repeat it after a lost
        answer.
        """
        if isinstance(body, GotoRequest):  # it would fail later, behind the jobs that wait
            check_angle(body.angle_deg, server.setup.config.table.limits_deg)
        proposed = person.role is Role.PROPOSE
        job = server.bench.call("submit", request=body, operator=person.name, key=idempotency_key, proposed=proposed)
        response.headers["Location"] = f"{API}/jobs/{job['id']}"
        return job

    @routes.watch.get("/jobs/{job_id}", tags=["jobs"], response_model=Job)
    def get_job(job_id: str) -> Any:
        """Return a job."""
        return server.bench.call("job", job_id=job_id)

    @routes.operate.post("/jobs/{job_id}/approve", tags=["jobs"], response_model=Job)
    def approve_job(job_id: str, person: OperatorPerson) -> Any:
        """Approve a proposed job, which then waits for the bench."""
        return server.bench.call("approve", job_id=job_id, operator=person.name)

    @routes.operate.post("/jobs/{job_id}/cancel", tags=["jobs"], response_model=Job)
    def cancel_job(job_id: str) -> Any:
        """Cancel a job. A running one ends at its next step; views that were taken stay stored."""
        return server.bench.call("cancel", job_id=job_id)

    @routes.operate.post("/jobs/{job_id}/pause", tags=["jobs"], response_model=Job)
    def pause_job(job_id: str) -> Any:
        """Pause a job after its present view; the table holds its angle."""
        return server.bench.call("pause", job_id=job_id)

    @routes.operate.post("/jobs/{job_id}/resume", tags=["jobs"], response_model=Job)
    def resume_job(job_id: str) -> Any:
        """Resume a paused job."""
        return server.bench.call("resume", job_id=job_id)

    @routes.operate.post("/jobs/{job_id}/answer", tags=["jobs"], response_model=Job)
    def answer_job(job_id: str, body: AnswerBody) -> Any:
        """Answer the question of a job."""
        return server.bench.call("answer", job_id=job_id, choice=body.choice, sample=body.sample)

    @routes.watch.get("/jobs/{job_id}/views/{number}", tags=["jobs"], response_class=Jpeg)
    def get_job_view(job_id: str, number: int) -> Jpeg:
        """Return a picture of a recent job as JPEG, the first with number 0."""
        found = server.bench.call("view", job_id=job_id, number=number)
        return Jpeg(b64decode(found), headers={"Cache-Control": "private, max-age=3600"})

    @routes.watch.get("/jobs/{job_id}/events", tags=["jobs"], responses={200: {"model": JobEvents}})
    def get_job_events(job_id: str) -> Response:
        """Return the events of a recent job so far, and the id after which a stream continues."""
        server.bench.call("job", job_id=job_id)
        events, last = server.hub.of_job(job_id)
        # The events are JSON text already; a job of 720 views has some thousands of them.
        content = f'{{"items": [{", ".join(events)}], "last": "{last}"}}'
        return Response(content, media_type="application/json", headers={"Cache-Control": "no-store"})


class ByHand(RequestBody):
    """What hands do at a simulated bench: ``put NAME``, ``clear``, ``light 0.5`` or ``unplug`` the camera."""

    words: Annotated[list[Annotated[str, Field(max_length=100)]], Field(min_length=1, max_length=4)]


class ShelfState(BaseModel):
    """A simulated bench: the ``things`` on its shelf, the ``object`` on the table, its light and its faults."""

    things: list[str]
    object: str | None
    light: float
    faults: list[str]


def add_shelf(routes: Routes, server: Server) -> None:
    """Add the routes for the hands at a simulated bench; other benches answer 404."""

    @routes.watch.get("/shelf", tags=["bench"], response_model=ShelfState)
    def get_shelf() -> Any:
        """Return the objects of a simulated bench, and what is on its table."""
        return server.bench.call("shelf")

    @routes.operate.post("/shelf", tags=["bench"], response_model=ShelfState)
    def use_shelf(body: ByHand) -> Any:
        """Do something by hand at a simulated bench; the event `shelf` says what was done."""
        return server.bench.call("by_hand", words=body.words)

    @routes.watch.get("/shelf/{name}", tags=["bench"], response_class=Jpeg)
    def get_thing(name: str) -> Jpeg:
        """Return a picture of an object of a simulated bench as JPEG."""
        return Jpeg(
            b64decode(server.bench.call("thing", thing=name)), headers={"Cache-Control": "private, max-age=3600"}
        )
