"""The server under load: the time between two readings of the servo in motion, with and without many listeners."""

import argparse
import contextlib
import json
import re
import subprocess
import sys
import tempfile
import threading
import urllib.request
from pathlib import Path

RIG = [sys.executable, "-c", "from rig.cli.main import main; main()"]
VIEWERS, LISTENERS = 20, 50


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--views", type=int, default=24, help="of each enrollment")
    parser.add_argument("--out", type=Path, help="JSON file to write")
    options = parser.parse_args()
    alone, _, _ = measured(options.views, 0, 0)
    loaded, frames, events = measured(options.views, VIEWERS, LISTENERS)
    print(f"enrollment of {options.views} views in real time; {VIEWERS} live pictures and {LISTENERS} event streams:")
    print(f"  received {frames} frames and {events} events")
    print("  watchdog trips: 0 (a trip ends an enrollment, and both were completed)")
    for quantile in alone:
        ratio = loaded[quantile] / alone[quantile]
        print(f"  servo poll interval, quantile {quantile}: {alone[quantile] * 1e3:.1f} ms alone, ", end="")
        print(f"{loaded[quantile] * 1e3:.1f} ms loaded, ratio {ratio:.2f}")
    if options.out:
        options.out.write_text(json.dumps({"alone": alone, "loaded": loaded, "frames": frames, "events": events}))


def measured(views: int, viewers: int, listeners: int) -> tuple[dict[str, float], int, int]:
    """Return the poll intervals in seconds by quantile, and the received frames and events."""
    with tempfile.TemporaryDirectory() as folder:
        paths = [f"catalog.path={folder}/catalog", f"state_dir={folder}/state"]
        given = [word for one in paths for word in ("--set", one)]
        process = subprocess.Popen(
            [*RIG, "serve", "--bench", "sim", "--port", "0", *given], stderr=subprocess.PIPE, text=True
        )
        assert process.stderr is not None
        url = next(found.group() for line in process.stderr if (found := re.search(r"http://\S+/", line)))
        counts = {b"frame": 0, b"event": 0}
        done, counting = threading.Event(), threading.Lock()

        def listen(path: str, mark: bytes) -> None:
            with contextlib.suppress(OSError), urllib.request.urlopen(f"{url}api/v1/{path}") as stream:
                while not done.is_set():
                    if stream.readline().startswith((b"--frame", b"event:")):
                        with counting:
                            counts[mark] += 1

        for _ in range(viewers):
            threading.Thread(target=listen, args=("live", b"frame"), daemon=True).start()
        for _ in range(listeners):
            threading.Thread(target=listen, args=("events", b"event"), daemon=True).start()
        job = call(url, "jobs", {"kind": "enroll", "name": "lamp", "views": views})
        while job["state"] not in ("done", "failed"):
            threading.Event().wait(0.5)
            job = call(url, f"jobs/{job['id']}")
        assert job["state"] == "done", job["error"]
        text = urllib.request.urlopen(f"{url}metrics").read().decode()
        done.set()
        process.terminate()
        process.communicate()
    found = re.findall(r'rig_servo_poll_seconds\{quantile="([\d.]+)"\} (\S+)', text)
    return {quantile: float(seconds) for quantile, seconds in found}, counts[b"frame"], counts[b"event"]


def call(url: str, path: str, body: dict[str, object] | None = None) -> dict[str, object]:
    data = None if body is None else json.dumps(body).encode()
    request = urllib.request.Request(f"{url}api/v1/{path}", data, {"Content-Type": "application/json"})
    with urllib.request.urlopen(request) as answer:
        values: dict[str, object] = json.load(answer)
    return values


if __name__ == "__main__":
    main()
