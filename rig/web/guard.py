"""Protects the server before a request reaches the application: host, origin, sizes and slow clients."""

import asyncio
from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any, Final
from urllib.parse import urlsplit

from starlette.exceptions import HTTPException
from uvicorn.protocols.http.h11_impl import H11Protocol, RequestResponseCycle

Scope = MutableMapping[str, Any]
Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]

MAX_BODY_BYTES: Final = 1_000_000
"""Largest size of a request, except an upload."""
CHUNK_TIMEOUT_S: Final = 20.0
"""Time after which a client that sends no more of its body is disconnected."""
HEADER_TIMEOUT_S: Final = 10.0
"""Time after which a client that has not sent a whole request head is disconnected."""
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

    Parameters
    ----------
    app
        The application.
    hosts
        Names and addresses by which browsers may call the server (against DNS rebinding).
    upload_path, max_upload_bytes
        The path whose requests may be larger, and their largest size.
    """

    def __init__(self, app: App, *, hosts: set[str], upload_path: str, max_upload_bytes: int) -> None:
        self._app = app
        self._hosts = {host.lower() for host in hosts}
        self._upload_path = upload_path
        self._max_upload_bytes = max_upload_bytes

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            if scope["type"] == "lifespan":
                await self._app(scope, receive, send)
            return  # there are no web sockets
        headers = {name.decode("latin-1"): value.decode("latin-1") for name, value in scope["headers"]}
        rejection = self._rejection(scope["method"], scope["path"], headers)
        if rejection is not None:
            await _reject(send, *rejection)
            return
        limit = self._max_upload_bytes if scope["path"] == self._upload_path else MAX_BODY_BYTES
        declared = headers.get("content-length", "0")
        if not declared.isdecimal() or int(declared) > limit:
            await _reject(send, 413, "The request is too large.", f"Send at most {limit} bytes.")
            return
        received = 0
        complete = False

        async def limited() -> Message:
            """Receive the body; its errors are raised in the application, which answers them like its other errors."""
            nonlocal received, complete
            if complete:  # the next message is the end of the connection
                return await receive()
            try:
                message = await asyncio.wait_for(receive(), CHUNK_TIMEOUT_S)
            except TimeoutError as error:
                raise HTTPException(408, "The request came too slowly.") from error
            if message["type"] == "http.request":
                received += len(message.get("body", b""))
                complete = not message.get("more_body", False)
                if received > limit:
                    raise HTTPException(413, f"The request is larger than {limit} bytes.")
            return message

        async def guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [*message.get("headers", []), *_HEADERS]
            await send(message)

        await self._app(scope, limited, guarded)

    def _rejection(self, method: str, path: str, headers: dict[str, str]) -> tuple[int, str, str] | None:
        host = headers.get("host", "")
        if _host_name(host) not in self._hosts:
            step = "Use an address that rig serve prints, or allow this name with --allow-host."
            return 421, "The server does not answer to this host name.", step
        site = headers.get("sec-fetch-site", "none")
        navigates = method == "GET" and headers.get("sec-fetch-mode") == "navigate" and not path.startswith("/api/")
        origin = headers.get("origin")
        foreign = origin is not None and urlsplit(origin).netloc.lower() != host.lower()
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


async def _reject(send: Send, status: int, what: str, next_step: str) -> None:
    from rig.web.problems import problem_body

    body = problem_body(status, what, next_step)
    headers = [(b"content-type", b"application/problem+json"), (b"content-length", str(len(body)).encode())]
    await send({"type": "http.response.start", "status": status, "headers": [*headers, *_HEADERS]})
    await send({"type": "http.response.body", "body": body})


class PatientProtocol(H11Protocol):
    """HTTP/1.1 that disconnects clients that do not complete the head of a request in time ("slow loris")."""

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        self._head_timer = self.loop.call_later(HEADER_TIMEOUT_S, self._check_head)

    def connection_lost(self, exc: Exception | None) -> None:
        self._head_timer.cancel()
        super().connection_lost(exc)

    def _check_head(self) -> None:
        cycle: RequestResponseCycle | None = self.cycle
        if cycle is None or (
            cycle.response_complete and self.timeout_keep_alive_task is None
        ):  # no head, or that of a later request
            self.transport.close()
            return
        self._head_timer = self.loop.call_later(HEADER_TIMEOUT_S, self._check_head)
