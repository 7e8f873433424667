"""STOP of a server process: in a browser as people use it, and beside exports and silent connections."""

import os
import signal
import socket
import subprocess
import threading
import urllib.error
import urllib.request
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest

from tests.browser.conftest import CLOCK, RIG, WAIT_S, call, new_context, wait_for

pytestmark = pytest.mark.nightly  # make test-web runs them
PAGES = ("settings", "identify", "catalog", "calibrations", "runs", "log")
SLOW = ("bench.sim.speed=1", "table.velocity_dps=4")
"""A rotation by 350° that takes 90 s: longer than any of these tests waits for a stop, also on a busy computer."""


def rotate(server: Any, angle_deg: float = 350.0) -> str:
    """Start a long rotation, and return the id of its job when the table moves."""
    job = call(server, "jobs", {"kind": "goto", "angle_deg": angle_deg})["id"]
    while not (call(server, "status")["servo"] or {}).get("moving"):  # null until the bench is open
        CLOCK.sleep(0.05)
    return str(job)


def stopped(server: Any, job: str) -> None:
    assert wait_for(server, job, "cancelled") == "cancelled"
    status = call(server, "status")
    assert status["state"] in ("ready", "stopped")
    assert not status["servo"]["moving"]
    assert status["table_deg"] < 300.0


def web_process(server: Any) -> int:
    """Return the number of the web process of a server."""
    (child,) = (
        int(process.name)
        for process in Path("/proc").iterdir()
        if process.name.isdecimal()
        and b"rig.web.front" in _read(process / "cmdline")
        and _parent(process) == server.process.pid
    )
    return child


def _read(path: Path) -> bytes:
    with suppress(OSError):
        return path.read_bytes()
    return b""


def _parent(process: Path) -> int:
    return next(
        (int(line.split()[1]) for line in _read(process / "status").splitlines() if line.startswith(b"PPid")), 0
    )


def ended(pid: int) -> bool:
    return not Path(f"/proc/{pid}").exists() or b"State:\tZ" in _read(Path(f"/proc/{pid}/status"))


# -- the browser -------------------------------------------------------------------------------------------------------


def test_stop_on_the_sixth_page_with_the_back_forward_cache(chromium, serve_process):
    server = serve_process(*SLOW)
    page = new_context(chromium).new_page()
    for name in PAGES:
        page.goto(f"{server.url}{name}")
        page.wait_for_selector("#state.good")
    job = rotate(server)
    page.click("#stop")
    page.wait_for_selector("#stop-state .confirmed")
    stopped(server, job)
    page.evaluate("history.back()")  # from the cache: it gets its events again
    page.wait_for_url("**/runs", wait_until="commit")
    page.wait_for_selector("#state.good")
    job = rotate(server)
    page.click("#stop")
    page.wait_for_selector("#stop-state .confirmed")
    stopped(server, job)


def test_stop_in_each_of_six_tabs_of_the_bench(chromium, serve_process):
    server = serve_process(*SLOW)
    context = new_context(chromium)
    tabs = [context.new_page() for _ in range(6)]
    for tab in tabs:
        tab.goto(server.url)
    for tab in tabs:
        tab.bring_to_front()
        tab.wait_for_selector("#live-image[src^='blob:']")
    for tab in (tabs[-1], tabs[0]):
        job = rotate(server)
        tab.bring_to_front()
        tab.click("#stop")
        tab.wait_for_selector("#stop-state .confirmed")
        stopped(server, job)


def test_page_warns_after_a_second_if_the_bench_does_not_confirm(chromium, serve_process):
    server = serve_process(*SLOW)
    page = new_context(chromium).new_page()
    page.goto(server.url)
    page.wait_for_selector("#state.good")
    server.process.send_signal(signal.SIGSTOP)  # the process that owns the bench hangs
    try:
        page.click("#stop")
        page.wait_for_selector("#stop-state .failed:has-text('NOT STOPPED: switch off the supply')")
    finally:
        server.process.send_signal(signal.SIGCONT)
    page.wait_for_selector("#stop-state .confirmed")  # it has carried out the stop now


def test_picture_without_successors_is_marked(chromium, serve_process):
    server = serve_process("bench.sim.speed=1")
    page = new_context(chromium).new_page()
    page.goto(server.url)
    page.wait_for_selector("#live-image[src^='blob:']")
    page.wait_for_selector("#live-age", state="hidden")
    server.process.send_signal(signal.SIGSTOP)
    try:
        page.wait_for_selector("#live.stale")
        assert "no new one comes" in page.text_content("#live-age")
    finally:
        server.process.send_signal(signal.SIGCONT)
    page.wait_for_selector("#live-age", state="hidden")


# -- other programs ----------------------------------------------------------------------------------------------------


def test_rig_stop_also_cancels_the_queue_of_the_server(serve_process):
    server = serve_process(*SLOW)
    first = rotate(server)
    second = call(server, "jobs", {"kind": "goto", "angle_deg": -350})["id"]
    done = subprocess.run(
        [*RIG, "stop", "--bench", "sim", *server.settings], capture_output=True, text=True, timeout=WAIT_S
    )
    assert done.returncode == 0, done.stderr
    stopped(server, first)
    assert call(server, f"jobs/{second}")["started_utc"] is None
    assert call(server, f"jobs/{second}")["state"] == "cancelled"


def test_stop_beside_exports(serve_process):
    server = serve_process("bench.sim.speed=1000", 'bench.sim.object="lamp"')
    for name in ("lamp", "mug-star", "mug-white", "dice", "teapot", "toy-car"):
        job = call(server, "jobs", {"kind": "enroll", "name": name, "views": 36})["id"]
        assert wait_for(server, job, "done") == "done"
    server.kill(signal.SIGTERM)
    server = serve_process(*SLOW)
    job = rotate(server)

    def export() -> None:
        with suppress(OSError), urllib.request.urlopen(f"{server.url}api/v1/export", timeout=120) as answer:
            while answer.read(1 << 16):
                pass

    exports = [threading.Thread(target=export, daemon=True) for _ in range(45)]
    for thread in exports:
        thread.start()
    assert call(server, "stop", method="POST")["ended"]  # long before the exports
    stopped(server, job)
    server.kill(signal.SIGTERM)


def test_stop_beside_silent_and_slow_connections(serve_process):
    server = serve_process(*SLOW)
    place = urlsplit(server.url)
    job = rotate(server)
    with ExitStack() as open_ones:
        silent = [
            open_ones.enter_context(socket.create_connection((place.hostname, place.port), timeout=60))
            for _ in range(450)
        ]
        assert call(server, "stop", method="POST")["ended"]
        stopped(server, job)
        slow = open_ones.enter_context(socket.create_connection((place.hostname, place.port), timeout=60))
        slow.sendall(b"POST /api/v1/jobs HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: application/json\r\n")
        slow.sendall(b"Content-Length: 900000\r\n\r\n")
        with suppress(OSError):  # closed by the server
            while True:  # each byte in time, but the whole body would take weeks
                slow.sendall(b" ")
                CLOCK.sleep(0.2)
                slow.setblocking(False)
                with suppress(BlockingIOError):
                    if slow.recv(1000):
                        break
                slow.setblocking(True)
        for one in silent[:50]:  # the oldest had to go
            assert one.recv(100) == b""
        assert call(server, "health")["status"] == "ok"


# -- one of the two processes ends -------------------------------------------------------------------------------------


def test_job_pauses_if_the_web_process_ends_and_resumes_with_the_next_one(serve_process):
    server = serve_process("bench.sim.speed=3", 'bench.sim.object="lamp"')
    job = call(server, "jobs", {"kind": "enroll", "name": "lamp", "views": 24})["id"]
    waiting = call(server, "jobs", {"kind": "home"})["id"]
    while call(server, f"jobs/{job}")["views"] < 2:
        CLOCK.sleep(0.05)
    first = web_process(server)
    os.kill(first, signal.SIGKILL)
    while True:
        with suppress(OSError, urllib.error.URLError, ValueError):
            if call(server, f"jobs/{job}")["state"] == "paused":
                break
        CLOCK.sleep(0.1)
    assert web_process(server) != first
    assert call(server, f"jobs/{waiting}")["state"] == "interrupted"
    call(server, f"jobs/{job}/resume", {})
    assert wait_for(server, job, "done") == "done"
    assert call(server, f"jobs/{job}")["views"] == 24


def test_web_process_ends_with_the_process_of_the_bench(serve_process):
    server = serve_process(*SLOW)
    web = web_process(server)
    server.kill(signal.SIGKILL)
    for _ in range(600):
        if ended(web):
            break
        CLOCK.sleep(0.05)
    assert ended(web)
    place = urlsplit(server.url)
    with pytest.raises(OSError):  # noqa: PT011 - nothing listens any more
        socket.create_connection((place.hostname, place.port), timeout=5).close()
