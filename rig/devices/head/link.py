"""The serial link to a rig head: frames, requests with their replies, events, the greeting, and reconnection.

A frame is COBS, ended by a zero byte, with id, sequence, body and CRC-16 inside (see firmware/PROTOCOL.md).
"""

import termios
from binascii import crc_hqx
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass
from typing import TypeVar

from cobs import cobs

from rig.core.clock import Clock, seconds_between
from rig.core.errors import (
    DeviceFault,
    DeviceMismatch,
    DeviceNotFound,
    DeviceSilent,
    DeviceUnplugged,
    FirmwareMismatch,
    RequestRejected,
)
from rig.core.next_steps import Do
from rig.devices.dynamixel.port import SerialConnection
from rig.devices.head import protocol
from rig.devices.head.protocol import (
    BAUD,
    FIRMWARE,
    MAX_BODY,
    PROTOCOL_VERSION,
    Answer,
    Done,
    Heartbeat,
    HeartbeatReply,
    Hello,
    Identity,
    Rejection,
    Request,
    Sample,
    SetSerial,
    StatusChanged,
)

HEADER, CRC = 2, 2
OVERHEAD = HEADER + CRC + 2
"""Bytes of a frame on the wire besides its body: one of COBS, and the zero."""
LONGEST = MAX_BODY + OVERHEAD

REPLY_S = 0.06
"""How long a reply may take: 6 ms behind a full transmitter, plus twice a USB adapter's latency timer."""
ATTEMPTS = 3  # a corrupt frame is sent again; with more attempts, a dead connection is noticed later
GREETING_S = 3.0
"""How long the first answer may take: opening its port restarts an Arduino, and its boot loader waits."""

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


@dataclass(frozen=True, slots=True)
class HeadFrame:
    """The content of a frame."""

    id: int
    sequence: int
    body: bytes


def encode(frame: HeadFrame) -> bytes:
    """Return the frame's bytes on the wire, including the zero that ends them."""
    content = bytes([frame.id, frame.sequence]) + frame.body
    encoded: bytes = cobs.encode(content + crc_hqx(content, 0xFFFF).to_bytes(CRC, "big"))
    return encoded + b"\0"


@dataclass(slots=True)
class HeadStatistics:
    """Counts since the head was opened.

    ``missed`` counts events that did not arrive intact, ``late`` replies that came too late, ``retries`` repeated
    requests, ``lost`` samples that never reached a reader, ``dropped`` those of them for which the head had no room.
    """

    frames: int = 0
    crc_errors: int = 0
    malformed: int = 0
    missed: int = 0
    late: int = 0
    retries: int = 0
    lost: int = 0
    dropped: int = 0
    reconnects: int = 0
    restarts: int = 0


def decode(line: bytes, statistics: HeadStatistics) -> HeadFrame | None:
    """Return the frame in ``line``, the bytes between two zeros, and count it; None if it is not COBS, or damaged."""
    content = b""
    if len(line) < LONGEST:
        with suppress(cobs.DecodeError):
            content = cobs.decode(line)
    if len(content) < HEADER + CRC:
        statistics.malformed += 1
    elif crc_hqx(content, 0xFFFF):  # over data and its CRC the remainder is 0
        statistics.crc_errors += 1
    else:
        statistics.frames += 1
        return HeadFrame(content[0], content[1], content[HEADER:-CRC])
    return None


class Deframer:
    """Splits a stream of bytes into frames, and counts invalid ones."""

    def __init__(self, statistics: HeadStatistics) -> None:
        self._statistics = statistics
        self._line = bytearray()

    def feed(self, data: bytes) -> Iterator[HeadFrame]:
        """Add bytes and yield the frames that they complete."""
        *lines, rest = (bytes(self._line) + data).split(b"\0")
        # A frame that is too long is invalid: keep only enough of it to detect that.
        self._line[:] = rest[:LONGEST]
        for line in filter(None, lines):
            if frame := decode(line, self._statistics):
                yield frame

    def missing(self, length: int) -> int:
        """Return how many bytes the present frame lacks, at least 1, if it has ``length`` bytes with its zero."""
        return max(length - len(self._line), 1)

    def reset(self) -> None:
        """Drop an incomplete frame."""
        self._line.clear()


class HeadLink:
    """Requests, replies and events on the port of one rig head.

    The reads of ``connection`` return after a few milliseconds. ``on_event`` is called with each message that arrives
    without a request, and ``reopen`` opens the port again after the cable was unplugged; None if that is not possible.
    """

    identity: Identity

    def __init__(
        self,
        connection: SerialConnection,
        clock: Clock,
        on_event: Callable[[Sample | StatusChanged], None],
        name: str,
        reopen: Callable[[], SerialConnection] | None = None,
    ) -> None:
        self.name = name
        self.statistics = HeadStatistics()
        self.sent_ns = self.heard_ns = clock.now_ns()
        """When the last request was sent, and when its reply arrived."""
        self._connection = connection
        self._clock = clock
        self._on_event = on_event
        self._reopen = reopen
        self._deframer = Deframer(self.statistics)
        self._sequence = 0
        self._event_sequence: int | None = None
        self._reply: HeadFrame | None = None

    def frame_ns(self, body_bytes: int) -> float:
        """Return the time that a frame with such a body takes on the wire."""
        return (body_bytes + OVERHEAD) * 10e9 / self._connection.baudrate

    def close(self) -> None:
        self._connection.close()

    # -- the greeting -------------------------------------------------------------------------------------------------

    def identify(self) -> None:
        """Ask for the head's identity again, after it restarted."""
        self.identity = self.request(Hello(PROTOCOL_VERSION), Identity)
        self._event_sequence = None

    def reconnect(self) -> None:
        """Open the port again, and continue only with the same head.

        Raises `DeviceSilent`: the port is still gone, or nothing answers. `DeviceMismatch`: another head answers.
        """
        if self._reopen is None:
            raise DeviceSilent(
                f"The rig head at {self.name} stopped answering.",
                next_step="Check its USB cable, then open the bench again.",
                evidence=asdict(self.statistics),
            )
        with suppress(OSError):
            self._connection.close()
        expected = self.identity
        try:
            self._connection = self._reopen()
            self.greet()
        except DeviceNotFound as gone:
            raise DeviceSilent(gone.what, next_step=gone.steps, evidence=gone.evidence) from gone
        same = ("board", "serial", "protocol", "major", "minor", "patch")
        pairs = {name: {"got": getattr(self.identity, name), "expected": getattr(expected, name)} for name in same}
        if changed := {name: pair for name, pair in pairs.items() if pair["got"] != pair["expected"]}:
            self.identity = expected  # the bench's own head may be connected later
            raise DeviceMismatch(
                f"The rig head that now answers at {self.name} is a different one.",
                next_step="Connect the bench's own head, or open the bench again.",
                evidence=changed,
            )
        self.statistics.reconnects += 1

    def store_serial(self, serial: int) -> None:
        """Store a serial number, 0 to 2³² − 2, in the head, and read it back.

        Raises `RequestRejected`: a program uses the head, or its firmware is older than 1.1. `DeviceFault`: the head
        reports another number afterwards.
        """
        self.request(SetSerial(serial), Done)
        self.identify()
        if self.identity.serial != serial:
            raise DeviceFault(
                f"The rig head at {self.name} did not store its serial number.",
                next_step="Try again. If this repeats, its EEPROM is worn out: use another board.",
                evidence={"requested": serial, "reported": self.identity.serial},
            )

    def start(self) -> None:
        """End a frame that an earlier program may have sent in part, and drop the replies that it did not read."""
        self._guarded(lambda: self._connection.write(b"\0"))
        self._guarded(self._connection.reset_input_buffer)
        self._deframer.reset()
        self._event_sequence = None

    def greet(self) -> None:
        """Wait until the head answers, and check that it uses this program's protocol.

        Raises `DeviceNotFound`: nothing answers that uses the protocol. `FirmwareMismatch`: the head uses another
        version; the message says which side to update.
        """
        # A board may restart when its port is opened, and an earlier program may have left half a frame.
        start_ns = self._clock.now_ns()
        while True:
            try:
                self.start()
                found = self.request(Hello(PROTOCOL_VERSION), Identity, attempts=1)
                break
            except DeviceUnplugged:
                raise
            except DeviceSilent as silent:
                if seconds_between(start_ns, self._clock.now_ns()) > GREETING_S:
                    raise DeviceNotFound(
                        f"No rig head answers at {self.name}.",
                        next_step=f"Check that head.port is the head's port, and flash the head: make -C firmware "
                        f"flash PORT={self.name}.",
                        evidence={"baud": BAUD, **asdict(self.statistics)},
                    ) from silent
        # Any version answers this request, so that the message can say which side is older.
        if found.protocol != PROTOCOL_VERSION:
            ours = ".".join(map(str, FIRMWARE))
            older = found.protocol < PROTOCOL_VERSION
            raise FirmwareMismatch(
                f"The rig head at {self.name} (firmware {version(found)}) uses protocol {found.protocol}, this "
                f"program protocol {PROTOCOL_VERSION}.",
                next_step=f"Flash the head with firmware {ours}: make -C firmware flash PORT={self.name}."
                if older
                else "Update this program: the head's firmware is newer.",
                evidence={"head": found.protocol, "program": PROTOCOL_VERSION, "firmware": version(found)},
            )
        self.identity = found

    # -- requests -----------------------------------------------------------------------------------------------------

    def request(self, message: Request, expected: type[A], *, attempts: int = ATTEMPTS) -> A:
        """Send ``message`` and return its reply; events that arrive meanwhile are passed on.

        A repetition has the same sequence number: the head replies again, but does nothing twice.

        Raises `DeviceSilent`: the head did not reply to any of the ``attempts``. `DeviceUnplugged`: the port is gone.
        `RequestRejected`: the head rejected the request; the error says why.
        """
        self._sequence = (self._sequence + 1) % 256
        frame = encode(HeadFrame(message.ID, self._sequence, message.LAYOUT.pack(*vars(message).values())))
        reply_bytes = protocol.REPLIES.get(type(message), Done).LAYOUT.size + OVERHEAD
        for attempt in range(attempts):
            self.statistics.retries += bool(attempt)
            self._reply = None
            self.sent_ns = self._clock.now_ns()
            self._guarded(lambda: self._connection.write(frame))
            deadline_ns = self.sent_ns + round(REPLY_S * 1e9)
            is_late = False
            # Wait for the reply; frames of events in between are passed on, late replies dropped.
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
            evidence={"request": type(message).__name__.lower(), "attempts": attempts, **asdict(self.statistics)},
        )

    def heartbeat(self, deadman_ms: int) -> HeartbeatReply:
        """Send heartbeats until one is answered; each repetition is a new heartbeat with its own times."""
        for _ in range(ATTEMPTS - 1):
            try:
                return self.request(Heartbeat(deadman_ms), HeartbeatReply, attempts=1)
            except DeviceUnplugged:
                raise
            except DeviceSilent:
                continue
        return self.request(Heartbeat(deadman_ms), HeartbeatReply, attempts=1)

    def poll(self) -> None:
        """Process the bytes that have arrived, without waiting."""
        if waiting := self._guarded(lambda: self._connection.in_waiting):
            self._take(self._guarded(lambda: self._connection.read(waiting)))

    def _answer(self, message: Request) -> Answer | None:
        frame, self._reply = self._reply, None
        answer = None if frame is None else _parse(frame)
        if not isinstance(answer, Done):
            return answer
        if answer.request != message.ID:
            return None
        if answer.rejection != Rejection.NONE:
            raise self._rejected(message, answer.rejection)
        return answer

    def _rejected(self, message: Request, reason: int) -> RequestRejected:
        words = _REASONS.get(reason, f"unknown reason {reason}")
        what = type(message).__name__.lower()
        latched = reason in (Rejection.FAULT_LATCHED, Rejection.CAUSE_PERSISTS)
        return RequestRejected(
            f"The rig head at {self.name} rejected the request '{what}': {words}.",
            next_step=("Remove the cause of the fault.", Do.ACKNOWLEDGE())
            if latched
            else "Flash the firmware of this program: make -C firmware flash.",
            evidence={"request": what, "rejection": reason},
        )

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

    def _event(self, frame: HeadFrame) -> None:
        event = _parse(frame)
        if isinstance(event, Sample | StatusChanged):
            if self._event_sequence is not None:
                self.statistics.missed += (frame.sequence - self._event_sequence - 1) % 256
            self._event_sequence = frame.sequence
            self._on_event(event)

    def _guarded(self, use: Callable[[], A]) -> A:
        try:
            return use()
        except (OSError, termios.error) as gone:  # pyserial's exceptions are OSErrors, except those of termios
            raise DeviceUnplugged(
                f"The rig head's port {self.name} is gone.",
                next_step=("Plug its USB cable in.", Do.RUN_AGAIN()),
                evidence={"reason": str(gone)},
            ) from gone


def version(identity: Identity) -> str:
    """Return the firmware's version as text."""
    return f"{identity.major}.{identity.minor}.{identity.patch}"


def _parse(frame: HeadFrame) -> Answer | None:
    """Return the frame as a message; None if it is no message of this protocol."""
    kind = protocol.MESSAGES.get(frame.id)
    if kind is None or kind.LAYOUT.size != len(frame.body):
        return None
    message = kind(*kind.LAYOUT.unpack(frame.body))
    return message if isinstance(message, Answer) else None
