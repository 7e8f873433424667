"""Requests to the rig head, its replies and its events: sequence numbers, repetitions, statistics."""

import termios
from collections.abc import Callable
from dataclasses import astuple, dataclass
from typing import TypeVar

from rig.core.clock import Clock
from rig.core.errors import DeviceSilent, DeviceUnplugged, RequestRejected
from rig.core.next_steps import Do
from rig.devices.dynamixel.port import SerialConnection
from rig.devices.head import protocol
from rig.devices.head.framing import CRC, HEADER, Deframer, Frame, encode
from rig.devices.head.protocol import Answer, Done, Rejection, Request, Sample, StatusChanged

REPLY_S = 0.06
"""How long a reply may take: 6 ms behind a full transmitter, plus twice a USB adapter's latency timer."""
ATTEMPTS = 3

A = TypeVar("A")

_REASONS: dict[int, str] = {
    Rejection.UNKNOWN_REQUEST: "its firmware does not know this request",
    Rejection.MALFORMED: "its firmware expects a different length of this request",
    Rejection.OUT_OF_RANGE: "a value is out of range",
    Rejection.FAULT_LATCHED: "a fault is latched",
    Rejection.NOT_ACTIVE: "it receives no heartbeat",
    Rejection.CAUSE_PERSISTS: "the cause of the fault is still there",
    Rejection.BUSY: "it still processes the last one",
}


@dataclass(slots=True)
class LinkStatistics:
    """Statistics of the connection.

    ``missed`` counts events that did not arrive intact, ``late`` replies that came too late, ``retries`` repeated
    requests.
    """

    frames: int = 0
    crc_errors: int = 0
    malformed: int = 0
    missed: int = 0
    late: int = 0
    retries: int = 0


class HeadLink:
    """Requests, replies and events on an open port of a head.

    Parameters
    ----------
    connection
        The open port; its reads return after a few milliseconds.
    on_event
        Called with each `Sample` and `StatusChanged` that arrives.
    name
        The port's name, for messages.
    """

    def __init__(
        self, connection: SerialConnection, clock: Clock, on_event: Callable[[Sample | StatusChanged], None], name: str
    ) -> None:
        self.name = name
        self.statistics = LinkStatistics()
        self.sent_ns = self.heard_ns = clock.now_ns()
        """When the last request was sent, and when its reply arrived."""
        self._connection = connection
        self._clock = clock
        self._on_event = on_event
        self._deframer = Deframer()
        self._sequence = 0
        self._event_sequence: int | None = None
        self._reply: Frame | None = None

    def frame_ns(self, body_bytes: int) -> float:
        """Return the time that a frame with such a body takes on the wire."""
        return (body_bytes + HEADER + CRC + 2) * 10e9 / self._connection.baudrate

    def close(self) -> None:
        self._connection.close()

    def replace(self, connection: SerialConnection) -> None:
        """Continue with a port that was opened again."""
        self._connection = connection

    def start(self) -> None:
        """End a frame that an earlier program may have sent in part, and drop the replies that it did not read."""
        self._guarded(lambda: self._connection.write(b"\0"))
        self._guarded(self._connection.reset_input_buffer)
        self._deframer.reset()
        self._event_sequence = None

    def poll(self) -> None:
        """Process the bytes that have arrived, without waiting."""
        if waiting := self._guarded(lambda: self._connection.in_waiting):
            self._take(self._guarded(lambda: self._connection.read(waiting)))

    def request(self, message: Request, expected: type[A], *, attempts: int = ATTEMPTS) -> A:
        """Send ``message`` and return its reply; events that arrive meanwhile are passed on.

        A repetition has the same sequence number: the head replies again, but does nothing twice.

        Raises
        ------
        DeviceSilent
            The head did not reply to any of the ``attempts``.
        DeviceUnplugged
            The port is gone.
        RequestRejected
            The head rejected the request; the error says why.
        """
        self._sequence = (self._sequence + 1) % 256
        body = message.LAYOUT.pack(*astuple(message))
        frame = encode(Frame(message.ID, self._sequence, body))
        reply_bytes = protocol.REPLIES.get(type(message), Done).LAYOUT.size + HEADER + CRC + 2
        for attempt in range(attempts):
            self.statistics.retries += bool(attempt)
            self._reply = None
            self.sent_ns = self._clock.now_ns()
            self._guarded(lambda: self._connection.write(frame))
            deadline_ns = self.sent_ns + round(REPLY_S * 1e9)
            is_late = False
            while not is_late:
                is_late = self._clock.now_ns() >= deadline_ns
                if is_late:
                    self.poll()  # the reply may have arrived while this computer was busy
                else:
                    self._take(self._guarded(lambda: self._read(reply_bytes)))
                answer = self._answer(message)
                if isinstance(answer, expected):
                    return answer
        raise DeviceSilent(
            f"The rig head at {self.name} does not answer.",
            next_step="Check its USB cable and supply, and that head.port is not the port of another board.",
            evidence={"request": type(message).__name__.lower(), "attempts": attempts, **self.counts()},
        )

    def counts(self) -> dict[str, int]:
        """Return the statistics by name."""
        s, d = self.statistics, self._deframer
        s.frames, s.crc_errors, s.malformed = d.frames, d.crc_errors, d.malformed
        return {name: getattr(s, name) for name in s.__dataclass_fields__}

    def _answer(self, message: Request) -> Answer | None:
        """Return the reply to ``message`` if it has arrived."""
        frame, self._reply = self._reply, None
        if frame is None:
            return None
        answer = _parse(frame)
        if isinstance(answer, Done):
            if answer.request == message.ID and answer.rejection != Rejection.NONE:
                raise rejection(self.name, message, answer.rejection)
            return answer if answer.request == message.ID else None
        return answer

    def _read(self, frame_bytes: int) -> bytes:
        """Read the bytes that have arrived, or wait for those that the present frame still lacks."""
        return self._connection.read(max(self._connection.in_waiting, self._deframer.missing(frame_bytes)))

    def _take(self, data: bytes) -> None:
        for frame in self._deframer.feed(data):
            if frame.id in (Sample.ID, StatusChanged.ID):
                self._event(frame)
            elif frame.sequence == self._sequence:
                self._reply, self.heard_ns = frame, self._clock.now_ns()
            else:
                self.statistics.late += 1

    def _event(self, frame: Frame) -> None:
        event = _parse(frame)
        if isinstance(event, Sample | StatusChanged):
            if self._event_sequence is not None:
                self.statistics.missed += (frame.sequence - self._event_sequence - 1) % 256
            self._event_sequence = frame.sequence
            self._on_event(event)

    def restarted(self) -> None:
        """Restart the count of events, because the head restarted."""
        self._event_sequence = None

    def _guarded(self, use: Callable[[], A]) -> A:
        try:
            return use()
        except (OSError, termios.error) as gone:  # pyserial's exceptions are OSErrors, except those of termios
            raise DeviceUnplugged(
                f"The rig head's port {self.name} is gone.",
                next_step=("Plug its USB cable in.", Do.RUN_AGAIN()),
                evidence={"reason": str(gone)},
            ) from gone


def rejection(name: str, message: Request, reason: int) -> RequestRejected:
    """Return the error for a request that the head at ``name`` rejected."""
    words = _REASONS.get(reason, f"unknown reason {reason}")
    what = type(message).__name__.lower()
    latched = reason in (Rejection.FAULT_LATCHED, Rejection.CAUSE_PERSISTS)
    return RequestRejected(
        f"The rig head at {name} rejected the request '{what}': {words}.",
        next_step=("Remove the cause of the fault.", Do.ACKNOWLEDGE())
        if latched
        else "Flash the firmware of this program: make -C firmware flash.",
        evidence={"request": what, "rejection": reason},
    )


def _parse(frame: Frame) -> Answer | None:
    """Return the frame as a message; None if it is no message of this protocol."""
    kind = protocol.MESSAGES.get(frame.id)
    if kind is None or kind.LAYOUT.size != len(frame.body):
        return None
    message = kind(*kind.LAYOUT.unpack(frame.body))
    return message if isinstance(message, Answer) else None
