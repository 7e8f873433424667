"""Protects the server before a request reaches the application: host, origin, sizes, slow and silent clients.

Every new connection must get through, because it may bring a STOP. So none is rejected because of their number: if
there are too many, the least useful one is closed.
"""

import asyncio
from typing import Any, Final
from urllib.parse import urlsplit
from weakref import WeakKeyDictionary

from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol, RequestResponseCycle

from rig.core.errors import UsageError
from rig.core.next_steps import Do, SomeSteps
from rig.core.phrases import whole
from rig.web.problems import ProblemResponse

MAX_BODY_BYTES: Final = 1_000_000
"""Largest size of a request, except an upload."""
BODY_TIMEOUT_S: Final = 20.0
"""Time that a body may take in addition to its size at `MIN_RATE`; then the client is disconnected."""
MIN_RATE: Final = 20_000
"""Slowest speed at which a body may come, in bytes a second."""
HEADER_TIMEOUT_S: Final = 10.0  # a client that sends byte by byte must not hold a connection
"""Time after which a client that has not sent a whole request head is disconnected."""
MAX_CONNECTIONS: Final = 400
"""Open connections: 200 listeners and as many other requests."""
_CHANGES: Final = {"POST", "PUT", "PATCH", "DELETE"}
_HEADERS: Final = [
    (
        b"content-security-policy",
        b"default-src 'self'; img-src 'self' data: blob:; style-src 'self' 'unsafe-inline'; object-src 'none'; "
        b"frame-ancestors 'none'; base-uri 'none'; form-action 'self'",
    ),
    (b"x-content-type-options", b"nosniff"),
    (b"referrer-policy", b"no-referrer"),
    (b"cross-origin-resource-policy", b"same-origin"),
    (b"cross-origin-opener-policy", b"same-origin"),
    (b"permissions-policy", b"camera=(), microphone=(), geolocation=()"),
]


class Guard:
    """A layer before the application: rejects foreign and too large requests, and adds headers to responses.

    ``hosts`` are the names and addresses by which browsers may call the server (against DNS rebinding). Requests to
    ``upload_path`` may be larger than others.
    """

    def __init__(self, app: ASGIApp, *, hosts: set[str], upload_path: str, max_upload_bytes: int) -> None:
        self._app = app
        self._hosts = {host.lower() for host in hosts}
        self._upload_path = upload_path
        self._max_upload_bytes = max_upload_bytes

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        if scope["type"] == "websocket":
            if self._rejection("GET", scope["path"], headers) is not None:
                await send({"type": "websocket.close", "code": 1008})
            else:
                await self._app(scope, receive, send)
            return
        # Reject by the headers before the body is read: a large one costs nothing then.
        limit = self._max_upload_bytes if scope["path"] == self._upload_path else MAX_BODY_BYTES
        rejection = self._rejection(scope["method"], scope["path"], headers)
        if (size := whole(headers.get("content-length", "0"))) is None or size > limit:
            rejection = rejection or (413, "The request is too large.", f"Send at most {limit} bytes.")
        received = 0
        complete = False
        loop = asyncio.get_running_loop()
        began_s = loop.time()

        async def limited() -> Message:
            """Receive the body; its errors are raised in the application, which answers them like its other errors."""
            nonlocal received, complete
            if complete:  # the next message is the end of the connection
                return await receive()
            try:
                async with asyncio.timeout_at(began_s + BODY_TIMEOUT_S + received / MIN_RATE):
                    message = await receive()
            except TimeoutError as error:
                raise HTTPException(408, "The request came too slowly.") from error
            if message["type"] == "http.request":
                received += len(message.get("body", b""))
                complete = not message.get("more_body", False)
                if received > limit:
                    raise HTTPException(413, f"The request is larger than {limit} bytes.")
            return message

        # Every answer has the headers of security, also an error.
        async def guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [*message.get("headers", []), *_HEADERS]
            await send(message)

        if rejection is None:
            await self._app(scope, limited, guarded)
        else:
            status, what, step = rejection
            await ProblemResponse(UsageError(what, next_step=step), status)(scope, receive, guarded)

    def _rejection(self, method: str, path: str, headers: Headers) -> tuple[int, str, SomeSteps] | None:
        host = headers.get("host", "")
        if _host_name(host) not in self._hosts:
            step = (
                "Use an address that the server prints at its start, or allow this name:",
                Do.SERVE_AGAIN(allow_host="NAME"),
            )
            return 421, "The server does not answer to this host name.", step
        site = headers.get("sec-fetch-site", "none")
        navigates = method == "GET" and headers.get("sec-fetch-mode") == "navigate" and not path.startswith("/api/")
        origin = headers.get("origin")
        foreign = origin is not None and _origin_host(origin) != host.lower()
        if foreign or (site not in ("none", "same-origin") and not navigates):
            return 403, "The request comes from another web site.", "Open the page of the bench itself."
        if method in _CHANGES and path != self._upload_path and headers.get("content-length", "0") != "0":
            kind = headers.get("content-type", "").partition(";")[0].strip().lower()
            if kind != "application/json":
                return 415, "The body is not JSON.", "Send Content-Type: application/json."
        return None


def _host_name(host: str) -> str:
    try:
        return (urlsplit(f"//{host}").hostname or "").lower()
    except ValueError:
        return ""


def _origin_host(origin: str) -> str:
    """Return the host and port of an origin; "" if it is not an address."""
    try:
        return urlsplit(origin).netloc.lower()
    except ValueError:
        return ""


_silent: Final[WeakKeyDictionary["PatientProtocol", None]] = WeakKeyDictionary()
"""Connections without a request that is being answered, the oldest first."""


class PatientProtocol(H11Protocol):
    """HTTP/1.1 that closes connections of clients that do not complete the head of a request in time ("slow loris").

    If there are more than `MAX_CONNECTIONS`, it closes one for each new one: the one that has been silent for the
    longest time or, if each has a request, any other.
    """

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        self._head_timer = self.loop.call_later(HEADER_TIMEOUT_S, self._check_head)
        _silent[self] = None
        if len(self.connections) > MAX_CONNECTIONS:
            self._make_room()

    def connection_lost(self, exc: Exception | None) -> None:
        self._head_timer.cancel()
        _silent.pop(self, None)
        super().connection_lost(exc)

    def handle_events(self) -> None:
        super().handle_events()
        if self._answers():
            _silent.pop(self, None)

    def on_response_complete(self) -> None:
        super().on_response_complete()
        _silent[self] = None

    def handle_websocket_upgrade(self, event: Any) -> None:
        self._head_timer.cancel()
        _silent.pop(self, None)
        super().handle_websocket_upgrade(event)

    def _answers(self) -> bool:
        """Return whether a whole request has come and its answer has not ended."""
        cycle: RequestResponseCycle | None = self.cycle
        return cycle is not None and not cycle.response_complete and not cycle.more_body

    def _make_room(self) -> None:
        others = (one for group in (_silent, self.connections) for one in group if one is not self)
        next(others).transport.abort()

    def _check_head(self) -> None:
        cycle: RequestResponseCycle | None = self.cycle
        if cycle is None or (
            cycle.response_complete and self.timeout_keep_alive_task is None
        ):  # no head, or that of a later request
            self.transport.close()
            return
        self._head_timer = self.loop.call_later(HEADER_TIMEOUT_S, self._check_head)
