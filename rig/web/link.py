"""The connection between the two processes of a server: the one that owns the bench, and the one that answers the web.

Each end offers functions to the other one. A message is a line of JSON. Neither side ever waits for the other while it
sends.
"""

import json
import socket
import threading
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from contextlib import suppress
from itertools import count
from typing import Any, Final

from pydantic import TypeAdapter
from pydantic_core import to_jsonable_python

from rig.core.errors import BenchBusy, Problem, RigError, error_of
from rig.core.next_steps import Do

MAX_BYTES: Final = 64_000_000  # a longer line is no message of the other end
MAX_UNSENT: Final = 20_000
"""Messages that wait for a web process that does not read. Then the oldest is dropped: a bench must not wait."""
# longer: a request of a browser hangs with the bench; shorter: a busy computer looks like a dead one
ANSWER_S: Final = 10.0

_PROBLEM: Final = TypeAdapter(Problem)
Functions = Mapping[str, Callable[..., Any]]
"""Functions that the other end may call: they take and return JSON values.

They run in the link's own thread. Their `RigError` is raised at the other end.
"""


class Link:
    """One end of the connection.

    It closes the ``connection``, calls ``functions`` for the other end, and ``ended`` once when that end has gone.
    """

    def __init__(self, connection: socket.socket, functions: Functions, ended: Callable[[], None]) -> None:
        self._connection = connection
        self._functions = functions
        self._ended = ended
        self._unsent: deque[bytes] = deque(maxlen=MAX_UNSENT)
        self._changed = threading.Condition()
        self._closed = False
        self._numbers = count(1)
        self._waiting: dict[int, Future[Any]] = {}
        self._threads = [threading.Thread(target=run, name="link", daemon=True) for run in (self._write, self._read)]

    def start(self) -> None:
        """Begin to send and to receive."""
        for thread in self._threads:
            thread.start()

    def tell(self, name: str, **values: Any) -> None:
        """Call a function at the other end without an answer, from any thread; nothing happens if that end has gone."""
        self._send({"call": name, "values": values})

    def call(self, name: str, **values: Any) -> Any:
        """Call a function at the other end and return its result; its errors are raised here.

        Raises `BenchBusy`: there is no answer in time.
        """
        # The thread that reads sets the future; calls of several threads wait for their answers at the same time.
        number, future = next(self._numbers), Future[Any]()
        self._waiting[number] = future
        try:
            self._send({"call": name, "values": values, "number": number})
            return future.result(ANSWER_S)
        except TimeoutError as error:
            raise BenchBusy(
                "The process that owns the bench does not answer.",
                next_step=("Look at the table. If this stays so,", Do.SERVE_AGAIN()),
            ) from error
        finally:
            del self._waiting[number]

    def close(self) -> None:
        """End the connection; messages that were not sent yet are lost."""
        with self._changed:
            self._closed = True
            self._changed.notify()
        with suppress(OSError):  # ends the read and the write that wait; closing alone does not
            self._connection.shutdown(socket.SHUT_RDWR)
        for thread in self._threads:
            if thread is not threading.current_thread() and thread.ident is not None:
                thread.join()
        self._connection.close()

    def _send(self, message: dict[str, Any]) -> None:
        text = json.dumps(message, ensure_ascii=False, allow_nan=False, default=_json_values).encode()
        with self._changed:
            self._unsent.append(text + b"\n")
            self._changed.notify()

    def _write(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._unsent or self._closed)
                if self._closed:
                    return
                message = self._unsent.popleft()
            # Outside of the lock: a bench that tells something must not wait until the other end reads.
            try:
                self._connection.sendall(message)
            except OSError:
                return

    def _read(self) -> None:
        try:
            with self._connection.makefile("rb") as stream, suppress(OSError):
                while (text := stream.readline(MAX_BYTES)).endswith(b"\n"):
                    self._received(json.loads(text))
        finally:
            if not self._closed:
                self._ended()

    def _received(self, message: dict[str, Any]) -> None:
        """Take a call, or the answer to one."""
        number: int = message.get("number", 0)  # 0 if no answer is expected
        if "call" in message:
            answer = self._answer(message)
            if number:
                self._send({**answer, "number": number})
            return
        future = self._waiting.get(number)
        if future is None or future.done():  # the call has ended already
            return
        if "error" in message:
            future.set_exception(error_of(_PROBLEM.validate_python(message["error"])))
        else:
            future.set_result(message["result"])

    def _answer(self, message: dict[str, Any]) -> dict[str, Any]:
        """Call the function that a message names, and return its answer."""
        try:
            return {"result": self._functions[message["call"]](**message["values"])}
        except RigError as error:
            return {"error": error.problem}


def _json_values(value: Any) -> Any:
    return to_jsonable_python(value, fallback=str)
