"""A server process, and a browser that uses its pages: `make test-web` installs what these tests need."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import urllib.request
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest

from rig.core.clock import SystemClock

pytest.importorskip("fastapi", reason="the extra hbr-rig[web] is not installed")

RIG = [sys.executable, "-c", "from rig.cli.main import main; main()"]
CLOCK = SystemClock()
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
WAIT_S = 120  # for what takes a second on an idle computer


@dataclass
class ServerProcess:
    """A running `rig serve`."""

    process: "subprocess.Popen[str]"
    url: str
    settings: list[str] = field(default_factory=list)

    def kill(self, number: int = signal.SIGKILL) -> int:
        self.process.send_signal(number)
        return self.process.wait(30)


def call(server: ServerProcess, path: str, body: Any = None, method: str | None = None) -> Any:
    """Return what the server answers to a request of the API."""
    data = None if body is None else json.dumps(body).encode()
    request = urllib.request.Request(
        f"{server.url}api/v1/{path}", data, {"Content-Type": "application/json"}, method=method
    )
    with urllib.request.urlopen(request, timeout=WAIT_S) as answer:
        return json.load(answer)


def wait_for(server: ServerProcess, job: str, *states: str) -> str:
    """Return the state of a job when it is one of these."""
    while (state := call(server, f"jobs/{job}")["state"]) not in states:
        assert state in ("queued", "running", "paused", "waiting"), state
        CLOCK.sleep(0.05)
    return str(state)


@pytest.fixture
def serve_process(tmp_path: Path) -> Iterator[Callable[..., ServerProcess]]:
    """Return a function that starts `rig serve` on the simulated bench, always with the same data."""
    running: list[ServerProcess] = []

    def start(*settings: str, options: tuple[str, ...] = ()) -> ServerProcess:
        paths = [f"catalog.path={tmp_path}/catalog", f"state_dir={tmp_path}/state", f"calibration_dir={tmp_path}/cal"]
        given = [word for one in (*paths, *settings) for word in ("--set", one)]
        command = [*RIG, "serve", "--bench", "sim", "--seed", "1", "--port", "0"]
        process = subprocess.Popen(
            [*command, *given, *options], stderr=subprocess.PIPE, text=True, env={**os.environ, "NO_COLOR": "1"}
        )
        assert process.stderr is not None
        lines = []
        for line in process.stderr:
            lines.append(line)
            if found := re.search(r"https?://\S+/", line):
                running.append(ServerProcess(process, found.group(), given))
                return running[-1]
        pytest.fail(f"rig serve ended: {''.join(lines)}")

    yield start
    for one in running:
        with one.process:  # closes its pipe
            if one.process.poll() is None:
                one.kill(signal.SIGTERM)


@pytest.fixture(scope="session")
def launch() -> Iterator[Callable[..., Any]]:
    """Return a function that starts a headless Chromium of the system, with options of the test driver."""
    playwright = pytest.importorskip("playwright.sync_api", reason="Playwright is missing: make test-web installs it")
    if CHROMIUM is None:
        pytest.skip("Chromium is missing: apt-get install chromium")
    # The path of a socket has at most 107 characters, and the folder of the tests of one process takes most of them.
    with playwright.sync_playwright() as driver, TemporaryDirectory(dir="/tmp", ignore_cleanup_errors=True) as short:

        def start(**options: Any) -> Any:
            return driver.chromium.launch(
                executable_path=CHROMIUM,
                env={**os.environ, "TMPDIR": short},
                args=["--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-component-update"],
                **options,
            )

        yield start


@pytest.fixture(scope="session")
def chromium(launch: Callable[..., Any]) -> Iterator[Any]:
    """A Chromium with its back/forward cache, which the test driver switches off by default."""
    browser = launch(ignore_default_args=["--disable-back-forward-cache"])
    yield browser
    browser.close()


def new_context(chromium: Any, **options: Any) -> Any:
    """Return another browser window, with its own cookies and store, whose pages wait for long."""
    context = chromium.new_context(**options)
    context.set_default_timeout(1000 * WAIT_S)
    return context


@pytest.fixture
def page(chromium: Any) -> Iterator[Any]:
    """A page that fails the test on a script error, or if it asks another server."""
    context = new_context(chromium, viewport={"width": 1280, "height": 900})
    shown = context.new_page()
    problems: list[str] = []
    context.on("weberror", lambda error: problems.append(str(error.error)))
    context.on(
        "request",
        lambda one: (
            None if "://127.0.0.1:" in one.url or one.url.startswith(("data:", "blob:")) else problems.append(one.url)
        ),
    )
    yield shown
    print(shown.url, shown.inner_text("body"), sep="\n")  # pytest shows it if the test failed
    context.close()
    assert problems == []
