"""A connection to a running simulated bench.

This module imports neither numpy nor OpenCV, so that the trainee's commands start at once.
"""

import json
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from errno import EIO
from pathlib import Path
from typing import Any, Final

from rig.core.errors import DeviceNotFound, UsageError
from rig.core.next_steps import Do, steps_from_json

DEFAULT_FOLDER: Final = Path("sim-bench")
SOCKET, SERVO, HEAD, COMPUTER, CONFIG, STATE = "socket", "servo", "head", "computer", "rig.toml", "state"
"""Names in the folder of a simulated bench: socket, ports, files of its computer, configuration, the bench's state."""
PATIENCE_S: Final = 15.0
"""How long an answer may take. A camera that hangs takes longest: OpenCV waits 10 s for a frame."""


class Wire:
    """A connection to the simulated bench in ``folder``.

    Raises `DeviceNotFound`: the simulated bench is not running.
    """

    def __init__(self, folder: Path) -> None:
        self._socket = socket.socket(socket.AF_UNIX)
        try:
            with short_path(folder) as path:
                self._socket.connect(f"{path}/{SOCKET}")
            self._socket.settimeout(PATIENCE_S)
        except OSError as error:
            self._socket.close()
            raise not_running(folder) from error
        self._file = self._socket.makefile("rb")

    def ask(self, **request: Any) -> tuple[dict[str, Any], bytes]:
        """Return the answer and its bytes; raises OSError if the simulated bench has ended."""
        self._socket.sendall(json.dumps(request).encode() + b"\n")
        line = self._file.readline()
        if not line.endswith(b"\n"):
            raise OSError(EIO, "the simulated bench has ended")
        answer = json.loads(line)
        payload = self._file.read(answer["bytes"])
        if len(payload) < answer["bytes"]:
            raise OSError(EIO, "the simulated bench has ended")
        return answer, payload

    def close(self) -> None:
        """Close the connection; a second call does nothing."""
        self._file.close()
        self._socket.close()


def send_command(folder: Path, *words: str) -> dict[str, Any]:
    """Send a command to the running bench in ``folder``; return its answer and the state of its world.

    Raises `DeviceNotFound`: no simulated bench is running in the folder. `UsageError`: there is no such command, or it
    is not possible now.
    """
    wire = Wire(folder)
    try:
        answer, _ = wire.ask(ask="do", words=words)
    except (OSError, ValueError) as error:
        raise not_running(folder) from error
    finally:
        wire.close()
    if failed := answer.get("failed"):
        raise UsageError(failed["detail"], next_step=steps_from_json(failed["steps"]), evidence=failed["evidence"])
    return answer


def not_running(folder: Path) -> DeviceNotFound:
    """Return the error that no simulated bench runs in ``folder``."""
    return DeviceNotFound(
        f"No simulated bench is running in {folder}.",
        next_step=Do.SIM_BENCH(folder=str(folder)),
    )


@contextmanager
def short_path(folder: Path) -> Iterator[str]:
    """Yield a short name of a folder: the path of a socket has at most 107 bytes."""
    descriptor = os.open(folder, os.O_PATH | os.O_DIRECTORY)
    try:
        yield f"/proc/self/fd/{descriptor}"
    finally:
        os.close(descriptor)
