"""Golden sessions: scripted sessions on the simulated bench, and everything that they print as JSON, stored as data.

`sessions.toml` has the sessions, and ``expected/NAME.jsonl`` what each one prints. ``python -m tests.golden.sessions
[NAME ...]`` runs sessions and writes these files: read the difference before you commit it.
"""

import fcntl
import json
import os
import re
import shlex
import shutil
import signal
import sys
import tempfile
import threading
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from itertools import zip_longest
from math import isclose
from pathlib import Path
from typing import Any, Final

import pytest
from typer.testing import CliRunner

from rig.cli.main import app
from rig.cli.ui.settings import Settings

HERE: Final = Path(__file__).parent
EXPECTED: Final = HERE / "expected"
CONFIG: Final = (
    'default_bench = "sim"\nstate_dir = "state"\ncalibration_dir = "calibrations"\n[catalog]\npath = "catalog"\n'
    "[camera]\nwidth = 320\nheight = 240\n[view]\nroi = [40, 0, 240, 240]\n"
)
LONGEST: Final = 8
"""A longer list of numbers is stored as its length, its ends and its sum."""
TOLERANCE: Final = 1e-5
"""Of numbers: other processors and compilers round other last digits."""
_VARIABLE: Final = (
    (re.compile(r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d(:?\d\d(\.\d+)?)?( UTC|Z|\+00:00)?"), "TIME"),
    (re.compile(r"\d{8}[-T]\d{6}(\.\d+)?Z?"), "TIME"),
    (re.compile(r"[\d.]+ GB free|about \d+ more objects"), "DISK"),
    (re.compile(r"\b[0-9a-f]{12,64}\b"), "DIGEST"),
    (re.compile(r"\b\d+\.\d+\.\d+(\.dev\d+)?(\+\w+)?\b"), "VERSION"),
)
"""Parts of texts that differ from run to run, or from computer to computer."""

Values = list[Any]


@cache
def sessions() -> dict[str, dict[str, Any]]:
    """Return the scripts by name."""
    return tomllib.loads((HERE / "sessions.toml").read_text())


def expected(name: str) -> Values:
    """Return what a session printed when it was stored."""
    return [json.loads(line) for line in (EXPECTED / f"{name}.jsonl").read_text().splitlines()]


def played(name: str, folder: Path, others: Path) -> Values:
    """Run a session in a folder; return what it prints: each command, its values, and its exit code.

    The sessions that it begins from are in ``others`` (`left`).
    """
    session = sessions()[name]
    for before in session.get("after", []):
        shutil.copytree(left(before, others)[0], folder, dirs_exist_ok=True, ignore=shutil.ignore_patterns("stop"))
    if "after" not in session:
        (folder / "rig.toml").write_text(CONFIG)
    for file, text in session.get("files", {}).items():
        (folder / file).write_text(text)
    with _within(folder):
        values: Values = []
        if any("job" in step for step in session["steps"]):
            values += _jobs(folder, session)
        else:
            for step in session["steps"]:
                values += _command(**step) if isinstance(step, dict) else _command(step)
    return _without_repetition([_normal(value, str(folder)) for value in values])


def _without_repetition(values: Values) -> Values:
    """Replace the conditions of a plan, a large dict, if they are those of the plan before."""
    before = None
    for value in values:
        event = value.get("plan", value) if isinstance(value, dict) else {}
        if isinstance(event, dict) and "conditions" in event:
            event["conditions"], before = (
                "as before" if event["conditions"] == before else event["conditions"],
                event["conditions"],
            )
    return values


def left(name: str, others: Path) -> tuple[Path, Values]:
    """Return the folder that a session leaves in ``others``, and what the session prints.

    The first process that asks runs the session for all that share the folder, which wait for it.
    """
    folder, printed = others / name, others / f"{name}.json"
    with (others / f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not printed.exists():
            folder.mkdir()
            printed.write_text(json.dumps(played(name, folder, others)))
    return folder, json.loads(printed.read_text())


@contextmanager
def _within(folder: Path) -> Iterator[None]:
    before = Path.cwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)


# -- commands ----------------------------------------------------------------------------------------------------------


def _command(command: str, interrupt: str = "") -> Values:
    """Run a command of `rig`; ``interrupt`` sends SIGINT after an event, for example the third ("accepted 3")."""
    event, _, number = interrupt.partition(" ")
    left = int(number or 0)
    usual = Settings.print_json

    def print_and_interrupt(settings: Settings, value: Any) -> None:
        nonlocal left
        usual(settings, value)
        if left and value.get("event") == event:
            left -= 1
            if not left:
                signal.raise_signal(signal.SIGINT)

    Settings.print_json = print_and_interrupt  # type: ignore[method-assign]
    try:
        done = CliRunner().invoke(app, [*shlex.split(command), "--json"])
    finally:
        Settings.print_json = usual  # type: ignore[method-assign]
    return [{"command": command}, *map(_value, done.stdout.splitlines()), {"exit": done.exit_code}]


def _value(line: str) -> Any:
    try:
        return json.loads(line)
    except ValueError:
        return line


# -- jobs of the REST API ----------------------------------------------------------------------------------------------


def _jobs(folder: Path, session: dict[str, Any]) -> Values:
    from rig.web.worker import BenchWorker
    from tests.rig.web.conftest import starting

    def wait(worker: BenchWorker) -> None:
        """Wait for a job without the bench's clock, which would be at another time in each run."""
        threading.Event().wait(0.005)

    values: Values = []
    with pytest.MonkeyPatch.context() as patch, starting(folder) as start:
        patch.setattr(BenchWorker, "_idle", wait)
        served = start(*session.get("settings", ()))
        publish = served.worker.publish
        request: dict[int, str] = {}

        def published(kind: str, data: Any, job: Any = None) -> None:
            publish(kind, data, job)
            if kind == "plan":
                values.append({"plan": dict(data)})
                if data["event"] == "accepted" and (path := request.pop(data["picture"] + 1, None)):
                    served.client.post(f"/api/v1/jobs/{data['job']}/{path}")

        def by_hand(thing: str | None) -> None:
            if thing is not None:
                served.worker._hands.append(["put", thing])  # the request would need an open bench

        served.worker.publish = published
        for step in session["steps"]:
            shown = iter(step.get("put", ()))  # objects that a person takes from the shelf
            by_hand(next(shown, None))
            values.append({"request": step["job"]})
            request.clear()
            request.update({step[path]: path for path in ("pause", "cancel") if path in step})
            answer = served.client.post("/api/v1/jobs", json=step["job"])
            if answer.status_code != 201:
                values.append({"rejected": answer.status_code, **answer.json()})
                continue
            job = answer.json()["id"]
            if "pause" in step:
                served.wait(job, "paused")
                served.client.post(f"/api/v1/jobs/{job}/resume")
            asked = None
            for choice in step.get("answers", ()):
                while (question := served.wait(job, "waiting")["question"]) in (None, asked):
                    threading.Event().wait(0.005)
                asked = question
                values.append({"question": question, "answer": choice})
                by_hand(next(shown, None))
                served.client.post(f"/api/v1/jobs/{job}/answer", json={"choice": choice})
            values.append({"ended": served.wait(job)})
        values.append({"status": served.client.get("/api/v1/status").json()})
    return values


# -- comparison --------------------------------------------------------------------------------------------------------


def _normal(value: Any, folder: str) -> Any:
    """Return a value without what differs from run to run."""
    match value:
        case {"free_gb": _}:
            return "DISK"
        case dict():
            left_out = {"seconds"} if "dry_run" in value else set()  # an import takes real time
            left_out |= {"database_bytes"}  # SQLite keeps or removes its write-ahead log
            left_out |= {key for key in value if _is_time(key)}
            return {key: _normal(one, folder) for key, one in value.items() if key not in left_out}
        case list() if len(value) > LONGEST and all(isinstance(one, int | float) for one in value):
            return {
                "numbers": len(value),
                "ends": [_normal(value[k], folder) for k in (0, -1)],
                "sum": _round(sum(value)),
            }
        case list():
            return [_normal(one, folder) for one in value]
        case float():
            return _round(value)
        case str():
            text = value.replace(folder, "FOLDER")
            for pattern, word in _VARIABLE:
                text = pattern.sub(word, text)
            return text
    return value


def _is_time(key: str) -> bool:
    return key.endswith(("_utc", "_ns")) or key in (
        "utc",
        "id",
        "job",
        "run",
        "seconds_left",
        "created",
        "ended_at",
        "free_disk_bytes",
        "picture_age_s",
    )


def _round(value: float) -> float:
    return float(f"{value:.7g}")


def differences(stored: Any, now: Any, where: str = "") -> Iterator[str]:
    """Yield each field that differs."""
    if isinstance(stored, dict) and isinstance(now, dict):
        for key in {**stored, **now}:
            yield from differences(stored.get(key), now.get(key), f"{where}.{key}")
    elif isinstance(stored, list) and isinstance(now, list):
        for number, (a, b) in enumerate(zip_longest(stored, now)):
            yield from differences(a, b, f"{where}[{number}]")
    elif isinstance(stored, float) and isinstance(now, float | int):
        if not isclose(stored, now, rel_tol=TOLERANCE, abs_tol=TOLERANCE):
            yield f"{where}: {stored} was stored, and it is {now}"
    elif stored != now:
        yield f"{where}: {stored!r} was stored, and it is {now!r}"


def main() -> None:
    EXPECTED.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as others:
        for name in sys.argv[1:] or sessions():
            with tempfile.TemporaryDirectory() as folder:
                lines = [json.dumps(value, ensure_ascii=False) for value in played(name, Path(folder), Path(others))]
            (EXPECTED / f"{name}.jsonl").write_text("".join(f"{line}\n" for line in lines))


if __name__ == "__main__":
    main()
