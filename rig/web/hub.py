"""Distributes messages from the program's bench thread to any number of listeners.

A listener has only a position in the hub's ring of messages. A listener that does not read costs no memory, and cannot
delay the bench.
"""

import asyncio
import json
import threading
from collections import deque
from collections.abc import AsyncIterator
from dataclasses import dataclass
from typing import Any, Final

CAPACITY: Final = 20_000
"""Messages that can be sent again after a lost connection: about 200 enrollments of 72 views."""
HEARTBEAT_S: Final = 10.0
"""A comment is sent after this time without messages, so that both ends notice a lost connection."""


@dataclass(frozen=True, slots=True)
class Message:
    """A message: ``kind`` is the name of the server-sent event, ``data`` its JSON text."""

    number: int
    kind: str
    data: str


class Hub:
    """A ring of numbered messages.

    Parameters
    ----------
    epoch
        Distinguishes the numbers of this server run from those of an earlier one.
    capacity
        Number of messages that are stored.
    """

    def __init__(self, epoch: str, capacity: int = CAPACITY) -> None:
        self._epoch = epoch
        self._messages: deque[Message] = deque(maxlen=capacity)
        self._last = 0
        self._lock = threading.Lock()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._changed: asyncio.Event | None = None
        self._closed = False
        self.listeners = 0

    def publish(self, kind: str, data: Any) -> None:
        """Add a message, from any thread; ``data`` are JSON values."""
        text = json.dumps(data, ensure_ascii=False, allow_nan=False, default=str)
        with self._lock:
            self._last += 1
            self._messages.append(Message(self._last, kind, text))
        if self._loop is not None:
            try:
                self._loop.call_soon_threadsafe(self._wake)
            except RuntimeError:  # the loop is closed: the server ends
                self._loop = None

    def close(self) -> None:
        """End all streams."""
        self._closed = True
        self.publish("close", {})  # wakes them

    def since(self, number: int) -> tuple[list[Message], bool]:
        """Return the messages after ``number``, and whether older ones are missing."""
        with self._lock:
            if number >= self._last:
                return [], False
            first = self._messages[0].number
            messages = [self._messages[k] for k in range(max(number + 1 - first, 0), len(self._messages))]
        return messages, number + 1 < first

    def position(self, last_event_id: str | None) -> tuple[int, bool]:
        """Return the number of a message id, and whether messages after it are lost; None is the newest message."""
        if not last_event_id:
            return self._last, False
        epoch, _, number = last_event_id.rpartition("-")
        if epoch != self._epoch or not number.isdecimal() or int(number) > self._last:
            return self._last, True
        return int(number), False

    async def stream(self, last_event_id: str | None = None) -> AsyncIterator[str]:
        """Yield server-sent events after ``last_event_id``, until the hub is closed.

        The first event is ``hello``. Its data say whether messages were lost since ``last_event_id``: the listener must
        then load the present state again.
        """
        self._loop = asyncio.get_running_loop()
        self._changed = self._changed or asyncio.Event()
        number, lost = self.position(last_event_id)
        self.listeners += 1
        try:
            yield self._hello(number, lost)
            while not self._closed:
                changed = self._changed
                messages, lost = self.since(number)
                if lost:
                    number = messages[0].number - 1
                    yield self._hello(number, lost)
                for message in messages:
                    number = message.number
                    yield f"id: {self._epoch}-{number}\nevent: {message.kind}\ndata: {message.data}\n\n"
                if not messages:
                    try:
                        await asyncio.wait_for(changed.wait(), HEARTBEAT_S)
                    except TimeoutError:
                        yield ": no news\n\n"
        finally:
            self.listeners -= 1

    def _hello(self, number: int, lost: bool) -> str:
        return f"id: {self._epoch}-{number}\nevent: hello\ndata: {json.dumps({'lost': lost})}\n\n"

    def _wake(self) -> None:
        if self._changed is not None:
            self._changed.set()
            self._changed = asyncio.Event()
