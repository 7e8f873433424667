"""The web process of a server: pages, REST API, events, exports. It owns no device.

`rig.web.run` starts it as ``python -m rig.web.front LINK SOCKET``, with the numbers of two inherited descriptors, and
the set-up as JSON on standard input.
"""

import asyncio
import os
import resource
import signal
import socket
import sys
import threading
from typing import Any, Final

import uvicorn
from anyio import to_thread

from rig.core.clock import SystemClock
from rig.web.api_catalog import UPLOAD
from rig.web.app import create_app
from rig.web.guard import Guard, PatientProtocol
from rig.web.link import Link
from rig.web.server import Server
from rig.web.setup import WEB_NICE, Setup, set_priority, shorten_pauses

# each connection is a file; a script that opens many at once reaches the usual limit of 1,024
MAX_FILES: Final = 65_536
THREADS: Final = 8
"""Threads for short requests. With more, STOP would wait longer for its turn of the interpreter."""
SWITCH_S: Final = 0.001
"""Time after which a thread hands the interpreter to the next one: a fifth of the usual time, for the same reason."""
SIGN_OF_LIFE_S: Final = 1.0  # thirty may be late before `rig.web.run` ends this process
END_S: Final = 4.0  # longer: `rig serve` ends later; shorter: requests that are nearly done are cut off


def guarded(server: Server) -> Guard:
    """Return the application of a server behind its guard."""
    setup = server.setup
    hosts = {"localhost", "127.0.0.1", "::1", setup.host.strip("[]"), *setup.other_hosts}
    return Guard(create_app(server), hosts=hosts, upload_path=UPLOAD, max_upload_bytes=setup.max_upload_bytes)


class _Web(uvicorn.Server):
    """Uvicorn that tells the bench's process that it answers, and then once a second that it lives."""

    def __init__(self, config: uvicorn.Config, link: Link) -> None:
        super().__init__(config)
        self._link = link
        self._living: asyncio.Task[None] | None = None

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        to_thread.current_default_thread_limiter().total_tokens = THREADS
        asyncio.get_running_loop().set_exception_handler(_log)
        await super().startup(sockets)
        self._living = asyncio.create_task(self._live())

    async def _live(self) -> None:
        while True:
            self._link.tell("alive")
            await asyncio.sleep(SIGN_OF_LIFE_S)


def _log(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """Log an error of the event loop, except that no file can be opened: asyncio repeats this many times a second."""
    if context.get("message") != "socket.accept() out of system resource":
        loop.default_exception_handler(context)


def uvicorn_config(server: Server) -> uvicorn.Config:
    """Return the configuration of uvicorn for a server."""
    config = uvicorn.Config(
        guarded(server),
        http=PatientProtocol,
        ws="websockets-sansio",
        ws_max_size=10_000,
        ws_ping_interval=10.0,
        ws_ping_timeout=10.0,
        lifespan="off",
        log_level="error",
        access_log=False,
        server_header=False,
        timeout_keep_alive=15,
        timeout_graceful_shutdown=2,
        ssl_certfile=server.setup.certfile,
        ssl_keyfile=server.setup.keyfile,
        proxy_headers=False,
    )
    config.load()
    return config


def main(link_descriptor: int, socket_descriptor: int) -> None:
    """Serve until the bench's process ends the link, or a signal comes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl+C is for the process that owns the bench
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    most = MAX_FILES if hard == resource.RLIM_INFINITY else min(hard, MAX_FILES)
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, hard))
    set_priority(WEB_NICE)
    sys.setswitchinterval(SWITCH_S)
    setup = Setup.model_validate_json(sys.stdin.buffer.read())

    def ended() -> None:
        web.should_exit = True
        server.hub.close()  # uvicorn waits for open streams, and these never end by themselves
        threading.Timer(END_S, os._exit, (0,)).start()  # a long export, for example

    server = Server(setup, SystemClock(), socket.socket(fileno=link_descriptor), ended)
    web = _Web(uvicorn_config(server), server.bench)
    server.bench.start()
    shorten_pauses()
    with server.catalog.background_delivery():
        web.run([socket.socket(fileno=socket_descriptor)])


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
