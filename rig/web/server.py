"""Code that the parts of the web application share: the server, the sender of a request, and pages of lists."""

import asyncio
import hashlib
import secrets
import socket
from base64 import b64decode
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Annotated, Any, Final, TypeVar

from fastapi import APIRouter, Depends, Query, Request, Response, Security
from fastapi.security import APIKeyCookie, HTTPBearer
from pydantic_core import to_json
from starlette.requests import HTTPConnection

from rig.catalog import Catalog
from rig.catalog.copying import Attempts, open_or_copy
from rig.catalog.journal import BackgroundDelivery, JournalState
from rig.catalog.log import asked_by
from rig.config.catalog_place import CatalogPlace
from rig.core.clock import Clock, SystemClock, seconds_between
from rig.core.errors import Forbidden, LoginRequired, RigError, UsageError
from rig.core.next_steps import Do
from rig.core.notify import print_note
from rig.safety.saved_state import SERVER_FOLDER
from rig.safety.stop_channel import StopAnswer, StopRequest, stop_answer
from rig.web.access import LOCAL, Lease, Person, Role, Sessions, Tokens
from rig.web.answers import BenchStatus
from rig.web.hub import Hub
from rig.web.link import Link
from rig.web.setup import Setup

COOKIE: Final = "rig-session"
API: Final = "/api/v1"
MAX_PAGE: Final = 500  # larger: a list holds the process that receives STOP for longer
PICTURE_S: Final = 0.08
"""Shortest time between two pictures that are fetched from the bench, for all pages together."""
CONFIRM_S: Final = 3.0
"""How long a request to stop is held until the bench has confirmed it; the page warns after one second."""


class BenchCatalog:
    """The catalog of a bench for requests, even while its server does not answer; its state goes to the listeners."""

    def __init__(self, place: CatalogPlace, clock: Clock, hub: Hub) -> None:
        self.state: dict[str, Any] = {"local_copy_utc": None, "waiting": 0, "reasons": []}
        self._place = place
        self._clock = clock
        self._hub = hub
        self._attempts = Attempts(clock)

    def open_to_read(self) -> Catalog:
        """Open the catalog, or its local copy; a catalog that does not exist yet is created."""
        create = not self._place.may_exist()
        catalog = open_or_copy(self._place, self._clock, create=create, attempts=self._attempts)
        copied = catalog.copied_utc
        self._become(local_copy_utc=None if copied is None else f"{copied:%Y-%m-%d %H:%M:%S} UTC")
        return catalog

    @contextmanager
    def open_to_change(self, person: Person) -> Iterator[Catalog]:
        """Open the catalog to change its objects; a `CatalogUnavailable` if its server does not answer.

        The log names the person.
        """
        with (
            asked_by(None if person.name == LOCAL else person.name),
            Catalog.open(self._place, clock=self._clock) as catalog,
        ):
            yield catalog

    def background_delivery(self) -> BackgroundDelivery:
        """Return a delivery of the journal during the work of a ``with`` block; notes on stderr say what it did."""

        def show(state: JournalState) -> None:
            self._become(waiting=state.waiting, reasons=list(state.reasons))

        return BackgroundDelivery(self._place, self._clock, print_note, changed=show)

    def _become(self, **values: Any) -> None:
        state = {**self.state, **values}
        if state != self.state:
            self.state = state
            self._hub.publish("catalog", state)


class Server:
    """The objects that the application works with; nothing listens yet, and the link ``bench`` has to be started.

    ``connection`` leads to the process that owns the bench, `rig.web.worker.BenchWorker`; ``ended`` is called once when
    that process has gone.
    """

    def __init__(
        self, setup: Setup, clock: SystemClock, connection: socket.socket, ended: Callable[[], None] = lambda: None
    ) -> None:
        self.setup = setup
        self.hub = Hub(secrets.token_hex(4))
        self.bench = Link(connection, {"publish": self._published}, ended)
        self.status: dict[str, Any] = BenchStatus().model_dump()
        """The last known state of the bench."""
        self.sessions = Sessions(Tokens(setup.state_folder / SERVER_FOLDER, clock), clock, setup.local_token)
        self.lease = Lease(clock, lambda values: self.hub.publish("lease", values))
        self.catalog = BenchCatalog(setup.catalog_place, clock, self.hub)
        self.clock = clock
        self._picture: dict[str, Any] = {"number": 0, "jpeg": "", "age_s": None}
        self._fetched_ns: int | None = None
        self._fetching = asyncio.Lock()

    def _published(self, kind: str, data: Any, job: str | None) -> None:
        if kind == "status":
            self.status = data
        self.hub.publish(kind, data, job)

    async def stop(self) -> dict[str, Any]:
        """Stop the table and cancel all jobs; return what the bench has confirmed within `CONFIRM_S`.

        It asks no queue, no thread and no disk.
        """
        request = StopRequest(self.setup.state_folder)
        answer: StopAnswer | None = None
        if request.connection is not None:
            try:
                async with asyncio.timeout(CONFIRM_S):
                    answer = stop_answer(await asyncio.get_running_loop().sock_recv(request.connection, 1))
            except TimeoutError:
                pass
            except OSError:
                answer = StopAnswer.ENDED
            finally:
                request.close()
        return {"ended": answer is StopAnswer.TORQUE_OFF, "answer": answer}

    async def picture(self) -> tuple[bytes, float | None]:
        """Return the newest frame as JPEG (empty if there is none), and its age in seconds."""
        async with self._fetching:
            now_ns = self.clock.now_ns()
            if self._fetched_ns is None or seconds_between(self._fetched_ns, now_ns) > PICTURE_S:
                found = await asyncio.to_thread(self.bench.call, "picture", after=self._picture["number"])
                # The frame that is known already is not sent again.
                self._picture |= found if found["jpeg"] else {"age_s": found["age_s"]}
                self._fetched_ns = self.clock.now_ns()
            return b64decode(self._picture["jpeg"]), self._picture["age_s"]

    def person(self, request: HTTPConnection) -> Person | None:
        """Return the sender of a request; None if it is not known.

        Raises `LoginRequired`: its token is wrong. `ConfigError`: the file of the tokens is damaged.
        """
        # A browser cannot set headers of a web socket, so its page sends the client in the address.
        # It is cut, because it is kept and sent to all pages.
        client = (request.headers.get("x-rig-client") or request.query_params.get("client", ""))[:64]
        scheme, _, token = request.headers.get("authorization", "").partition(" ")
        if scheme.lower() == "bearer":
            stored = self.sessions.verify(token.strip())
            return Person(stored.name, stored.role, client)
        # A login that has ended is no error where no login is needed: a browser keeps the cookie of another start.
        if cookie := request.cookies.get(COOKIE):
            found = self.sessions.find(cookie)
            if found is not None:
                return Person(found.name, found.role, client)
        return None if self.setup.needs_login else Person(LOCAL, Role.OPERATE, client)

    def still_allowed(self, request: HTTPConnection) -> bool:
        """Return whether the sender of a request that is still open may go on: the token may have been removed."""
        try:
            return self.person(request) is not None
        except RigError:
            return False


# These two wait for nothing. As coroutines they need no thread, which a long request could occupy.


async def watcher(request: Request) -> Person:
    """Return the sender of the request. Raises `LoginRequired`."""
    server: Server = request.app.state.server
    person = server.person(request)
    if person is None:
        raise LoginRequired("This request needs a login.", next_step="Log in with a token, or send it as Bearer.")
    return person


async def manager(person: Annotated[Person, Depends(watcher)]) -> Person:
    """Return the sender of the request, who may operate, but need not have the lease. Raises `Forbidden`."""
    if person.role is not Role.OPERATE:
        raise Forbidden(
            f"The token {person.name} may only {person.role}.",
            next_step=("Use a token with the role operate.", Do.NEW_TOKEN(role="operate")),
        )
    return person


async def operator(request: Request, person: Annotated[Person, Depends(manager)]) -> Person:
    """Return the operator who sends the request, and renew the lease. Raises `Forbidden`, `LeaseHeld`."""
    server: Server = request.app.state.server
    server.lease.take(person)
    return person


async def proposer(request: Request, person: Annotated[Person, Depends(watcher)]) -> Person:
    """Return the sender, who may propose jobs, or is an operator with the lease. Raises as `operator`."""
    return person if person.role is Role.PROPOSE else await operator(request, await manager(person))


Result = TypeVar("Result")
Row = TypeVar("Row")


_LONG_WORK: Final = ThreadPoolExecutor(2, thread_name_prefix="long")
"""Exports, imports, reports and checks: few at a time, because STOP shares the interpreter."""


async def long_work(work: Callable[[], Result]) -> Result:
    """Return the result of work that takes seconds; other requests are answered in the meantime."""
    return await asyncio.get_running_loop().run_in_executor(_LONG_WORK, work)


Watcher = Annotated[Person, Depends(watcher)]
Proposer = Annotated[Person, Depends(proposer)]
Manager = Annotated[Person, Depends(manager)]
OperatorPerson = Annotated[Person, Depends(operator)]


def schemes(role: Role) -> list[Any]:
    """Return what describes in the document of the API how to log in, and the role that is needed.

    It checks nothing: `Server.person` also knows who needs no login, and the errors.
    """
    token = HTTPBearer(scheme_name="token", description="a token of rig serve --new-token", auto_error=False)
    login = APIKeyCookie(name=COOKIE, scheme_name="login", description="set by POST /login", auto_error=False)
    return [Security(scheme, scopes=[role.value]) for scheme in (token, login)]


class Routes:
    """The routes of the API by the right that they need: none, to watch, to propose a job, or to operate the bench.

    Those to ``manage`` need the role to operate, but not the lease, which another operator may have.
    """

    def __init__(self) -> None:
        self.public = APIRouter()
        self.watch = APIRouter(dependencies=[Depends(watcher), *schemes(Role.WATCH)])
        self.propose = APIRouter(dependencies=[Depends(proposer), *schemes(Role.PROPOSE)])
        self.manage = APIRouter(dependencies=[Depends(manager), *schemes(Role.OPERATE)])
        self.operate = APIRouter(dependencies=[Depends(operator), *schemes(Role.OPERATE)])


@dataclass(frozen=True, slots=True)
class PageOfList:
    """The page of a list that a request asks for."""

    request: Request
    limit: Annotated[int, Query(ge=1, le=MAX_PAGE)] = 100
    after: Annotated[str | None, Query(max_length=100)] = None

    def of(self, rows: Sequence[Row], key: Callable[[Row], str]) -> Response:
        """Return the page with an ETag, and a link to the next one; ``key`` returns the name of an entry."""
        # The name of an entry stays right when others are added above it; a number would not.
        start = 0
        if self.after is not None:
            places = [number for number, row in enumerate(rows) if key(row) == self.after]
            if not places:
                raise UsageError(
                    "The list has changed: the entry after which to continue is gone.", next_step="Start again."
                )
            start = places[0] + 1
        shown = rows[start : start + self.limit]
        more = key(shown[-1]) if start + self.limit < len(rows) else None
        body = to_json({"items": shown, "total": len(rows), "next": more}, fallback=str)
        headers = {"Cache-Control": "private, no-cache"}
        if more is not None:
            headers["Link"] = f'<{self.request.url.include_query_params(after=more)}>; rel="next"'
        digest = hashlib.sha256(body).hexdigest()[:32]
        return cached(self.request, digest, lambda: Response(body, media_type="application/json"), headers)


Page = Annotated[PageOfList, Depends()]


def cached(request: Request, digest: str, answer: Callable[[], Response], headers: dict[str, str]) -> Response:
    """Return the answer to a request, or only that the sender has it already; ``digest`` identifies its content."""
    etag = f'"{digest}"'
    known = request.headers.get("if-none-match") == etag
    response = Response(status_code=304) if known else answer()
    response.headers.update({"ETag": etag, **headers})
    return response
