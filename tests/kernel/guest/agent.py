"""The agent in the virtual machine: carries out requests of the tests, over one connection to their computer.

A request and its answer are a line of JSON each. Requests run in parallel, each in its own thread.
"""

import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from threading import Event, Lock, Thread
from typing import Any, Final

from tests.programs import Program, start_server

HOST: Final = "10.0.2.2"
"""The computer that runs the tests, as QEMU shows it."""
VHCI = Path("/sys/devices/platform/vhci_hcd.0")
AS_USER = """import os
os.setgroups({groups})
os.setgid({gid})
os.setuid({uid})
"""
RIG = "from rig.cli.main import main\nmain()\n"
IMPORTED = (
    *("rig.bench.hardware", "rig.catalog", "rig.catalog.results", "rig.cli.main", "rig.cli.ui.live"),
    *("rig.cli.ui.prompts", "rig.cli.ui.present", "rig.doctor.checks", "rig.doctor.device_scan"),
    *("rig.doctor.servo_scan", "rig.jobs.stop", "rig.plans.enroll", "rig.plans.identify"),
    *("rig.plans.photograph_table", "rig.plans.tray"),
    *("rig.report.pictures", "rig.search.model", "dynamixel_easy_sdk"),
    *("rich._emoji_codes", "typer._adapters"),
)
"""Modules that are imported once for all programs, because an emulated processor takes seconds for it."""


class Agent:
    """Answers requests."""

    def __init__(self, connection: socket.socket) -> None:
        self._connection = connection
        self._lock = Lock()
        self._running: dict[int, Program | subprocess.Popen[str]] = {}
        self._outputs: dict[int, list[tuple[bool, str]]] = {}
        self._readers: dict[int, list[Thread]] = {}

    def run(self) -> None:
        """Answer until the connection ends."""
        self._send({"ready": os.uname().release})
        with self._connection.makefile("r", encoding="utf-8") as lines:
            for line in lines:
                Thread(target=self._answer, args=(json.loads(line),), daemon=True).start()

    def _answer(self, request: dict[str, Any]) -> None:
        number = request.pop("number")
        try:
            action: Callable[..., Any] = getattr(self, "do_" + request.pop("do"))
            self._send({"number": number, "value": action(**request)})
        except Exception as error:
            self._send({"number": number, "error": f"{type(error).__name__}: {error}"})

    def _send(self, answer: dict[str, Any]) -> None:
        with self._lock:
            self._connection.sendall(json.dumps(answer).encode() + b"\n")

    # -- requests ---------------------------------------------------------------------------------------------------

    def do_attach(self, port: int, hub_port: int, device: int, speed: int) -> None:
        """Plug the USB device at a TCP port of the other computer into the virtual USB host."""
        plug = socket.create_connection((HOST, port))
        plug.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        (VHCI / "attach").write_text(f"{hub_port} {plug.fileno()} {1 << 16 | device} {speed}")

    def do_start(
        self,
        words: list[str],
        folder: str,
        user: dict[str, Any] | None = None,
        variables: dict[str, str] | None = None,
        typed: str = "",
        code: str = RIG,
    ) -> int:
        """Start `rig ...`, or a piece of Python; return the number of the process."""
        program = Program(
            *words,
            code=("" if user is None else AS_USER.format(**user)) + code,
            folder=Path(folder),
            **(variables or {}),
        )
        return self._started(program, program.pid, typed)

    def do_shell(self, command: str, folder: str, variables: dict[str, str] | None = None) -> int:
        """Start a command of the shell; return the number of the process."""
        pipe = subprocess.PIPE
        environment = {**os.environ, **(variables or {})}
        process = subprocess.Popen(
            ["/bin/bash", "-c", command], cwd=folder, env=environment, stdin=pipe, stdout=pipe, stderr=pipe, text=True
        )
        return self._started(process, process.pid, "")

    def do_files(self, pattern: str) -> dict[str, str]:
        """Return the files of a pattern with their text; a file without one (a device) has an empty one."""
        found = {}
        for path in Path("/").glob(pattern.removeprefix("/")):
            with suppress(OSError):  # a device that was unplugged meanwhile has no files
                found[str(path)] = path.read_text(errors="replace") if path.is_file() else ""
        return found

    def do_output(self, pid: int) -> str:
        """Return the output of the process so far."""
        return "".join(text for _, text in self._outputs[pid])

    def do_runs(self, pid: int) -> bool:
        return self._running[pid].poll() is None

    def do_wait(self, pid: int, timeout: float) -> dict[str, Any] | None:
        """Return exit code, all output and standard output of a process; None if it has not ended in ``timeout`` s."""
        process = self._running[pid]
        try:
            code = process.wait(timeout)
        except subprocess.TimeoutExpired:
            return None
        for reader in self._readers.pop(pid):
            reader.join(1.0)  # a guardian may hold the pipe longer
        del self._running[pid]
        parts = self._outputs.pop(pid)
        result = "".join(text for is_result, text in parts if is_result)
        return {"code": code, "output": "".join(text for _, text in parts), "result": result}

    def do_signal(self, pid: int, signal_number: int) -> None:
        os.kill(pid, signal_number)

    def do_end_all(self) -> int:
        """Kill all processes that still run; return their number."""
        for process in self._running.values():
            process.kill()
        return len(self._running)

    def _started(self, process: Program | subprocess.Popen[str], pid: int, typed: str) -> int:
        assert process.stdin is not None
        with suppress(BrokenPipeError):
            process.stdin.write(typed)
            process.stdin.close()
        self._running[pid] = process
        output = self._outputs[pid] = []
        self._readers[pid] = [
            Thread(target=_read, args=(stream, stream is process.stdout, output), daemon=True)
            for stream in (process.stdout, process.stderr)
        ]
        for reader in self._readers[pid]:
            reader.start()
        return pid


def _read(stream: Any, is_result: bool, output: list[tuple[bool, str]]) -> None:
    while text := os.read(stream.fileno(), 65_536):
        output.append((is_result, text.decode(errors="replace")))


def _connected(port: int) -> socket.socket:
    """Connect to the other computer as soon as the network is there."""
    while True:
        try:
            return socket.create_connection((HOST, port))
        except OSError:
            Event().wait(0.1)


def main() -> None:
    signal.signal(signal.SIGINT, signal.default_int_handler)
    start_server(*IMPORTED)  # while the network starts and the devices are plugged in
    with _connected(int(sys.argv[1])) as connection:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        Agent(connection).run()


if __name__ == "__main__":
    main()
