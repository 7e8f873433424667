"""A server in this process: the real application and bench thread, on the simulated bench with its virtual clock.

Its two halves are connected as the two processes of `rig serve` are.
"""

import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import pytest

pytest.importorskip("fastapi", reason="the extra hbr-rig[web] is not installed")

import uvicorn
from fastapi.testclient import TestClient

from rig.config import load_config
from rig.core.clock import SystemClock
from rig.web.front import guarded, uvicorn_config
from rig.web.server import Server
from rig.web.setup import Setup
from rig.web.work import run_job
from rig.web.worker import BenchWorker
from tests.small import SMALL

ENDED = ("done", "failed", "cancelled", "interrupted")


@dataclass
class Served:
    """A running server and a client."""

    worker: BenchWorker
    server: Server
    client: TestClient
    folder: Path

    def opened(self) -> Self:
        """Return the server when its bench is open: before, a stop has no torque to confirm."""
        for _ in range(6000):
            if self.worker.status.open:
                return self
            threading.Event().wait(0.01)
        pytest.fail(f"the bench is not open: {self.worker.status}")

    def post_at(self, action: str, wanted: Callable[[dict[str, Any]], bool]) -> None:
        """Pause or cancel a job at the first event that is wanted."""
        publish = self.worker.publish

        def published(kind: str, data: Any, job: Any = None) -> None:
            publish(kind, data, job)
            if kind == "plan" and wanted(data):
                self.worker.publish = publish
                assert self.client.post(f"/api/v1/jobs/{data['job']}/{action}").status_code == 200

        self.worker.publish = published

    def run(self, **request: Any) -> dict[str, Any]:
        """Submit a job, and return it when it has ended."""
        answer = self.client.post("/api/v1/jobs", json=request)
        assert answer.status_code == 201, answer.text
        assert answer.headers["location"] == f"/api/v1/jobs/{answer.json()['id']}"
        return self.wait(answer.json()["id"])

    def wait(self, job_id: str, *states: str) -> dict[str, Any]:
        """Return a job when it has one of the states; by default when it has ended."""
        for _ in range(6000):
            state = self.worker.queue.job(job_id).state  # asking the server takes more computing than the job
            if state in (states or ENDED):
                return self.client.get(f"/api/v1/jobs/{job_id}").json()
            assert state not in ENDED, self.worker.queue.job(job_id)
            threading.Event().wait(0.01)
        pytest.fail(f"the job is still {state}")


def connected(setup: Setup) -> tuple[BenchWorker, Server, Callable[[], None]]:
    """Return the two halves of a server, and a function that ends them; the worker does not run yet."""
    worker = BenchWorker(setup, SystemClock(), run_job)
    ours, theirs = socket.socketpair()
    server = Server(setup, SystemClock(), theirs)
    server.bench.start()
    bench_link = worker.connect(ours)

    def disconnect() -> None:
        server.bench.close()
        bench_link.close()
        worker.close_stops()

    return worker, server, disconnect


@contextmanager
def starting(folder: Path) -> Iterator[Callable[..., Served]]:
    """Yield a function that starts a server with its data in a folder."""
    running: list[tuple[Served, Callable[[], None]]] = []

    def start(*settings: str, needs_login: bool = False) -> Served:
        folders = [f"catalog.path='{folder}/catalog'", f"state_dir='{folder}/state'"]
        config = load_config(None, [*folders, f"calibration_dir='{folder}/cal'", *SMALL, *settings])
        setup = Setup(
            bench="sim",
            config=config,
            seed=1,
            arguments=("--bench", "sim"),
            needs_login=needs_login,
            max_upload_bytes=2_000_000,
        )
        worker, server, disconnect = connected(setup)
        client = TestClient(guarded(server), base_url="http://127.0.0.1", client=("127.0.0.1", 50000))
        thread = threading.Thread(target=worker.run, daemon=True)
        thread.start()

        def end() -> None:
            worker.end()
            thread.join(20)
            disconnect()
            assert not thread.is_alive()

        running.append((Served(worker, server, client, folder), end))
        return running[-1][0]

    yield start
    for _, end in running:
        end()


@contextmanager
def over_http(served: Served) -> Iterator[str]:
    """Yield the host and port at which a server answers over HTTP."""
    web = uvicorn.Server(uvicorn_config(served.server))
    with socket.create_server(("127.0.0.1", 0)) as listening:
        thread = threading.Thread(target=web.run, args=([listening],))
        thread.start()
        try:
            yield f"127.0.0.1:{listening.getsockname()[1]}"
        finally:
            web.should_exit = True
            served.server.hub.close()
            thread.join()


@pytest.fixture
def serve(tmp_path: Path) -> Iterator[Callable[..., Served]]:
    """Return a function that starts a server: settings as ``KEY=VALUE``."""
    with starting(tmp_path) as start:
        yield start


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """Return a running server for requests that change nothing."""
    with starting(tmp_path_factory.mktemp("served")) as start:
        yield start()
