"""Programs in processes of their own, forked from a server that has imported their modules.

A start takes milliseconds instead of a second of computing. Signals, locks, pipes and exit codes are those of any
process. Tests of the start or the end of the interpreter start Python instead.
"""

import gc
import os
import signal
import sys
from collections.abc import Callable
from contextlib import suppress
from multiprocessing import forkserver, get_context
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerContext
from pathlib import Path
from subprocess import TimeoutExpired
from threading import Thread
from typing import IO

from rig.core.clock import SystemClock, seconds_between

_SERVER = get_context("forkserver")
_SERVER.set_forkserver_preload(
    ["tests.programs", "rig.catalog", "rig.cli.main", "rig.plans.enroll", "rig.plans.identify", "sim.bench"]
)


def server() -> ForkServerContext:
    """Return the context of the server, which is running: code that blocks signals must not start it."""
    forkserver.ensure_running()
    return _SERVER


def start_server(*modules: str) -> None:
    """Start the server now, with other modules imported; without this it starts with the first program."""
    _SERVER.set_forkserver_preload(["tests.programs", *modules])
    forkserver.ensure_running()


class Program:
    """A running `rig ...` or, with ``code``, a piece of Python; used as `subprocess.Popen`.

    Parameters
    ----------
    words
        Arguments of the program.
    code
        Run this instead of `rig`.
    folder
        Its working directory; None takes the present one.
    terminal
        File descriptor of a terminal for input and output; None gives it pipes.
    variables
        Changes of the environment.
    """

    def __init__(
        self,
        *words: str,
        code: str = "from rig.cli.main import main; main()",
        folder: Path | None = None,
        terminal: int | None = None,
        **variables: str,
    ) -> None:
        self.stdin: IO[str] | None = None
        self.stdout: IO[str] | None = None
        self.stderr: IO[str] | None = None
        if terminal is None:
            (theirs_in, ours_in), (ours_out, theirs_out), (ours_err, theirs_err) = (os.pipe() for _ in range(3))
            self.stdin = os.fdopen(ours_in, "w")
            self.stdout = os.fdopen(ours_out)
            self.stderr = os.fdopen(ours_err)
            ends = [theirs_in, theirs_out, theirs_err]
        else:
            ends = [os.dup(terminal) for _ in range(3)]
        streams = [Connection(end) for end in ends]  # it can be sent to another process
        environment = {**os.environ, **variables}
        self._process = _SERVER.Process(target=_run, args=(words, code, folder or Path.cwd(), environment, streams))
        self._process.start()
        for stream in streams:
            stream.close()

    @property
    def pid(self) -> int:
        assert self._process.pid is not None
        return self._process.pid

    @property
    def returncode(self) -> int | None:
        return self._process.exitcode

    poll = returncode.fget

    def send_signal(self, number: int) -> None:
        if self.returncode is None:
            os.kill(self.pid, number)

    def wait_until_stopped(self) -> None:
        """Wait until the program has stopped itself, as by SIGSTOP."""
        stat = Path(f"/proc/{self.pid}/stat")
        until(lambda: stat.read_text().rpartition(")")[2].split()[0] == "T", every_s=0.005)

    def kill(self) -> None:
        self._process.kill()

    def wait(self, timeout: float | None = None) -> int:
        self._process.join(timeout)
        if self.returncode is None:
            raise TimeoutExpired(str(self._process), timeout or 0)
        return self.returncode

    def communicate(self, timeout: float | None = None) -> tuple[str, str]:
        """Return the rest of the output and the errors when the program has ended."""
        assert self.stdin is not None
        with suppress(BrokenPipeError):
            self.stdin.close()
        assert self.stdout is not None
        assert self.stderr is not None
        rest: list[str] = []
        errors = self.stderr
        reader = Thread(target=lambda: rest.append(errors.read()))
        reader.start()
        output = self.stdout.read()
        reader.join()
        self.wait(timeout)
        self.close()
        return output, rest[0]

    def close(self) -> None:
        """Kill the program if it still runs, and close the pipes."""
        self.kill()
        self.wait()
        for stream in (self.stdin, self.stdout, self.stderr):
            if stream is not None:
                with suppress(BrokenPipeError):
                    stream.close()


def until(reached: Callable[[], object], seconds: float = 60.0, every_s: float = 0.01) -> None:
    """Wait for another program, which may take long on a busy computer."""
    clock = SystemClock()
    begun_ns = clock.now_ns()
    while not reached():
        assert seconds_between(begun_ns, clock.now_ns()) < seconds
        clock.sleep(every_s)


def stopping_after_view(number: int) -> str:
    """Return the code of `rig ... --json` that stops itself when it has reported its view of a number."""
    return f"""
import os, signal
from rig.cli.main import main
from rig.cli.ui.settings import Settings

signal.signal(signal.SIGINT, signal.SIG_IGN)  # as a background job of a script begins
print_json, views = Settings.print_json, []

def print_and_stop(settings, value):
    print_json(settings, value)
    if value["event"] == "accepted":
        views.append(value)
        if len(views) == {number}:
            os.kill(os.getpid(), signal.SIGSTOP)

Settings.print_json = print_and_stop
main()
"""


def _run(
    words: tuple[str, ...], code: str, folder: Path, environment: dict[str, str], streams: list[Connection]
) -> None:
    """Run the program in this process."""
    gc.freeze()  # its garbage collector need not visit what the server has imported
    for number, stream in enumerate(streams):
        os.dup2(stream.fileno(), number)
        stream.close()
    os.environ.clear()
    os.environ.update(environment)
    os.chdir(folder)
    sys.argv = ["rig", *words]
    sys.stdin = os.fdopen(0, closefd=False)
    for number, name in ((1, "stdout"), (2, "stderr")):
        buffering = 1 if os.isatty(number) or name == "stderr" else -1
        setattr(sys, name, os.fdopen(number, "w", buffering, closefd=False))
    try:
        exec(compile(code, "program", "exec"), {"__name__": "__main__"})
    except KeyboardInterrupt:  # end as the interpreter ends
        sys.stdout.flush()
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        signal.raise_signal(signal.SIGINT)
