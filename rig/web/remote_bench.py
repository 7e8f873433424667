"""The bench as the web process sees it: calls to the process that owns it, its events, and STOP."""

import asyncio
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from rig.core.clock import Clock, seconds_between
from rig.safety.stop_channel import StopAnswer, StopRequest, stop_answer
from rig.web.link import Link

PICTURE_S: Final = 0.08
"""Shortest time between two pictures that are fetched from the bench, for all pages together."""
CONFIRM_S: Final = 3.0
"""How long a request to stop is held until the bench has confirmed it; the page warns after one second."""


class RemoteBench:
    """The bench of another process.

    ``received`` gets the kind and the values of each event. ``link`` calls the functions of `rig.web.run.BenchSide`.
    """

    link: Link

    def __init__(self, state_folder: Path, clock: Clock, received: Callable[[str, Any], None]) -> None:
        self._state_folder = state_folder
        self._clock = clock
        self._received = received
        self.status: dict[str, Any] = {"open": False, "job": None, "error": None}
        """The last known state of the bench."""
        self._newest: tuple[int, bytes] = (0, b"")
        self._age_s: float | None = None
        self._fetched_ns: int | None = None
        self._fetching = asyncio.Lock()

    def connect(self, connection: socket.socket, ended: Callable[[], None] = lambda: None) -> None:
        """Connect to the process that owns the bench; ``ended`` is called once when it has gone."""
        self.link = Link(connection, {"publish": self._published}, ended)
        self.link.start()

    def _published(self, kind: str, data: Any) -> None:
        if kind == "status":
            self.status = data
        self._received(kind, data)

    def ask(self, function: str, **values: Any) -> Any:
        """Return the result of a function of `rig.web.run`. Raises its errors, and `BenchBusy`."""
        return self.link.call(function, **values)[0]

    # -- STOP: it asks no queue, no thread and no disk ----------------------------------------------------------------

    async def stop(self) -> dict[str, Any]:
        """Stop the table and cancel all jobs; return what the bench has confirmed within `CONFIRM_S`."""
        request = StopRequest(self._state_folder)
        answer: StopAnswer | None = None
        if request.connection is not None:
            try:
                async with asyncio.timeout(CONFIRM_S):
                    answer = stop_answer(await asyncio.get_running_loop().sock_recv(request.connection, 1))
            except TimeoutError:
                pass
            except OSError:
                answer = StopAnswer.ENDED
            finally:
                request.close()
        return {"ended": answer is StopAnswer.TORQUE_OFF, "answer": answer}

    # -- the picture --------------------------------------------------------------------------------------------------

    async def picture(self) -> tuple[int, bytes, float | None]:
        """Return the number of the newest frame, the frame as JPEG (empty if there is none), and its age in seconds."""
        async with self._fetching:
            now_ns = self._clock.now_ns()
            if self._fetched_ns is None or seconds_between(self._fetched_ns, now_ns) > PICTURE_S:
                values, content = await asyncio.to_thread(self.link.call, "picture", after=self._newest[0])
                self._fetched_ns, self._age_s = self._clock.now_ns(), values["age_s"]
                if content:
                    self._newest = (values["number"], content)
            return (*self._newest, self._age_s)
