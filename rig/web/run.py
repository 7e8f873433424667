"""Runs a server: the bench in the main thread, the web in another."""

import os
import secrets
import socket
import sys
import threading
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

import uvicorn

from rig.bench import Bench, open_bench
from rig.catalog.background import BackgroundCheck
from rig.config import RigConfig
from rig.core.clock import SystemClock
from rig.core.errors import RigError, UsageError, os_errors_as
from rig.core.files import write
from rig.safety.bench_lock import BenchLock
from rig.safety.saved_state import SERVER_FILE, SERVER_FOLDER, ServerAddress
from rig.web.access import Lease, Sessions, Tokens
from rig.web.api_catalog import UPLOAD
from rig.web.app import create_app
from rig.web.bench_catalog import BenchCatalog
from rig.web.guard import Guard, PatientProtocol
from rig.web.hub import Hub
from rig.web.jobs import JobQueue
from rig.web.picture import LivePicture
from rig.web.requests import Job
from rig.web.server import Server
from rig.web.work import WorkFactory, doctor_findings
from rig.web.worker import BenchWorker

MAX_CONNECTIONS: Final = 400
"""Open connections: 200 listeners and as many other requests."""
START_S: Final = 10.0
RUNS: Final = "runs"


@dataclass(frozen=True, slots=True)
class Listening:
    """The address at which a server listens, and its allowed clients."""

    host: str
    port: int
    other_hosts: tuple[str, ...]
    certfile: Path | None
    keyfile: Path | None
    needs_login: bool
    max_upload_bytes: int


def run_server(
    bench: str,
    config: RigConfig,
    seed: int | None,
    arguments: tuple[str, ...],
    listening: Listening,
    tokens: Tokens,
    ready: Callable[[str], None],
) -> None:
    """Serve a bench until a signal ends the program; the torque is off on return.

    Parameters
    ----------
    bench, config, seed
        The bench to open.
    arguments
        Arguments of `rig` that select the same bench.
    listening, tokens
        The address at which to listen, and the tokens of those who may log in.
    ready
        Called with the address of the page when the server answers.

    Raises
    ------
    UsageError
        The address cannot be used.
    BenchBusy
        Another server uses the bench.
    """
    clock = SystemClock()
    folder = config.state_path(bench) / SERVER_FOLDER
    lock = BenchLock(folder, clock)  # one server for each bench
    try:
        server = make_server(bench, config, seed, arguments, listening, tokens, clock, folder)
        hosts = {"localhost", "127.0.0.1", "::1", listening.host.strip("[]"), *listening.other_hosts}
        guard = Guard(create_app(server), hosts=hosts, upload_path=UPLOAD, max_upload_bytes=listening.max_upload_bytes)
        with _socket(listening) as connection:
            web = _Web(_uvicorn_config(guard, listening))
            thread = threading.Thread(target=web.run, args=([connection],), name="web", daemon=True)
            thread.start()
            try:
                web.answers.wait(START_S)
                scheme = "https" if listening.certfile else "http"
                host = f"[{listening.host}]" if ":" in listening.host.strip("[]") else listening.host
                url = f"{scheme}://{host}:{connection.getsockname()[1]}/"
                address = ServerAddress(
                    pid=os.getpid(),
                    url=url,
                    token=server.sessions.local_token,
                    certificate=str(listening.certfile.absolute()) if listening.certfile else None,
                )
                write(folder / SERVER_FILE, address.model_dump_json().encode(), mode=0o600)
                ready(url)
                with checked_catalog(server), server.catalog.background_delivery():
                    server.worker.run()
            finally:
                (folder / SERVER_FILE).unlink(missing_ok=True)
                server.hub.close()
                server.picture.closed = True
                web.should_exit = True
                thread.join(START_S)
    finally:
        lock.close()


def checked_catalog(server: Server) -> AbstractContextManager[object]:
    """Return a check of the catalog during the work of a ``with`` block; damage is on stderr and in the status."""
    place = server.config.catalog_place(server.bench)
    if not place.may_exist():
        return nullcontext()

    def report(damage: RigError) -> None:
        server.damage = damage
        print_note(f"{damage.what} Next step: {damage.next_step}")

    return BackgroundCheck(place, server.clock, report)


def print_note(text: str) -> None:
    """Print a note on stderr, unless it is closed."""
    with suppress(OSError):
        print(f"Note: {text}", file=sys.stderr, flush=True)


class _Web(uvicorn.Server):
    """Uvicorn in a thread: signals belong to the main thread, which owns the bench."""

    def __init__(self, config: uvicorn.Config) -> None:
        super().__init__(config)
        self.answers = threading.Event()

    def install_signal_handlers(self) -> None:
        """Install no signal handlers."""

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        self.answers.set()


def make_server(
    bench: str,
    config: RigConfig,
    seed: int | None,
    arguments: tuple[str, ...],
    listening: Listening,
    tokens: Tokens,
    clock: SystemClock,
    folder: Path,
) -> Server:
    """Return the parts of a server, connected to each other; nothing is open and nothing listens yet."""
    hub = Hub(secrets.token_hex(4))
    picture = LivePicture(clock)

    def changed(job: Job) -> None:
        hub.publish("job", job.model_dump(mode="json"))

    def opened() -> Bench:
        return open_bench(bench, config, seed=seed)

    catalog = BenchCatalog(config.catalog_place(bench), clock, partial(hub.publish, "catalog"), print_note)
    queue = JobQueue(folder, clock, changed, arguments)
    runs = config.catalog_path(bench) / RUNS
    factory = WorkFactory(catalog, runs, lambda: doctor_findings(bench, config, seed, arguments), seed or 0)
    worker = BenchWorker(opened, queue, hub, picture, factory, clock)
    return Server(
        bench=bench,
        config=config,
        clock=clock,
        worker=worker,
        queue=queue,
        hub=hub,
        picture=picture,
        sessions=Sessions(tokens, clock),
        lease=Lease(clock, partial(hub.publish, "lease")),
        runs=runs,
        catalog=catalog,
        needs_login=listening.needs_login,
        secure_cookies=listening.certfile is not None,
    )


def _socket(listening: Listening) -> socket.socket:
    host = listening.host.strip("[]")
    step = "Choose another --port, or another --host."
    with os_errors_as(UsageError, f"The server cannot listen to {host}, port {listening.port}.", next_step=step):
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        return socket.create_server((host, listening.port), family=family, backlog=128)


def _uvicorn_config(app: Any, listening: Listening) -> uvicorn.Config:
    step = "Check the files of --certfile and --keyfile."
    with os_errors_as(UsageError, "The certificate cannot be used.", next_step=step):
        config = uvicorn.Config(
            app,
            http=PatientProtocol,
            ws="none",
            lifespan="off",
            log_level="warning",
            access_log=False,
            server_header=False,
            limit_concurrency=MAX_CONNECTIONS,
            timeout_keep_alive=15,
            timeout_graceful_shutdown=2,
            ssl_certfile=listening.certfile,
            ssl_keyfile=listening.keyfile,
            proxy_headers=False,
        )
        config.load()
    return config
