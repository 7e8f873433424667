"""The bench as the web process sees it: calls to the process that owns it, its events, and STOP."""

import asyncio
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any, Final

from rig.core.clock import Clock, seconds_between
from rig.plans.operator import Choice
from rig.safety.stop_channel import StopAnswer, StopRequest, stop_answer
from rig.web.link import Calls, Message
from rig.web.requests import Job, JobRequest

BOUNDARY: Final = "frame"
PICTURE_S: Final = 0.08
"""Shortest time between two pictures that are fetched from the bench, for all viewers together."""
VIEWER_GONE_S: Final = 30.0
"""A stream of pictures sends the last one again after this time, to notice a viewer that is gone."""
CONFIRM_S: Final = 3.0
"""How long a request to stop is held until the bench has confirmed it; the page warns after one second."""


class RemoteBench:
    """The bench of another process.

    Parameters
    ----------
    state_folder
        The bench's state folder, where the stop channel is.
    clock
        The computer's clock.
    received
        Called with the kind and the values of each event.
    """

    def __init__(self, state_folder: Path, clock: Clock, received: Callable[[str, Any], None]) -> None:
        self._state_folder = state_folder
        self._clock = clock
        self._received = received
        self.calls = Calls()
        self.status: dict[str, Any] = {"open": False, "job": None, "error": None}
        """The last known state of the bench."""
        self.viewers = 0
        self.closed = False
        self._newest: tuple[int, bytes] = (0, b"")
        self._age_s: float | None = None
        self._fetched_ns: int | None = None
        self._fetching = asyncio.Lock()

    def received(self, message: Message, content: bytes) -> None:
        """Take a message of the other process."""
        if "number" in message:
            self.calls.answered(message, content)
            return
        if message["event"] == "status":
            self.status = message["data"]
        self._received(message["event"], message["data"])

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

    # -- jobs ---------------------------------------------------------------------------------------------------------

    def jobs(self) -> list[dict[str, Any]]:
        """Return all jobs, the newest first."""
        return list(self.calls.call("jobs")[0])

    def job(self, job_id: str) -> Job:
        return self._job("job", job=job_id)

    def submit(self, request: JobRequest, operator: str) -> Job:
        return self._job("submit", request=request.model_dump(mode="json"), operator=operator)

    def cancel(self, job_id: str) -> Job:
        return self._job("cancel", job=job_id)

    def pause(self, job_id: str) -> Job:
        return self._job("pause", job=job_id)

    def resume(self, job_id: str) -> Job:
        return self._job("resume", job=job_id)

    def answer(self, job_id: str, choice: Choice) -> Job:
        return self._job("answer", job=job_id, choice=choice)

    def view(self, job_id: str, number: int) -> bytes:
        """Return a picture of a job as JPEG. Raises `JobNotFound`."""
        return self.calls.call("view", job=job_id, number=number)[1]

    def numbers(self) -> dict[str, Any]:
        """Return the numbers for `rig.web.metrics`."""
        return dict(self.calls.call("numbers")[0])

    def _job(self, name: str, **values: Any) -> Job:
        return Job.model_validate(self.calls.call(name, **values)[0])

    # -- the picture --------------------------------------------------------------------------------------------------

    async def picture(self) -> tuple[int, bytes, float | None]:
        """Return the number of the newest frame, the frame as JPEG (empty if there is none), and its age in seconds."""
        async with self._fetching:
            now_ns = self._clock.now_ns()
            if self._fetched_ns is None or seconds_between(self._fetched_ns, now_ns) > PICTURE_S:
                values, content = await asyncio.to_thread(self.calls.call, "picture", after=self._newest[0])
                self._fetched_ns, self._age_s = self._clock.now_ns(), values["age_s"]
                if content:
                    self._newest = (values["number"], content)
            return (*self._newest, self._age_s)

    async def pictures(self, still_allowed: Callable[[], bool]) -> AsyncIterator[bytes]:
        """Yield the parts of a ``multipart/x-mixed-replace`` response, each frame at most once."""
        self.viewers += 1
        sent, waited_s = 0, 0.0
        try:
            while not self.closed and still_allowed():
                number, content, _ = await self.picture()
                if content and (number != sent or waited_s > VIEWER_GONE_S):
                    sent, waited_s = number, 0.0
                    head = f"--{BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(content)}\r\n\r\n"
                    yield head.encode() + content + b"\r\n"
                await asyncio.sleep(PICTURE_S)
                waited_s += PICTURE_S
        finally:
            self.viewers -= 1
