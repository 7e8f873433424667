"""The half-duplex bus between host and servos, byte by byte in time."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum

from sim.clock import VirtualClock
from sim.servo.device import SimServo
from sim.servo.protocol2 import BROADCAST_ID, InstructionPacket, PacketParser, status_packet

BITS_PER_BYTE = 10  # a start bit, 8 data bits, a stop bit
ABANDON_S = 0.05  # silence after which a device drops an incomplete packet; the e-manual states no value
PING_SLOT_S = 0.003
PING_STATUS_BYTES = 14
"""Broadcast Ping: each id has a slot of one status packet and 3 ms, as in the SDK's timeout."""
COLLISION_SHIFT_BITS = 3  # any small number: what matters is that the bytes overlap and differ
"""Delay of the second of two devices with one id, because they never answer at exactly the same time."""


class Sender(Enum):
    HOST = "host"
    DEVICE = "device"


@dataclass(frozen=True, slots=True)
class SentBytes:
    """Bytes that are sent without a gap; ``start_ns`` is the beginning of the first start bit."""

    source: Sender
    start_ns: int
    baudrate: int
    data: bytes

    def arrival_ns(self, count: int) -> int:
        """Return when the first ``count`` bytes have arrived."""
        return self.start_ns + count * BITS_PER_BYTE * 1_000_000_000 // self.baudrate

    @property
    def end_ns(self) -> int:
        return self.arrival_ns(len(self.data))


class ServoBus:
    """Servos on one bus, and the host's adapter.

    An instruction reaches the devices when its last byte has arrived. An answer begins after the device's Return Delay
    Time. A device with another baud rate than the host receives nothing. The answers of two devices with one id
    collide. Bytes of the host do not collide with the answer of a device here.
    """

    def __init__(self, clock: VirtualClock) -> None:
        self.clock = clock
        self.taps: list[Callable[[SentBytes], None]] = []
        """Called with each frame in both directions, as the host sees it."""
        self.filters: list[Callable[[SentBytes], SentBytes | None]] = []
        """Called in their order with each frame from a device to the host. A filter returns the frame that the host
        receives instead (other bytes, another time), or None if the frame is lost."""
        self.echo = False
        """Whether the adapter receives its own bytes, like a half-duplex one without a switched receiver."""
        self._devices: list[SimServo] = []
        self._deliver: Callable[[SentBytes], None] | None = None
        self._sent_until_ns = 0
        self._parser = PacketParser()
        self._last_frame = SentBytes(Sender.HOST, 0, 1, b"")

    def attach(self, device: SimServo) -> None:
        """Connect a servo to the bus."""
        self._devices.append(device)

    def detach(self, device: SimServo) -> None:
        """Disconnect a servo from the bus; ValueError if it is not connected."""
        self._devices.remove(device)

    def connect(self, deliver: Callable[[SentBytes], None]) -> bool:
        """Connect the receiver of the host; return False if the bus already has a host."""
        if self._deliver is not None:
            return False
        self._deliver = deliver
        return True

    def disconnect(self) -> None:
        self._deliver = None

    def send(self, data: bytes, baudrate: int) -> None:
        """Send the host's bytes after those still being sent."""
        frame = SentBytes(Sender.HOST, max(self.clock.now_ns(), self._sent_until_ns), baudrate, data)
        self._sent_until_ns = frame.end_ns
        for tap in self.taps:
            tap(frame)
        if self.echo and self._deliver is not None:
            self._deliver(frame)
        self.clock.call_at(frame.end_ns, lambda: self._receive(frame))

    def disturb(self, data: bytes, baudrate: int) -> None:
        """Send bytes to the host that no servo has sent."""
        if self._deliver is not None:
            self._deliver(SentBytes(Sender.DEVICE, self.clock.now_ns(), baudrate, data))

    def _receive(self, frame: SentBytes) -> None:
        if frame.baudrate != self._last_frame.baudrate or frame.start_ns - self._last_frame.end_ns > ABANDON_S * 1e9:
            self._parser.reset()
        self._last_frame = frame
        for packet in self._parser.feed(frame.data):
            self._dispatch(packet, frame.baudrate)

    def _dispatch(self, packet: InstructionPacket, baudrate: int) -> None:
        # Ids and delays are those before the instruction; its changes apply from the next instruction.
        called = [(d, d.bus_id, d.return_delay_ns) for d in self._devices if d.powered and d.baudrate == baudrate]
        now_ns, slot_ns = self.clock.now_ns(), 0
        if packet.bus_id == BROADCAST_ID:  # only a ping is answered then
            slot_ns = round((PING_SLOT_S + PING_STATUS_BYTES * BITS_PER_BYTE / baudrate) * 1e9)
        frames = [
            SentBytes(Sender.DEVICE, now_ns + delay_ns + bus_id * slot_ns, baudrate, status_packet(bus_id, *status))
            for device, bus_id, delay_ns in called
            if (status := device.execute(packet)) is not None
        ]
        for frame in superpose(frames):
            self._reply(frame)

    def _reply(self, frame: SentBytes) -> None:
        for change in self.filters:
            changed = change(frame)
            if changed is None:
                return
            frame = changed
        for tap in self.taps:
            tap(frame)
        if self._deliver is not None:
            self._deliver(frame)


def superpose(frames: list[SentBytes]) -> list[SentBytes]:
    """Return the bytes on the bus when ``frames`` are sent: frames that overlap in time collide."""
    line: list[SentBytes] = []
    for frame in sorted(frames, key=lambda f: f.start_ns):
        if line and frame.start_ns < line[-1].end_ns:
            line[-1] = _collide(line[-1], frame)
        else:
            line.append(frame)
    return line


def _collide(first: SentBytes, second: SentBytes) -> SentBytes:
    """Return the bytes received from two senders: a bus with a pull-up is low if one of them drives it low."""
    shift = COLLISION_SHIFT_BITS + (second.start_ns - first.start_ns) * first.baudrate // 1_000_000_000
    ones, others = _levels(first.data), _levels(second.data)
    length = max(len(ones), shift + len(others)) + BITS_PER_BYTE
    line = [1] * length
    line[: len(ones)] = ones
    for i, level in enumerate(others):
        line[shift + i] &= level
    data = bytearray()
    i = 0
    while i + BITS_PER_BYTE <= length:
        if line[i]:
            i += 1
            continue
        data.append(sum(level << bit for bit, level in enumerate(line[i + 1 : i + 9])))
        i += BITS_PER_BYTE
    return replace(first, data=bytes(data))


def _levels(data: bytes) -> list[int]:
    """Return the levels of the bus, one for each bit, for ``data`` as a UART sends it."""
    return [level for byte in data for level in (0, *(byte >> bit & 1 for bit in range(8)), 1)]
