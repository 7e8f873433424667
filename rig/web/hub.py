"""Distributes messages of the bench to any number of listeners.

A listener has only a position in the hub's ring of messages. A listener that does not read costs no memory, and cannot
delay the bench.
"""

import asyncio
import json
import threading
from collections import deque
from collections.abc import AsyncGenerator, Callable
from contextlib import aclosing
from dataclasses import dataclass
from typing import Any, Final

from rig.core.phrases import whole

CAPACITY: Final = 20_000
"""Messages that can be sent again after a lost connection: about 200 enrollments of 72 views."""
MAX_SIZE: Final = 64_000_000
"""Characters of all messages that can be sent again: a job with a long tray is a long message."""
HEARTBEAT_S: Final = 10.0
"""A comment is sent after this time without messages, so that both ends notice a lost connection."""
CHECK_S: Final = 1.0
"""Time between two checks whether a listener may still listen."""
MAX_LISTENERS: Final = 200  # each keeps a connection open and gets every event


@dataclass(frozen=True, slots=True)
class Message:
    """A message: ``kind`` is the name of the server-sent event, ``data`` its JSON text.

    ``job`` is the id of the job whose event it is, if it is one.
    """

    number: int
    kind: str
    data: str
    job: str | None = None


class Hub:
    """A ring of numbered messages.

    ``epoch`` distinguishes the numbers of this server run from those of an earlier one.
    """

    def __init__(self, epoch: str, capacity: int = CAPACITY) -> None:
        self._epoch = epoch
        self._capacity = capacity
        self._messages: deque[Message] = deque()
        self._last = 0
        self._size = 0
        self._lock = threading.Lock()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._changed: asyncio.Event | None = None
        self._closed = False
        self.listeners = 0

    def publish(self, kind: str, data: Any, job: str | None = None) -> None:
        """Add a message, from any thread; ``data`` are JSON values, ``job`` is the id of the job whose event it is."""
        text = json.dumps(data, ensure_ascii=False, allow_nan=False, default=str)
        with self._lock:
            self._last += 1
            self._messages.append(Message(self._last, kind, text, job))
            self._size += len(text)
            # The newest message stays in any case: a listener that is up to date must get it.
            while len(self._messages) > self._capacity or (self._size > MAX_SIZE and len(self._messages) > 1):
                self._size -= len(self._messages.popleft().data)
        self.wake()

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

    def of_job(self, job_id: str) -> tuple[list[str], str]:
        """Return the stored events of a job as JSON texts, and the id of the newest message."""
        with self._lock:
            found = [one.data for one in self._messages if one.job == job_id]
            return found, f"{self._epoch}-{self._last}"

    def position(self, last_event_id: str | None) -> tuple[int, bool]:
        """Return the number of a message id, and whether messages after it are lost; None is the newest message."""
        if not last_event_id:
            return self._last, False
        epoch, _, number = last_event_id.rpartition("-")
        position = whole(number)
        if epoch != self._epoch or position is None or position > self._last:
            return self._last, True
        return position, False

    async def messages(
        self, last_event_id: str | None = None, still_allowed: Callable[[], bool] = lambda: True
    ) -> AsyncGenerator[Message | None, None]:
        """Yield the messages after ``last_event_id``, until the hub is closed or the listener is not allowed any more.

        The first message is ``hello``. Its data say whether messages were lost since ``last_event_id``: the listener
        must then load the present state again. None is a sign of life after some time without messages.
        """
        self._loop = asyncio.get_running_loop()
        self._changed = self._changed or asyncio.Event()
        number, lost = self.position(last_event_id)
        self.listeners += 1
        silent_s = 0.0
        try:
            yield _hello(number, lost)
            while not self._closed and still_allowed():
                changed = self._changed  # before the look: a message that comes after it wakes this listener
                messages, lost = self.since(number)
                if lost:
                    number = messages[0].number - 1
                    yield _hello(number, lost)
                for message in messages:
                    number, silent_s = message.number, 0.0
                    yield message
                if not messages:
                    try:
                        await asyncio.wait_for(changed.wait(), CHECK_S)
                    except TimeoutError:
                        silent_s += CHECK_S
                    if silent_s >= HEARTBEAT_S:
                        silent_s = 0.0
                        yield None
        finally:
            self.listeners -= 1

    async def stream(
        self, last_event_id: str | None = None, still_allowed: Callable[[], bool] = lambda: True
    ) -> AsyncGenerator[str, None]:
        """Yield `messages` as server-sent events."""
        async with aclosing(self.messages(last_event_id, still_allowed)) as messages:
            async for message in messages:
                if message is None:
                    yield ": no news\n\n"
                else:
                    yield f"id: {self.id_of(message)}\nevent: {message.kind}\ndata: {message.data}\n\n"

    def id_of(self, message: Message) -> str:
        """Return the id after which a listener can continue."""
        return f"{self._epoch}-{message.number}"

    def wake(self) -> None:
        """Let all listeners look at once for messages, and whether they may still listen."""
        if self._loop is not None:
            try:
                self._loop.call_soon_threadsafe(self._wake)
            except RuntimeError:  # the loop is closed: the server ends
                self._loop = None

    def _wake(self) -> None:
        # Another event for the next message: clearing this one could let a listener miss it.
        if self._changed is not None:
            self._changed.set()
            self._changed = asyncio.Event()


def _hello(number: int, lost: bool) -> Message:
    return Message(number, "hello", json.dumps({"lost": lost}))
