"""The connection between the two processes of a server: the one that owns the bench, and the one that answers the web.

Messages are JSON with an optional content of bytes. Neither side ever waits for the other while it sends.
"""

import json
import socket
import struct
import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from itertools import count
from typing import Any, Final

from rig.core import errors
from rig.core.errors import BenchBusy, RigError
from rig.core.next_steps import Do, steps_from_json

HEAD: Final = struct.Struct(">II")
"""Length of the JSON text and of the content, in bytes."""
MAX_BYTES: Final = 64_000_000
MAX_UNSENT: Final = 20_000
"""Messages that wait for a web process that does not read. Then the oldest is dropped: a bench must not wait."""
ANSWER_S: Final = 10.0

Message = dict[str, Any]


class Link:
    """One end of the connection.

    Parameters
    ----------
    connection
        A connected stream socket; the link closes it.
    received
        Called with each message and its content, in the link's own thread.
    ended
        Called once when the other end has gone.
    """

    def __init__(
        self,
        connection: socket.socket,
        received: Callable[[Message, bytes], None],
        ended: Callable[[], None] = lambda: None,
    ) -> None:
        self._connection = connection
        self._received = received
        self._ended = ended
        self._unsent: deque[bytes] = deque(maxlen=MAX_UNSENT)
        self._changed = threading.Condition()
        self._closed = False
        self._threads = [threading.Thread(target=run, name="link", daemon=True) for run in (self._send, self._read)]

    def start(self) -> None:
        """Begin to send and to receive."""
        for thread in self._threads:
            thread.start()

    def send(self, message: Message, content: bytes = b"") -> None:
        """Send a message, from any thread; it is lost if the other end has gone."""
        text = json.dumps(message, ensure_ascii=False, allow_nan=False, default=str).encode()
        with self._changed:
            self._unsent.append(HEAD.pack(len(text), len(content)) + text + content)
            self._changed.notify()

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

    def _send(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._unsent or self._closed)
                if self._closed:
                    return
                frame = self._unsent.popleft()
            try:
                self._connection.sendall(frame)
            except OSError:
                return

    def _read(self) -> None:
        try:
            while True:
                text_bytes, content_bytes = HEAD.unpack(self._exactly(HEAD.size))
                if text_bytes + content_bytes > MAX_BYTES:
                    return
                text = self._exactly(text_bytes)
                self._received(json.loads(text), self._exactly(content_bytes))
        except (OSError, EOFError):
            pass
        finally:
            if not self._closed:
                self._ended()

    def _exactly(self, size: int) -> bytes:
        parts = []
        while size > 0:
            part = self._connection.recv(min(size, 1 << 20))
            if not part:
                raise EOFError
            parts.append(part)
            size -= len(part)
        return b"".join(parts)


def error_values(error: RigError) -> Message:
    """Return an error as JSON values."""
    values = error.as_dict()
    return {"kind": type(error).__name__, **{key: values[key] for key in ("what", "steps", "evidence")}}


def error_of(values: Message) -> RigError:
    """Return the error of these values."""
    kind = getattr(errors, values["kind"], RigError)
    return kind(values["what"], next_step=steps_from_json(values["steps"]), evidence=values["evidence"])


class Calls:
    """Calls of functions at the other end of a link, and their answers."""

    def __init__(self) -> None:
        self._numbers = count(1)
        self._waiting: dict[int, Future[tuple[Any, bytes]]] = {}
        self.link: Link | None = None

    def call(self, name: str, **values: Any) -> tuple[Any, bytes]:
        """Call a function and return its result and content; its errors are raised here.

        Raises
        ------
        BenchBusy
            There is no answer in time.
        """
        number, future = next(self._numbers), Future[tuple[Any, bytes]]()
        self._waiting[number] = future
        try:
            if self.link is None:
                raise TimeoutError
            self.link.send({"call": name, "number": number, "values": values})
            return future.result(ANSWER_S)
        except TimeoutError as error:
            raise BenchBusy(
                "The process that owns the bench does not answer.",
                next_step=("Look at the table. If this stays so,", Do.SERVE_AGAIN()),
            ) from error
        finally:
            del self._waiting[number]

    def answered(self, message: Message, content: bytes) -> None:
        """Take an answer from the other end."""
        future = self._waiting.get(message["number"])
        if future is None or future.done():
            return
        if "error" in message:
            future.set_exception(error_of(message["error"]))
        else:
            future.set_result((message["result"], content))


def answer(link: Link, functions: dict[str, Callable[..., Any]], message: Message) -> None:
    """Call the function that a message names, and send its result: JSON values, or a tuple of JSON values and bytes."""
    reply: Message = {"number": message["number"]}
    content = b""
    try:
        result = functions[message["call"]](**message["values"])
        if isinstance(result, tuple):
            result, content = result
        reply["result"] = result
    except RigError as error:
        reply["error"] = error_values(error)
    link.send(reply, content)
