"""Registers by name on a Dynamixel bus; each reply is matched to its request.

Decision: docs/decisions/0006.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from threading import RLock

import serial
from dynamixel_sdk import COMM_RX_CORRUPT, COMM_SUCCESS

from rig.core.clock import seconds_between
from rig.core.errors import DeviceSilent, RequestRejected
from rig.core.next_steps import Do, SomeSteps
from rig.devices.dynamixel.packets import (
    CORRUPTED,
    HEADER,
    PING,
    READ,
    REBOOT,
    REJECTIONS,
    WRITE,
    Packets,
    Reply,
    read_parameters,
    reason,
)
from rig.devices.dynamixel.port import BusBabble, ClockedPort
from rig.devices.dynamixel.registers import ControlTable, Register

OUTSTANDING_S = 2.0
"""How long a missing reply may still arrive: longer than any buffer can delay it."""

# longer: reading is slow after one late reply; shorter: an adapter that repeats replies is trusted too early
DOUBT_S = 60.0
"""How long a bus counts as one that repeats replies, after one arrived that belongs to no request."""

CONFIRM_ATTEMPTS = 16  # more: a bus that repeats everything holds the control loop for longer
"""Largest number of repetitions of a reading until only its reply arrives."""

_BITS = 10  # a byte with its start and stop bit
_STATUS_BYTES = 11  # of a status packet without parameters
_READ_LENGTHS = 4  # lengths of reads in a row: a repeated answer to an earlier one has another length
Answers = tuple[dict[int, Reply], int]
"""Replies by id, and the SDK's result for missing ones."""


@dataclass(slots=True)
class BusStatistics:
    """Statistics since the bus was opened.

    ``late`` counts replies to earlier requests, ``foreign`` replies of devices that were not asked.
    """

    transactions: int = 0
    retries: int = 0
    timeouts: int = 0
    corrupt: int = 0
    late: int = 0
    foreign: int = 0
    rejected: int = 0


class DynamixelBus:
    """Reads and writes registers; repeats failed transactions, and never returns a failed read as a value.

    The protocols have no sequence numbers, so a reply after its time-out could be accepted as the next one. Therefore
    the bus distinguishes replies by their length. Successive reads ask for different numbers of bytes, by some more
    bytes below the address, and while a reply is missing, no other read asks for its number of bytes. The replies to
    all writes are equal. So while a reply is missing, and for `DOUBT_S` after a reply that belongs to no request, each
    write is read back, and each reading is confirmed.

    After ``retries`` repetitions of a transaction the device counts as silent. All instructions used here are absolute
    (a read, or a write of a value), so a repetition is harmless.
    """

    def __init__(self, port: ClockedPort, retries: int = 3) -> None:
        self.port = port
        self.statistics = BusStatistics()
        self.asked_ns = 0
        """When the last attempt of a transaction began."""
        self.sampled_ns = 0
        """When the device began to send the last block that was read; it had sampled its registers just before."""
        self.packets = Packets()
        self._retries = retries
        self._accepted: Callable[[Reply], object] = getattr(port.ser, "accepted", lambda _: None)
        """Called with each reply: for a trace."""
        self._lock = RLock()
        self._alerts: dict[int, int] = {}
        self._reads = 0
        self._unanswered = False  # the last request, also if Ctrl+C interrupted it: its reply may still arrive
        # Replies that may still arrive: number of parameters, and time of the request.
        self._outstanding: list[tuple[int, int]] = []
        self._foreign_ns: int | None = None  # when the last reply arrived that belongs to no request

    def alert(self, device_id: int) -> int:
        """Return the alert of the device's last status packet; 0 if its hardware has no fault, see `Reply`."""
        return self._alerts.get(device_id, 0)

    def ping(self, device_id: int) -> int:
        """Return the model number of the device."""
        if self._is_outstanding(3):
            return int.from_bytes(self.read_block(device_id, 0, 3)[:2], "little")
        answer = self._transact("ping", (device_id,), lambda: self.ask(device_id, PING, b"", 3))[device_id]
        return int.from_bytes(answer.data[:2], "little")

    def read(self, device_id: int, register: Register) -> int:
        return register.decode(self.read_block(device_id, register.address, register.size))

    def read_block(self, device_id: int, address: int, size: int, *, dated: bool = False) -> bytes:
        """Return ``size`` bytes from ``address``, read in one transaction; ``dated`` if they show their own age.

        In doubt, a second reading confirms the first one. If the first reply was an old one, the right reply is there
        already or arrives before the reply to the second reading; then both are discarded.
        """
        data, self.sampled_ns = self._read_once(device_id, address, size)
        if dated or not self._repeats_replies():
            return data
        counts = self.statistics
        for _ in range(CONFIRM_ATTEMPTS):
            alone, before = not self._drop_foreign(), (counts.late, counts.retries)
            again, sampled_ns = self._read_once(device_id, address, size)
            if alone and (counts.late, counts.retries) == before:
                return data
            data, self.sampled_ns = again, sampled_ns
        what = f"read of {size} bytes at {address}"
        raise self._silent(what, (device_id,), "replies arrive twice", "Check the adapter and its driver.")

    def _drop_foreign(self) -> bool:
        """Drop what arrived after the last reply; return whether a reply or the beginning of one is among it."""
        waiting = self.port.getBytesAvailable()
        data = self.port.ser.read(waiting) if waiting else b""
        found = any(data[i:].startswith(HEADER) or HEADER.startswith(data[i:]) for i in range(len(data)))
        if found:
            self._foreign_ns = self.port.clock.now_ns()
        return found

    def _repeats_replies(self) -> bool:
        """Return whether a reply that belongs to no request arrived recently."""
        return self._foreign_ns is not None and seconds_between(self._foreign_ns, self.port.clock.now_ns()) <= DOUBT_S

    def _read_once(self, device_id: int, address: int, size: int) -> tuple[bytes, int]:
        """Return the bytes, and when the device began to send them."""
        skipped = 0

        def attempt() -> Answers:
            nonlocal skipped
            start, asked = self._unambiguous(address, size)
            skipped = address - start
            return self.ask(device_id, READ, read_parameters(start, asked), asked)

        reply = self._transact(f"read of {size} bytes at {address}", (device_id,), attempt)[device_id]
        # The reply ended just now, and took its length at the baud rate.
        sent_ns = reply.size * _BITS * 1_000_000_000 // self.port.baudrate
        return reply.data[skipped : skipped + size], self.port.clock.now_ns() - sent_ns

    def read_table(self, device_id: int, table: ControlTable) -> dict[str, int]:
        """Return every register by name, in the order of addresses, without indirect addressing."""
        registers = sorted(
            {r.address: r for r in table.values() if not r.name.startswith("Indirect")}.values(),
            key=lambda register: register.address,
        )
        return {register.name: self.read(device_id, register) for register in registers}

    def write(self, device_id: int, register: Register, value: int, *, answered: bool = True) -> None:
        """Write a register; with ``answered`` False do not wait for a reply, which the servo may be set not to send."""
        data = register.encode(value)

        def attempt() -> Answers:
            doubtful = self._is_outstanding(0) or self._repeats_replies()  # an earlier reply may look like this one
            parameters = register.address.to_bytes(2, "little") + data
            answers = self.ask(device_id, WRITE, parameters, 0, (device_id,) if answered else ())
            reply = answers[0].get(device_id)
            if reply is None or reply.error or not doubtful:
                return answers
            start, asked = self._unambiguous(register.address, register.size)
            replies, result = self.ask(device_id, READ, read_parameters(start, asked), asked)
            skipped = register.address - start
            if result == COMM_SUCCESS and replies[device_id].data[skipped : skipped + register.size] == data:
                return answers
            return {}, COMM_RX_CORRUPT if result == COMM_SUCCESS else result

        self._transact(f"write of {register.name} = {value}", (device_id,), attempt)

    def reboot(self, device_id: int) -> None:
        """Restart a device, which is then silent for some tenths of a second."""
        self._transact("reboot", (device_id,), lambda: self.ask(device_id, REBOOT, b"", 0))

    def close(self) -> None:
        self.port.closePort()

    # -- requests and replies ------------------------------------------------------------------------------------

    def _transact(self, what: str, device_ids: Sequence[int], attempt: Callable[[], Answers]) -> dict[int, Reply]:
        """Repeat attempts until all devices have answered or no retries remain; return their replies."""
        with self._lock:  # the SDK would report to a second thread that the port is busy, or mix up their packets
            for number in range(self._retries + 1):
                self.statistics.transactions += 1
                self.statistics.retries += number > 0
                try:
                    if self._unanswered:  # the reply to it may be on its way
                        self.port.drain()
                    self._unanswered, self.asked_ns = True, self.port.clock.now_ns()
                    replies, result = attempt()
                except (serial.SerialException, OSError) as unplugged:
                    self.port.lost = True  # `reconnect` opens it again
                    step = "Check the adapter's USB plug, then start again."
                    raise self._silent(what, device_ids, f"the port failed: {unplugged}", step) from unplugged
                except (BusBabble, IndexError):
                    # From some noise the SDK builds a packet that is too short for its own parser.
                    replies, result = {}, COMM_RX_CORRUPT
                finally:
                    self.port.is_using = False  # the SDK leaves it set after an error
                if result == COMM_SUCCESS:
                    self._unanswered = False
                    self._alerts |= {reply.bus_id: reply.alert for reply in replies.values()}
                    rejected = next((reply for reply in replies.values() if reply.error), None)
                    if rejected is None:
                        return replies
                    if rejected.error != CORRUPTED:
                        self.statistics.rejected += 1
                        raise _rejected(what, rejected)
                    result, replies = COMM_RX_CORRUPT, {}  # the instruction was damaged on its way: send it again
                self.statistics.corrupt += result == COMM_RX_CORRUPT
                self.statistics.timeouts += result != COMM_RX_CORRUPT
            # No attempt succeeded: say what the operator can check.
            missing = [device_id for device_id in device_ids if device_id not in replies]
            advice: SomeSteps = (
                (
                    "The replies are corrupted: check for two servos with the same id, another program on the bus, or "
                    "a bad cable.",
                    Do.FIND(),
                )
                if result == COMM_RX_CORRUPT
                else "Check the servo's cable and its supply (its LED blinks at power-up), then start again."
            )
            raise self._silent(what, missing or device_ids, reason(result), advice)

    def ask(
        self, target: int, instruction: int, parameters: bytes, size: int, answering: Sequence[int] | None = None
    ) -> Answers:
        """Send an instruction to ``target``; wait for replies with ``size`` parameters, from it or from ``answering``.

        A reply of another length does not belong to this request. A rejection has no parameters: while a reply without
        parameters is missing, a rejection is accepted only if no longer reply arrives.
        """
        # Send, after old bytes were dropped; from now on a reply of this length is owed.
        answering = (target,) if answering is None else answering
        self._drop_foreign()
        ambiguous = size > 0 and self._is_outstanding(0)
        self._outstanding += [(size, self.port.clock.now_ns())] * max(len(answering), 1)
        result = self.packets.send(self.port, target, instruction, parameters)
        if result != COMM_SUCCESS:
            return {}, result
        self.port.setPacketTimeout((_STATUS_BYTES + size) * len(answering))
        # Collect the replies, and leave out what belongs to no request of ours.
        replies: dict[int, Reply] = {}
        doubtful: dict[int, Reply] = {}
        while len(replies) < len(answering):
            reply, result = self.packets.receive(self.port)
            if reply is None:
                replies = doubtful | replies
                break
            if reply.bus_id not in answering:
                self.statistics.foreign += 1
            elif reply.error and not reply.data and ambiguous:
                doubtful[reply.bus_id] = reply
            elif len(reply.data) != size and not (reply.error and not reply.data):
                self.statistics.late += 1
                self._foreign_ns = self.port.clock.now_ns()
            else:
                replies[reply.bus_id] = reply
                del self._outstanding[[one for one, _ in self._outstanding].index(size)]
        for reply in replies.values():
            self._accepted(reply)
        return replies, COMM_SUCCESS if len(replies) == len(answering) else result

    def _is_outstanding(self, size: int) -> bool:
        """Return whether a reply with ``size`` parameters may still arrive."""
        if not self._outstanding:
            return False
        now_ns = self.port.clock.now_ns()
        self._outstanding = [one for one in self._outstanding if seconds_between(one[1], now_ns) <= OUTSTANDING_S]
        return any(one == size for one, _ in self._outstanding)

    def _unambiguous(self, address: int, size: int) -> tuple[int, int]:
        """Return start and size of a read that includes ``size`` bytes at ``address`` and has an unambiguous reply."""
        asked = size + min(self._reads % _READ_LENGTHS, address)
        self._reads += 1
        while self._is_outstanding(asked):
            asked += 1
        return max(address - (asked - size), 0), asked

    def _silent(self, what: str, device_ids: Sequence[int], reason: str, next_step: SomeSteps) -> DeviceSilent:
        ids = ", ".join(map(str, device_ids))
        return DeviceSilent(
            f"Servo {ids} does not answer ({what}).",
            next_step=next_step,
            evidence={"reason": reason, "attempts": self._retries + 1, "baud": self.port.baudrate},
        )


def _rejected(what: str, reply: Reply) -> RequestRejected:
    return RequestRejected(
        f"Servo {reply.bus_id} rejected the {what}: {REJECTIONS.get(reply.error, f'error {reply.error}')}.",
        next_step=(Do.STATUS(), "A tripped watchdog or a hardware error prevents motion."),
        evidence={"status_error": reply.error, "alert": bool(reply.alert)},
    )


def watchdog_units(timeout_s: float) -> int:
    """Return the Bus Watchdog's register value for a timeout: units of 20 ms, rounded up, in 1–127."""
    return min(max(math.ceil(timeout_s / 0.02), 1), 127)
