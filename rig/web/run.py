"""Runs a server: the bench in this process, the web in another.

The web process shares neither the interpreter nor the threads of the control loop. If it ends, the present move ends,
the job pauses, and another web process starts. If this process ends, the web process ends too, and the servo's watchdog
stops the table.

Decision: docs/decisions/0020.
"""

import os
import socket
import ssl
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import Final

from rig.core.clock import SystemClock, seconds_between
from rig.core.errors import RigError, UsageError, WebEnded, os_errors_as
from rig.core.files import write
from rig.core.next_steps import Do
from rig.core.notify import print_note
from rig.safety.saved_state import SERVER_FILE, SERVER_FOLDER, BenchLock, ServerAddress
from rig.web.link import Link
from rig.web.setup import BENCH_NICE, Setup, set_priority, shorten_pauses
from rig.web.work import run_job
from rig.web.worker import BenchWorker

# longer: a failed start is noticed late; shorter: a busy small computer imports the web packages in vain
START_S: Final = 120.0
END_S: Final = 6.0
"""Longer than `rig.web.front.END_S`, after which a web process ends itself."""
# a long import or report may hold the interpreter for seconds; longer: STOP of a page is dead for longer
SILENT_S: Final = 30.0
"""Time without a sign of life after which a web process counts as hanging, and is ended."""
MAX_STARTS: Final = 3  # a process that ends again and again has a defect that another start does not fix
STARTS_WITHIN_S: Final = 60.0
"""After `MAX_STARTS` web processes within this time, the server ends."""


def run_server(setup: Setup, ready: Callable[[str], None]) -> None:
    """Serve a bench until a signal ends the program; the torque is off on return.

    ``ready`` gets the address of the page when the server answers.

    Raises `UsageError`: the address or the certificate cannot be used. `BenchBusy`: another server uses the bench.
    `WebEnded`: the web process ends again and again.
    """
    clock = SystemClock()
    _check_certificate(setup)
    folder = setup.state_folder / SERVER_FOLDER
    lock = BenchLock(folder, clock)  # one server for each bench
    set_priority(BENCH_NICE)
    try:
        worker = BenchWorker(setup, clock, run_job)
        with _socket(setup) as connection:
            web = WebProcess(worker, connection, clock)
            try:
                web.start()
                # Other commands of this user find the server by this file.
                address = ServerAddress(
                    pid=os.getpid(),
                    url=_url(setup, connection),
                    token=setup.local_token,
                    certificate=str(setup.certfile.absolute()) if setup.certfile else None,
                )
                write(folder / SERVER_FILE, address.model_dump_json().encode(), mode=0o600)
                ready(address.url)
                shorten_pauses()
                worker.run()
                if web.failure is not None:
                    raise web.failure
            finally:
                (folder / SERVER_FILE).unlink(missing_ok=True)
                web.close()
                worker.close_stops()
    finally:
        lock.close()


class WebProcess:
    """The web process of a server; it is started again if it ends.

    ``connection`` is the listening socket, which outlives the process: requests wait in it for the next one.
    """

    def __init__(self, worker: BenchWorker, connection: socket.socket, clock: SystemClock) -> None:
        self._worker = worker
        self._connection = connection
        self._clock = clock
        self._starts: deque[int] = deque(maxlen=MAX_STARTS)
        self._process: subprocess.Popen[bytes] | None = None
        self._link: Link | None = None
        self._answers = threading.Event()
        self._ended = threading.Event()
        self._alive_ns = 0
        self._closed = threading.Event()
        self._watcher = threading.Thread(target=self._watch, name="web-watch", daemon=True)
        self.failure: RigError | None = None

    def start(self) -> None:
        """Start the process and return when it answers. Raises `WebEnded`."""
        self._spawn()
        if not self._answers.wait(START_S) or self._ended.is_set():
            raise WebEnded("The web process does not start.", next_step="Look at its messages above.")
        self._watcher.start()

    def close(self) -> None:
        """End the process; a second call does nothing."""
        self._closed.set()
        self._ended.set()
        if self._watcher.ident is not None:
            self._watcher.join()
        self._end()

    def _spawn(self) -> None:
        self._starts.append(self._clock.now_ns())
        self._alive_ns = self._clock.now_ns()
        self._ended.clear()
        # The set-up goes through a pipe, because everybody can read the arguments of a process, and it has passwords.
        ours, theirs = socket.socketpair()
        with theirs:
            descriptors = (theirs.fileno(), self._connection.fileno())
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", "rig.web.front", *map(str, descriptors)],
                pass_fds=descriptors,
                stdin=subprocess.PIPE,
                start_new_session=True,  # Ctrl+C of the terminal is for this process only
            )
        assert self._process.stdin is not None
        with suppress(BrokenPipeError), self._process.stdin as standard_input:  # the process has ended already
            standard_input.write(self._worker.setup.model_dump_json().encode())
        self._link = self._worker.connect(ours, self._lost, self._lives)

    def _lives(self) -> None:
        self._alive_ns = self._clock.now_ns()
        self._answers.set()

    def _lost(self) -> None:
        self._ended.set()
        self._answers.set()

    def _watch(self) -> None:
        """Start another process after the end of one, or after its silence."""
        while not self._closed.is_set():
            silent_s = seconds_between(self._alive_ns, self._clock.now_ns())
            if not self._ended.wait(1.0) and silent_s < SILENT_S:
                continue
            if self._closed.is_set():
                return
            # No page can show the table now, and what waits would begin without a person.
            self._worker.queue.hold()
            self._end()
            full = len(self._starts) == MAX_STARTS
            if full and seconds_between(self._starts[0], self._clock.now_ns()) < STARTS_WITHIN_S:
                self.failure = WebEnded(
                    f"The web process has ended {MAX_STARTS} times within a minute. The running job has stopped.",
                    next_step=("Look at the messages above.", Do.SERVE_AGAIN()),
                )
                self._worker.end()
                return
            print_note("The web process has ended. The running job pauses, and another web process starts.")
            self._spawn()

    def _end(self) -> None:
        if self._link is not None:
            self._link.close()
            self._link = None
        if self._process is not None:
            try:
                self._process.wait(END_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
            self._process = None


def _check_certificate(setup: Setup) -> None:
    step = "Check the files of the certificate and of its key: PEM, and the key without a passphrase."
    if setup.certfile is not None:
        with os_errors_as(UsageError, "The certificate cannot be used.", next_step=step):
            context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
            context.load_cert_chain(setup.certfile, setup.keyfile, password=lambda: "")


def _url(setup: Setup, connection: socket.socket) -> str:
    scheme = "https" if setup.certfile else "http"
    host = f"[{setup.host}]" if ":" in setup.host.strip("[]") else setup.host
    return f"{scheme}://{host}:{connection.getsockname()[1]}/"


def _socket(setup: Setup) -> socket.socket:
    host = setup.host.strip("[]")
    step = "Choose another port, or another host."
    with os_errors_as(UsageError, f"The server cannot listen to {host}, port {setup.port}.", next_step=step):
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        return socket.create_server((host, setup.port), family=family, backlog=128)
