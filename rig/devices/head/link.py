"""Requests and events over the rig head's line: sequence numbers, repetitions, counts."""

import termios
from collections.abc import Callable
from dataclasses import astuple, dataclass
from typing import TypeVar

from rig.core.clock import Clock
from rig.core.errors import DeviceSilent, DeviceUnplugged, RequestRejected
from rig.devices.dynamixel.port import SerialConnection
from rig.devices.head import protocol
from rig.devices.head.framing import CRC, HEADER, Deframer, Frame, encode
from rig.devices.head.protocol import Answer, Done, Rejection, Request, Sample, StatusChanged

REPLY_S = 0.06
"""How long an answer may take: 6 ms behind a full transmitter, and twice a USB adapter's latency timer."""
ATTEMPTS = 3

A = TypeVar("A")

_REASONS: dict[int, str] = {
    Rejection.UNKNOWN_REQUEST: "its firmware does not know the request",
    Rejection.MALFORMED: "the request has another length than its firmware expects",
    Rejection.OUT_OF_RANGE: "a value is out of range",
    Rejection.FAULT_LATCHED: "a fault is latched",
    Rejection.NOT_ACTIVE: "it hears no heartbeat",
    Rejection.CAUSE_PERSISTS: "the cause of the fault is still there",
    Rejection.BUSY: "it is still busy with the last one",
}


@dataclass(slots=True)
class LinkStatistics:
    """What the line has been through.

    ``missed`` counts events of the head that never arrived whole, ``late`` answers that came after their time,
    ``retries`` requests that were sent again.
    """

    frames: int = 0
    crc_errors: int = 0
    malformed: int = 0
    missed: int = 0
    late: int = 0
    retries: int = 0


class HeadLink:
    """One open line to a head.

    Parameters
    ----------
    wire
        Open port; its reads return after a few milliseconds.
    clock
        The bench's clock.
    on_event
        Given each `Sample` and `StatusChanged` that arrives.
    name
        Of the port, for messages.
    """

    def __init__(
        self, wire: SerialConnection, clock: Clock, on_event: Callable[[Sample | StatusChanged], None], name: str
    ) -> None:
        self.name = name
        self.statistics = LinkStatistics()
        self.sent_ns = self.heard_ns = clock.now_ns()
        """When the last request left, and when its answer was here."""
        self._wire = wire
        self._clock = clock
        self._on_event = on_event
        self._deframer = Deframer()
        self._sequence = 0
        self._event_sequence: int | None = None
        self._reply: Frame | None = None

    def frame_ns(self, body_bytes: int) -> float:
        """Return what a frame with such a body takes on the line."""
        return (body_bytes + HEADER + CRC + 2) * 10e9 / self._wire.baudrate

    def close(self) -> None:
        self._wire.close()

    def replace(self, wire: SerialConnection) -> None:
        """Go on with a port that was opened anew."""
        self._wire = wire

    def start(self) -> None:
        """Close a frame that an earlier program may have left half sent, and forget what it left unread."""
        self._guarded(lambda: self._wire.write(b"\0"))
        self._guarded(self._wire.reset_input_buffer)
        self._deframer.reset()
        self._event_sequence = None

    def poll(self) -> None:
        """Take what has arrived, without waiting."""
        if waiting := self._guarded(lambda: self._wire.in_waiting):
            self._take(self._guarded(lambda: self._wire.read(waiting)))

    def request(self, message: Request, expected: type[A], *, attempts: int = ATTEMPTS) -> A:
        """Send ``message`` and return its answer; what arrives meanwhile is handed on.

        A repetition carries the same sequence number: the head answers it again, but does nothing twice.

        Raises
        ------
        DeviceSilent
            There was no answer to any of the ``attempts``.
        DeviceUnplugged
            The line is gone.
        RequestRejected
            The head did not do it, and says why.
        """
        self._sequence = (self._sequence + 1) % 256
        body = message.LAYOUT.pack(*astuple(message))
        line = encode(Frame(message.ID, self._sequence, body))
        reply_bytes = protocol.REPLIES.get(type(message), Done).LAYOUT.size + HEADER + CRC + 2
        for attempt in range(attempts):
            self.statistics.retries += bool(attempt)
            self._reply = None
            self.sent_ns = self._clock.now_ns()
            self._guarded(lambda: self._wire.write(line))
            deadline_ns = self.sent_ns + round(REPLY_S * 1e9)
            while self._clock.now_ns() < deadline_ns:
                self._take(self._guarded(lambda: self._read(reply_bytes)))
                answer = self._answer(message)
                if isinstance(answer, expected):
                    return answer
        raise DeviceSilent(
            f"the rig head at {self.name} does not answer",
            next_step="Check its USB cable and supply, and that head.port is the head's and not another board's.",
            evidence={"request": type(message).__name__.lower(), "attempts": attempts, **self.counts()},
        )

    def counts(self) -> dict[str, int]:
        """Return the statistics by name, up to now."""
        s, d = self.statistics, self._deframer
        s.frames, s.crc_errors, s.malformed = d.frames, d.crc_errors, d.malformed
        return {name: getattr(s, name) for name in s.__dataclass_fields__}

    # -- inside -----------------------------------------------------------------------------------------------------

    def _answer(self, message: Request) -> Answer | None:
        """Return the answer that has come to ``message``, if it has."""
        frame, self._reply = self._reply, None
        if frame is None:
            return None
        answer = _parse(frame)
        if isinstance(answer, Done):
            if answer.request == message.ID and answer.rejection != Rejection.NONE:
                raise refusal(self.name, message, answer.rejection)
            return answer if answer.request == message.ID else None
        return answer

    def _read(self, line_bytes: int) -> bytes:
        """Read what is there, and what a line of so many bytes still lacks: its end is then known when it is there."""
        return self._wire.read(max(self._wire.in_waiting, self._deframer.missing(line_bytes)))

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
        """Take note that the head numbers its events anew."""
        self._event_sequence = None

    def _guarded(self, use: Callable[[], A]) -> A:
        try:
            return use()
        except (OSError, termios.error) as gone:  # pyserial's exceptions are OSErrors, but for those of termios
            raise DeviceUnplugged(
                f"the rig head's port {self.name} is gone",
                next_step="Plug its USB cable in, then give the command again.",
                evidence={"reason": str(gone)},
            ) from gone


def refusal(name: str, message: Request, reason: int) -> RequestRejected:
    """Return the error for a request that the head at ``name`` did not do."""
    words = _REASONS.get(reason, f"reason {reason}, which is not known here")
    what = type(message).__name__.lower()
    return RequestRejected(
        f"the rig head at {name} refused the request '{what}': {words}",
        next_step="Remove the cause and acknowledge the fault (rig acknowledge)."
        if reason in (Rejection.FAULT_LATCHED, Rejection.CAUSE_PERSISTS)
        else "Flash the firmware that belongs to this program: make -C firmware flash.",
        evidence={"request": what, "refusal": reason},
    )


def _parse(frame: Frame) -> Answer | None:
    """Return the frame as a message; None where no head of this protocol would send it."""
    kind = protocol.MESSAGES.get(frame.id)
    if kind is None or kind.LAYOUT.size != len(frame.body):
        return None
    message = kind(*kind.LAYOUT.unpack(frame.body))
    return message if isinstance(message, Answer) else None
