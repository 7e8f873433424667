"""The connection between the two processes of a server: the one that owns the bench, and the one that answers the web.

Each end offers functions to the other one. A message is a line of JSON and a content of bytes, which may be empty.
Neither side ever waits for the other while it sends.
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

from pydantic_core import to_jsonable_python

from rig.core import errors
from rig.core.errors import BenchBusy, RigError
from rig.core.next_steps import Do, steps_as_json, steps_from_json

MAX_BYTES: Final = 64_000_000  # a longer line is no message of the other end
MAX_UNSENT: Final = 20_000
"""Messages that wait for a web process that does not read. Then the oldest is dropped: a bench must not wait."""
# longer: a request of a browser hangs with the bench; shorter: a busy computer looks like a dead one
ANSWER_S: Final = 10.0

Functions = Mapping[str, Callable[..., Any]]
"""Functions that the other end may call: they take JSON values, and return values or a tuple of values and bytes.

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
        self._waiting: dict[int, Future[tuple[Any, bytes]]] = {}
        self._threads = [threading.Thread(target=run, name="link", daemon=True) for run in (self._write, self._read)]

    def start(self) -> None:
        """Begin to send and to receive."""
        for thread in self._threads:
            thread.start()

    def tell(self, name: str, **values: Any) -> None:
        """Call a function at the other end without an answer, from any thread; nothing happens if that end has gone."""
        self._send({"call": name, "values": values})

    def call(self, name: str, **values: Any) -> tuple[Any, bytes]:
        """Call a function at the other end and return its result and content; its errors are raised here.

        Raises `BenchBusy`: there is no answer in time.
        """
        number, future = next(self._numbers), Future[tuple[Any, bytes]]()
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
        with suppress(OSError):
            self._connection.shutdown(socket.SHUT_RDWR)
        for thread in self._threads:
            if thread is not threading.current_thread() and thread.ident is not None:
                thread.join()
        self._connection.close()

    def _send(self, message: dict[str, Any], content: bytes = b"") -> None:
        values = {**message, "content_bytes": len(content)}
        text = json.dumps(values, ensure_ascii=False, allow_nan=False, default=_json_values).encode()
        with self._changed:
            self._unsent.append(text + b"\n" + content)
            self._changed.notify()

    def _write(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._unsent or self._closed)
                if self._closed:
                    return
                message = self._unsent.popleft()
            try:
                self._connection.sendall(message)
            except OSError:
                return

    def _read(self) -> None:
        try:
            with self._connection.makefile("rb") as stream, suppress(OSError):
                while (text := stream.readline(MAX_BYTES)).endswith(b"\n"):
                    message = json.loads(text)
                    content = stream.read(size := message["content_bytes"])
                    if len(content) == size:  # otherwise the other end has gone
                        self._received(message, content)
        finally:
            if not self._closed:
                self._ended()

    def _received(self, message: dict[str, Any], content: bytes) -> None:
        """Take a call, or the answer to one."""
        number: int = message.get("number", 0)  # 0 if no answer is expected
        if "call" in message:
            answer, content = self._answer(message)
            if number:
                self._send({**answer, "number": number}, content)
            return
        future = self._waiting.get(number)
        if future is None or future.done():  # the call has ended already
            return
        if "error" in message:
            kind, what, steps, evidence = message["error"]
            error = getattr(errors, kind, RigError)
            future.set_exception(error(what, next_step=steps_from_json(steps), evidence=evidence))
        else:
            future.set_result((message["result"], content))

    def _answer(self, message: dict[str, Any]) -> tuple[dict[str, Any], bytes]:
        """Call the function that a message names; return its answer, and the content of the answer."""
        try:
            result = self._functions[message["call"]](**message["values"])
        except RigError as error:
            return {"error": [type(error).__name__, error.what, steps_as_json(error.steps), error.evidence]}, b""
        result, content = result if isinstance(result, tuple) else (result, b"")
        return {"result": result}, content


def _json_values(value: Any) -> Any:
    return to_jsonable_python(value, fallback=str)
