"""Many viewers and one operator at a served bench: the delay of STOP, the memory of the server, and lost events.

Each viewer does what the page Identify does: it listens to the events, and asks for one live image after the other.
The operator identifies near twins, and presses STOP at a random time of most searches, on the connection of the page.
The servo is simulated by another process, whose log has the times at which it was told to stop, and at which its torque
went off (`benchmarks.bench_stop`).
The viewers run on the same computer, and share its cores with the server.
"""

import argparse
import asyncio
import json
import os
import random
import statistics
import subprocess
import sys
import tempfile
from contextlib import suppress
from itertools import chain
from pathlib import Path
from queue import Queue
from threading import Thread
from typing import Any
from urllib.parse import urlsplit

from websockets.asyncio.client import connect as connect_viewer
from websockets.sync.client import connect as connect_operator

from benchmarks.bench_stop import CLOCK, ServedBench, served, usual_priority

TWINS = ("mug-star", "mug-white")
PICTURE_S = 0.2  # rig/web/static/pictures.js waits as long between two pictures
LATE_S = 0.3  # the goal, also with many viewers
ENDED = ("done", "failed", "cancelled", "interrupted")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--viewers", type=int, default=50)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--watch", nargs=3, metavar=("URL", "TOKEN", "NUMBER"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.watch:
        url, token, number = options.watch
        asyncio.run(watch(url, token, int(number)))
        return
    with suppress(PermissionError):
        os.setpriority(os.PRIO_PROCESS, 0, -15)
    with tempfile.TemporaryDirectory() as folder, served(Path(folder), TWINS, 12) as bench:
        print(f"Load of the computer before: {os.getloadavg()[0]:.1f}. {processes(bench)}", flush=True)
        command = [sys.executable, "-m", "benchmarks.bench_viewers", "--watch", bench.url, bench.token]
        viewers = subprocess.Popen(
            [*command, str(options.viewers)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            preexec_fn=usual_priority,
        )
        try:
            operate(bench, 60.0 * options.minutes)
        finally:
            seen, _ = viewers.communicate("", 60)  # the end of its input ends it
        print(f"Load of the computer after: {os.getloadavg()[0]:.1f}. {processes(bench)}")
        print(seen, end="")


# -- the viewers -------------------------------------------------------------------------------------------------------


async def watch(url: str, token: str, number: int) -> None:
    """Watch the bench until the standard input ends, then print what was seen."""
    place = urlsplit(url)
    counts = dict.fromkeys(("events", "lost events", "pictures", "failures"), 0)
    picture_s: list[float] = []
    head = f"Host: {place.netloc}\r\nAuthorization: Bearer {token}\r\n\r\n"
    request = f"GET /api/v1/picture HTTP/1.1\r\n{head}".encode()

    async def listen(k: int) -> None:
        last = None
        headers = {"Authorization": f"Bearer {token}"}
        address = f"ws://{place.netloc}/api/v1/socket?client=viewer-{k}"
        async with connect_viewer(address, additional_headers=headers, ping_interval=None) as socket:
            async for text in socket:
                message = json.loads(text)
                at = int(message["id"].rpartition("-")[2])  # the messages of a server are numbered without gaps
                counts["lost events"] += 0 if last is None else at - last - 1
                counts["events"] += 1
                last = at

    async def look() -> None:
        reader, writer = await asyncio.open_connection(place.hostname, place.port)
        while True:
            began_s = asyncio.get_running_loop().time()
            writer.write(request)
            answer = (await reader.readuntil(b"\r\n\r\n")).lower()
            await reader.readexactly(int(answer.split(b"content-length:")[1].split(b"\r\n")[0]))
            counts["pictures" if b" 200 " in answer[:16] else "failures"] += 1
            picture_s.append(asyncio.get_running_loop().time() - began_s)
            await asyncio.sleep(PICTURE_S)

    began_s = asyncio.get_running_loop().time()
    tasks = [asyncio.create_task(one) for k in range(number) for one in (listen(k), look())]
    await asyncio.to_thread(sys.stdin.read)
    seconds = asyncio.get_running_loop().time() - began_s
    broken = [task.exception() for task in tasks if task.done()]
    rate = counts["pictures"] / seconds / number
    print(
        f"{number} viewers for {seconds:.0f} s: {counts}, {rate:.1f} pictures a second for each; one takes "
        f"{words(picture_s)}."
    )
    print(f"Connections that broke: {broken or 'none'}")


# -- the operator ------------------------------------------------------------------------------------------------------


def operate(bench: ServedBench, seconds: float) -> None:
    """Identify, and press STOP, until the time is over; print how late STOP was."""
    brakes_s: list[float] = []
    off_s: list[float] = []
    confirmed_s: list[float] = []
    states: dict[str, int] = {}
    address = f"{bench.url.replace('http', 'ws', 1)}api/v1/socket?client=operator"
    end_ns = CLOCK.now_ns() + int(seconds * 1e9)
    headers = {"Authorization": f"Bearer {bench.token}"}
    with connect_operator(address, additional_headers=headers, ping_interval=None) as socket:
        confirmations: Queue[tuple[int, bool, int]] = Queue()
        Thread(target=listen, args=(socket, confirmations), daemon=True).start()
        while CLOCK.now_ns() < end_ns:
            job = bench.call("jobs", {"kind": "identify"})
            stop_ns = CLOCK.now_ns() + int(random.uniform(0.5, 8.0) * 1e9)
            while (state := bench.call(f"jobs/{job['id']}")["state"]) not in ENDED:
                if CLOCK.now_ns() > stop_ns:
                    began_ns = CLOCK.now_ns()
                    socket.send(json.dumps({"stop": began_ns}))
                    pressed_ns, ended, confirmed_ns = confirmations.get(timeout=60)
                    assert pressed_ns == began_ns
                    confirmed_s += [(confirmed_ns - began_ns) * 1e-9] if ended else []
                    brakes_ns, off_ns = bench.stopped_ns(began_ns)
                    brakes_s.append((brakes_ns - began_ns) * 1e-9)
                    off_s.append((off_ns - began_ns) * 1e-9)
                    stop_ns = end_ns + 60_000_000_000
                CLOCK.sleep(0.05)
            states[state] = states.get(state, 0) + 1
    print(f"Searches: {states}")
    late = sum(one > LATE_S for one in brakes_s)
    print(f"STOP until the servo has it:          {words(brakes_s)}; {late} took more than {LATE_S} s")
    print(f"STOP until the torque is off:         {words(off_s)}")
    print(f"STOP until the page has confirmation: {words(confirmed_s)}; {len(off_s) - len(confirmed_s)} were late")


def listen(socket: Any, confirmations: "Queue[tuple[int, bool, int]]") -> None:
    """Take what the server sends, as a page does: answers to STOP with their time; events are left."""
    for text in socket:
        message = json.loads(text)
        if message["kind"] == "stopped":
            confirmations.put((message["data"]["stop"], message["data"]["ended"], CLOCK.now_ns()))


def words(seconds: list[float]) -> str:
    if len(seconds) < 2:
        return f"{len(seconds)} values"
    percentiles = statistics.quantiles(seconds, n=100, method="inclusive")
    return (
        f"median {percentiles[49]:.3f} s, 99 % {percentiles[98]:.3f} s, longest {max(seconds):.3f} s of {len(seconds)}"
    )


def processes(bench: ServedBench) -> str:
    """Return the memory of the processes of the server, now and the most so far, and their time of computing."""
    parts = []
    started = [file.read_text().split() for file in Path(f"/proc/{bench.pid}/task").glob("*/children")]
    for process in (bench.pid, *map(int, chain(*started))):
        values = dict(line.split(":", 1) for line in Path(f"/proc/{process}/status").read_text().splitlines())
        command = Path(f"/proc/{process}/cmdline").read_bytes()
        name = "web process" if b"rig.web.front" in command else "bench process" if process == bench.pid else "guardian"
        now, most = (int(values[key].split()[0]) / 1024 for key in ("VmRSS", "VmHWM"))
        times = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[11:13]
        busy_s = sum(map(int, times)) / os.sysconf("SC_CLK_TCK")
        parts.append(f"{name} {now:.0f} MB (most {most:.0f} MB), {busy_s:.0f} s of computing")
    return f"Server: {'; '.join(parts)}."


if __name__ == "__main__":
    main()
