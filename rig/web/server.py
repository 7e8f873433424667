"""Code that the parts of the web application share: the server, the sender of a request, and pages of lists."""

import hashlib
import json
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, Final

from fastapi import Depends, Query, Request, Response
from pydantic import BaseModel, ConfigDict, Field

from rig.config import RigConfig
from rig.core.clock import SystemClock
from rig.core.errors import Forbidden, LoginRequired, RigError, UsageError
from rig.web.access import LOCAL, Lease, Person, Role, Sessions
from rig.web.bench_catalog import BenchCatalog
from rig.web.hub import Hub
from rig.web.jobs import JobQueue
from rig.web.picture import LivePicture
from rig.web.requests import Choice
from rig.web.worker import BenchWorker

COOKIE: Final = "rig-session"
API: Final = "/api/v1"
MAX_PAGE: Final = 500


@dataclass(slots=True)
class Server:
    """The objects that the application works with.

    Attributes
    ----------
    needs_login
        Whether requests need a token: always, unless the server listens to this computer only.
    catalog
        The bench's catalog.
    damage
        Damage of the catalog; None if none is known.
    """

    bench: str
    config: RigConfig
    clock: SystemClock
    worker: BenchWorker
    queue: JobQueue
    hub: Hub
    picture: LivePicture
    sessions: Sessions
    lease: Lease
    runs: Path
    catalog: BenchCatalog
    needs_login: bool
    secure_cookies: bool = False
    damage: RigError | None = None

    def person(self, request: Request) -> Person | None:
        """Return the sender of a request; None if it is not known. Raises `LoginRequired`, `TooManyLogins`."""
        client = request.headers.get("x-rig-client", "")[:64]
        scheme, _, token = request.headers.get("authorization", "").partition(" ")
        if scheme.lower() == "bearer":
            stored = self.sessions.verify(token.strip(), request.client.host if request.client else "")
            return Person(stored.name, stored.role, client)
        if cookie := request.cookies.get(COOKIE):
            found = self.sessions.find(cookie)
            if found is not None:
                return Person(found.name, found.role, client)
        return None if self.needs_login else Person(LOCAL, Role.OPERATE, client)


class Body(BaseModel):
    """A body of a request."""

    model_config = ConfigDict(extra="forbid")


class LoginBody(Body):
    """A token."""

    token: Annotated[str, Field(max_length=200)]


class LeaseBody(Body):
    """How to take the lease."""

    force: bool = Field(False, description="take it over from another operator, who is warned")


class HandOverBody(Body):
    """Who gets the lease."""

    name: Annotated[str, Field(max_length=50)]
    client: Annotated[str, Field(max_length=64)] = ""


class AnswerBody(Body):
    """The answer to the question of a job."""

    choice: Choice


class ObjectBody(Body):
    """Changes of an object; what is missing stays."""

    name: Annotated[str | None, Field(max_length=1000)] = None
    label: Annotated[str | None, Field(max_length=1000)] = None
    note: Annotated[str | None, Field(max_length=10_000)] = None


class NameBody(Body):
    """The name of an object."""

    name: Annotated[str, Field(max_length=1000)]


class CorrectionBody(Body):
    """A correction of an answer; what is missing stays."""

    reason: Annotated[str, Field(min_length=1, max_length=1000)]
    object: Annotated[str | None, Field(max_length=100)] = None
    unknown: bool = Field(False, description="the object is an unknown one")
    sample: Annotated[str | None, Field(max_length=100)] = None


class Problem(BaseModel):
    """An error (RFC 9457)."""

    type: str
    title: str
    status: int
    detail: str
    code: int | None = None
    next_step: str | None = None
    evidence: dict[str, Any] | None = None


def watcher(request: Request) -> Person:
    """Return the sender of the request. Raises `LoginRequired`."""
    server: Server = request.app.state.server
    person = server.person(request)
    if person is None:
        raise LoginRequired("This request needs a login.", next_step="Log in with a token, or send it as Bearer.")
    return person


def operator(request: Request, person: Annotated[Person, Depends(watcher)]) -> Person:
    """Return the operator who sends the request, and renew the lease. Raises `Forbidden`, `LeaseHeld`."""
    server: Server = request.app.state.server
    require_operate(person)
    server.lease.take(person)
    return person


def require_operate(person: Person) -> None:
    if person.role is not Role.OPERATE:
        raise Forbidden(
            f"The token {person.name} may only watch.",
            next_step="Use a token with the role operate: rig serve --new-token NAME --role operate",
        )


Watcher = Annotated[Person, Depends(watcher)]
OperatorPerson = Annotated[Person, Depends(operator)]
Limit = Annotated[int, Query(ge=1, le=MAX_PAGE)]


def page_of(request: Request, rows: list[dict[str, Any]], key: str, limit: int, after: str | None) -> Response:
    """Return a page of a list with an ETag, and a link to the next page."""
    start = 0
    if after is not None:
        places = [number for number, row in enumerate(rows) if row[key] == after]
        if not places:
            raise UsageError(
                "The list has changed: the entry after which to continue is gone.", next_step="Start again."
            )
        start = places[0] + 1
    shown = rows[start : start + limit]
    more = shown[-1][key] if start + limit < len(rows) else None
    body = json.dumps({"items": shown, "total": len(rows), "next": more}, ensure_ascii=False, default=str).encode()
    etag = f'"{hashlib.sha256(body).hexdigest()[:32]}"'
    headers = {"ETag": etag, "Cache-Control": "private, no-cache"}
    if more is not None:
        headers["Link"] = f'<{request.url.include_query_params(after=more)}>; rel="next"'
    if request.headers.get("if-none-match") == etag:
        return Response(status_code=304, headers=headers)
    return Response(body, media_type="application/json", headers=headers)


def time_text(at: datetime | None) -> str | None:
    return None if at is None else at.isoformat(timespec="seconds").replace("+00:00", "Z")
