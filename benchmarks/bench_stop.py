"""Time from STOP to torque off, by the servo's own log, in the situations in which STOP could be late.

The servo is simulated in real time by another process, which logs each goal, and each instruction that switches its
torque. A table in motion brakes before its torque goes off, which takes about half a second. All processes use the same
monotonic clock. ``--load 8`` runs eight busy processes beside each measurement but the idle ones. The simulated
devices, the browser and the clients that press STOP have a higher priority if the system permits it (for example to
root): at a real bench they do not share the computer's cores.
"""

import argparse
import json
import os
import random
import re
import shutil
import socket
import statistics
import subprocess
import sys
import tempfile
import threading
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from urllib.parse import urlsplit

from rig.core.clock import SystemClock
from rig.safety.stop_channel import StopRequest

RIG = [sys.executable, "-c", "from rig.cli.main import main; main()"]
LOGGING_BENCH = """
import sys, time
from sim.servo.device import SimServo
log, switch, rotate = open(sys.argv.pop(1), "a", buffering=1), SimServo._on_torque_enable, SimServo._on_goal
def switched(servo):
    log.write(f"{time.monotonic_ns()} {'on' if servo.memory['Torque Enable'] else 'off'}\\n")
    switch(servo)
def rotated(servo, pursue):
    log.write(f"{time.monotonic_ns()} goal\\n")
    rotate(servo, pursue)
SimServo._on_torque_enable, SimServo._on_goal = switched, rotated
from rig.cli.main import main
main()
"""
CLOCK = SystemClock()
USUAL = os.getpriority(os.PRIO_PROCESS, 0)
PAGES = ("settings", "identify", "catalog", "calibrations", "runs", "log")
EXPORTS = """
import sys, threading, urllib.request
def export():
    while True:
        request = urllib.request.Request(sys.argv[1], headers={"Authorization": f"Bearer {sys.argv[2]}"})
        with urllib.request.urlopen(request, timeout=600) as answer:
            while answer.read(1 << 16):
                pass
for _ in range(45):
    threading.Thread(target=export).start()
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=100, help="stops in each situation")
    parser.add_argument("--load", type=int, default=8, help="busy processes")
    parser.add_argument("--only", help="situations whose names contain this text")
    parser.add_argument("--out", type=Path, help="JSON file to write")
    options = parser.parse_args()
    rows: dict[str, list[float]] = {}
    with suppress(PermissionError):
        os.setpriority(os.PRIO_PROCESS, 0, -15)
    with tempfile.TemporaryDirectory() as folder, served(Path(folder)) as bench:
        for name, situation in SITUATIONS.items():
            if options.only and options.only not in name:
                continue
            with ExitStack() as held:
                for _ in range(0 if "idle" in name else options.load):
                    beside(held, "while True: pass")
                stop = situation(bench, held)
                rows[name] = [bench.measure(stop) for _ in range(options.runs)]
            print(f"{name:60s} {words(rows[name])}", flush=True)
        print(f"Motions that failed to start, and were started again: {bench.failed_starts}")
    if options.out:
        options.out.write_text(json.dumps(rows))


def words(seconds: list[float]) -> str:
    return f"median {statistics.median(seconds):.3f} s, worst {max(seconds):.3f} s of {len(seconds)}"


def usual_priority() -> None:
    """Called in a new process before its program begins."""
    os.setpriority(os.PRIO_PROCESS, 0, USUAL)


def beside(held: ExitStack, *program: str) -> None:
    """Run a Python program until the end of the situation."""
    process = subprocess.Popen([sys.executable, "-c", *program], stderr=subprocess.DEVNULL, preexec_fn=usual_priority)
    held.callback(process.wait)
    held.callback(process.kill)


class ServedBench:
    """A served bench whose servo has a log."""

    def __init__(self, folder: Path, url: str, token: str, pid: int) -> None:
        self.folder = folder
        self.url = url
        self.token = token
        self.pid = pid
        self.state = folder / "state" / "sim-bench"
        self.failed_starts = 0

    def call(self, path: str, body: object = None, token: str | None = None) -> dict:
        data = None if body is None else json.dumps(body).encode()
        headers = {"Content-Type": "application/json", "Authorization": f"Bearer {token or self.token}"}
        request = urllib.request.Request(f"{self.url}api/v1/{path}", data, headers)
        with urllib.request.urlopen(request, timeout=60) as answer:
            return json.load(answer)

    def stopped_ns(self, after_ns: int) -> tuple[int, int]:
        """Return when the servo got the goal at which it stopped, and when its torque went off, after a time.

        A table at rest gets no goal: both are then the same.
        """
        while True:
            goal_ns = None
            for line in (self.folder / "servo.log").read_text().splitlines():
                time, what = line.split()
                if int(time) > after_ns and what == "off":
                    return goal_ns or int(time), int(time)
                if int(time) > after_ns and what == "goal":
                    goal_ns = int(time)
            CLOCK.sleep(0.02)

    def measure(self, stop: Callable[[], int]) -> float:
        """Rotate the table, stop it, and return the seconds until its torque was off."""
        while (status := self.call("status")).get("job") or not status["open"]:
            CLOCK.sleep(0.05)
        target_deg = -350 if (status.get("table_deg") or 0.0) > 0 else 350
        job = self.call("jobs", {"kind": "goto", "angle_deg": target_deg})
        while not self.call("status").get("servo", {}).get("moving"):
            if self.call(f"jobs/{job['id']}")["state"] == "failed":  # the simulated bus was too slow at this load
                self.failed_starts += 1
                return self.measure(stop)
            CLOCK.sleep(0.05)
        CLOCK.sleep(random.uniform(0.3, 0.8))
        began_ns = stop()
        return (self.stopped_ns(began_ns)[1] - began_ns) * 1e-9


@contextmanager
def served(folder: Path, objects: tuple[str, ...] = ("lamp",), views: int = 36) -> Iterator[ServedBench]:
    """Serve a bench with enrolled objects; the last one is on its table."""
    home = folder / "bench"
    log = folder / "bench" / "servo.log"
    simulated = subprocess.Popen(
        [sys.executable, "-c", LOGGING_BENCH, str(folder / "servo.log"), "sim-bench", "--folder", str(home)],
        stdout=subprocess.PIPE,
        text=True,
    )
    assert simulated.stdout is not None
    simulated.stdout.readline()
    log.symlink_to(folder / "servo.log")
    base = ["--config", str(home / "rig.toml"), "--set", f"catalog.path={folder}/catalog"]
    for name in objects:  # on a bench with a clock of its own: this takes less time than on that of real time
        words = ["--bench", "sim", "--set", f"bench.sim.object={name}", "--views", str(views)]
        subprocess.run([*RIG, "enroll", name, *base, *words], check=True, capture_output=True)
    subprocess.run([*RIG, "sim-bench", "put", objects[-1], "--folder", str(home)], check=True, capture_output=True)
    made = subprocess.run(
        [*RIG, "serve", *base, "--new-token", "operator", "--role", "operate"],
        check=True,
        capture_output=True,
        text=True,
    )
    token = made.stdout.strip()
    server = subprocess.Popen(
        [*RIG, "serve", *base, "--port", "0", "--login"],
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=usual_priority,
    )
    assert server.stderr is not None
    url = next(found.group() for line in server.stderr if (found := re.search(r"http://\S+/", line)))
    threading.Thread(target=server.stderr.read, daemon=True).start()
    bench = ServedBench(home, url, token, server.pid)
    try:
        job = bench.call("jobs", {"kind": "reference", "here": True})
        while (job := bench.call(f"jobs/{job['id']}"))["state"] not in ("done", "failed"):
            CLOCK.sleep(0.2)
        assert job["state"] == "done", job["error"]
        yield bench
    finally:
        for process in (server, simulated):
            process.terminate()
            process.wait(30)


# -- situations: each prepares itself, and returns a function that stops and returns when it did -----------------------

Stop = Callable[[], int]


def by_request(bench: ServedBench, _held: ExitStack) -> Stop:
    def stop() -> int:
        began_ns = CLOCK.now_ns()
        bench.call("stop", {})
        return began_ns

    return stop


def in_browser(bench: ServedBench, held: ExitStack, tabs: int = 1) -> Stop:
    """One tab that has shown six pages, with the back/forward cache; or several tabs of the page Bench."""
    from playwright.sync_api import sync_playwright

    driver = held.enter_context(sync_playwright())
    browser = driver.chromium.launch(
        executable_path=shutil.which("chromium"),
        args=["--no-sandbox", "--disable-gpu", "--disable-background-networking"],
        ignore_default_args=["--disable-back-forward-cache"],
    )
    held.callback(browser.close)
    context = browser.new_context()
    page = context.new_page()
    page.goto(f"{bench.url}login")
    page.fill("#token", bench.token)
    page.click("#login button")
    page.wait_for_selector("#state.good", timeout=60_000)
    if tabs == 1:
        for name in PAGES:
            page.goto(f"{bench.url}{name}")
            page.wait_for_selector("#state.good", timeout=60_000)
    else:
        for _ in range(tabs):
            page = context.new_page()
            page.goto(bench.url)
            page.wait_for_selector("#state.good", timeout=60_000)
        for tab in context.pages:  # the test driver lets all tabs behave as if they were in front; people see one
            context.new_cdp_session(tab).send("Emulation.setFocusEmulationEnabled", {"enabled": False})
        page.bring_to_front()

    def stop() -> int:
        """Press the button; the time is that of the press in the page, without the way of the test driver to it."""
        to_monotonic_ns = CLOCK.now_ns() - CLOCK.utc().timestamp() * 1e9
        pressed_ms = page.evaluate(
            "() => { const at = performance.timeOrigin + performance.now(); "
            "document.getElementById('stop').click(); return at; }"
        )
        return round(pressed_ms * 1e6 + to_monotonic_ns)

    return stop


def by_rig_stop(bench: ServedBench, _held: ExitStack) -> Stop:
    """What `rig stop` sends after its own start, beside a queue."""

    def stop() -> int:
        for _ in range(5):
            bench.call("jobs", {"kind": "home"})
        began_ns = CLOCK.now_ns()
        StopRequest(bench.state).close()
        return began_ns

    return stop


def with_queue(bench: ServedBench, held: ExitStack) -> Stop:
    """As many trays of 200 objects as may wait."""
    tray = {"kind": "tray", "objects": [{"name": f"object-{k}", "note": "x" * 60} for k in range(200)]}
    request = by_request(bench, held)

    def stop() -> int:
        with suppress(OSError):
            for _ in range(50):
                bench.call("jobs", tray)
        return request()

    return stop


def beside_exports(bench: ServedBench, held: ExitStack) -> Stop:
    """45 exports at a time, one after the other."""
    beside(held, EXPORTS, f"{bench.url}api/v1/export", bench.token)
    return by_request(bench, held)


def beside_silent_connections(bench: ServedBench, held: ExitStack) -> Stop:
    """450 connections that send nothing; those that the server has closed are opened again before each stop."""
    place = urlsplit(bench.url)
    silent: list[socket.socket] = []
    held.callback(lambda: [one.close() for one in silent])
    request = by_request(bench, held)

    def stop() -> int:
        for one in silent:
            one.close()
        silent[:] = [socket.create_connection((place.hostname, place.port), timeout=30) for _ in range(450)]
        return request()

    return stop


def after_wrong_tokens(bench: ServedBench, held: ExitStack) -> Stop:
    request = by_request(bench, held)

    def stop() -> int:
        for _ in range(6):
            with suppress(OSError):
                bench.call("stop", {}, token="rig_wrong")
        return request()

    return stop


SITUATIONS: dict[str, Callable[[ServedBench, ExitStack], Stop]] = {
    "idle: request": by_request,
    "idle: page": in_browser,
    "1a page, after six pages with the back/forward cache": in_browser,
    "1b page, one of six tabs": lambda bench, held: in_browser(bench, held, 6),
    "2 rig stop beside a queue": by_rig_stop,
    "3 request, with long trays that wait": with_queue,
    "4 request, beside 45 exports": beside_exports,
    "5 request, beside 450 silent connections": beside_silent_connections,
    "6 request, after wrong tokens": after_wrong_tokens,
}


if __name__ == "__main__":
    main()
