"""A server in this process: the real application and bench thread, on the simulated bench with its virtual clock."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("fastapi", reason="the extra hbr-rig[web] is not installed")

from fastapi.testclient import TestClient

from rig.config import load_config
from rig.core.clock import SystemClock
from rig.web.access import Tokens
from rig.web.api_catalog import UPLOAD
from rig.web.app import create_app
from rig.web.guard import Guard
from rig.web.run import Listening, make_server
from rig.web.server import Server
from tests.small import SMALL

ENDED = ("done", "failed", "cancelled", "interrupted")


@dataclass
class Served:
    """A running server and a client."""

    server: Server
    client: TestClient
    folder: Path

    def run(self, **request: Any) -> dict[str, Any]:
        """Submit a job, and return it when it has ended."""
        answer = self.client.post("/api/v1/jobs", json=request)
        assert answer.status_code == 201, answer.text
        return self.wait(answer.json()["id"])

    def wait(self, job_id: str, *states: str) -> dict[str, Any]:
        """Return a job when it has one of the states; by default when it has ended."""
        for _ in range(6000):
            state = self.server.queue.job(job_id).state  # asking the server takes more computing than the job
            if state in (states or ENDED):
                return self.client.get(f"/api/v1/jobs/{job_id}").json()
            assert state not in ENDED, self.server.queue.job(job_id)
            threading.Event().wait(0.01)
        pytest.fail(f"the job is still {state}")


@contextmanager
def starting(folder: Path) -> Iterator[Callable[..., Served]]:
    """Yield a function that starts a server with its data in a folder."""
    running: list[tuple[Served, threading.Thread]] = []

    def start(*settings: str, needs_login: bool = False) -> Served:
        folders = [f"catalog.path='{folder}/catalog'", f"state_dir='{folder}/state'"]
        config = load_config(None, [*folders, f"calibration_dir='{folder}/cal'", *SMALL, *settings])
        web = config.state_path("sim") / "web"
        listening = Listening("127.0.0.1", 0, (), None, None, needs_login, 2_000_000)
        tokens = Tokens(web, SystemClock())
        server = make_server("sim", config, 1, ("--bench", "sim"), listening, tokens, SystemClock(), web)
        guard = Guard(create_app(server), hosts={"127.0.0.1"}, upload_path=UPLOAD, max_upload_bytes=2_000_000)
        client = TestClient(guard, base_url="http://127.0.0.1", client=("127.0.0.1", 50000))
        thread = threading.Thread(target=server.worker.run, daemon=True)
        thread.start()
        running.append((Served(server, client, folder), thread))
        return running[-1][0]

    yield start
    for served, thread in running:
        served.server.worker.end()
        thread.join(20)
        assert not thread.is_alive()


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
