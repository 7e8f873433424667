"""The connection to a rig head: greeting, heartbeat, clock comparison, and reconnection of an unplugged cable."""

from collections.abc import Callable
from contextlib import suppress

from rig.core.clock import Clock, seconds_between
from rig.core.errors import DeviceMismatch, DeviceNotFound, DeviceSilent, DeviceUnplugged, FirmwareMismatch
from rig.devices.dynamixel.port import SerialConnection
from rig.devices.head.link import HeadLink
from rig.devices.head.protocol import (
    BAUD,
    FIRMWARE,
    PROTOCOL_VERSION,
    Heartbeat,
    HeartbeatReply,
    Hello,
    Identity,
    Sample,
    StatusChanged,
)
from rig.devices.head.timing import HeadClock

GREETING_S = 3.0
"""How long the first answer may take: opening its port restarts an Arduino, and its boot loader waits."""
HEARTBEATS_PER_DEADMAN = 4


class HeadConnection:
    """A connection to one rig head; see `rig.devices.head.head.RigHead` for the parameters."""

    identity: Identity

    def __init__(
        self,
        connection: SerialConnection,
        clock: Clock,
        on_event: Callable[[Sample | StatusChanged], None],
        *,
        deadman_ms: int,
        name: str,
        reopen: Callable[[], SerialConnection] | None,
    ) -> None:
        self.link = HeadLink(connection, clock, on_event, name)
        self.timing = HeadClock(2 * self.link.frame_ns(HeartbeatReply.LAYOUT.size))
        self.name = name
        self._clock = clock
        self._deadman_ms = deadman_ms
        self._reopen = reopen
        self._heartbeat_ns = clock.now_ns()

    def greet(self) -> None:
        """Wait until the head answers, and check that it uses this program's protocol."""
        self.identity = self._greet()

    def identify(self) -> None:
        """Ask for the head's identity again, after it restarted."""
        self.identity = self.link.request(Hello(PROTOCOL_VERSION), Identity)

    @property
    def heartbeat_due(self) -> bool:
        elapsed_s = seconds_between(self._heartbeat_ns, self._clock.now_ns())
        return elapsed_s * HEARTBEATS_PER_DEADMAN * 1000 >= self._deadman_ms

    def heartbeat(self) -> HeartbeatReply:
        """Send heartbeats until one is answered; each repetition is a new heartbeat with its own times."""
        for last in (False, False, True):
            try:
                reply = self.link.request(Heartbeat(self._deadman_ms), HeartbeatReply, attempts=1)
                break
            except DeviceSilent as silent:
                if last or isinstance(silent, DeviceUnplugged):
                    raise
        self._heartbeat_ns = self.link.heard_ns
        return reply

    def compare_clocks(self, reply: HeartbeatReply) -> None:
        """Add the last heartbeat's round trip to the clock comparison."""
        received_us = self.timing.unwrap(reply.received_us)
        answered_us = self.timing.unwrap(reply.sent_us)
        self.timing.add(self.link.sent_ns, received_us, answered_us, self.link.heard_ns)

    def reconnect(self) -> None:
        """Open the port again, and continue only with the same head.

        Raises
        ------
        DeviceSilent
            The port is still gone, or nothing answers.
        DeviceMismatch
            Another head answers.
        """
        if self._reopen is None:
            raise DeviceSilent(
                f"The rig head at {self.name} stopped answering.",
                next_step="Check its USB cable, then open the bench again.",
                evidence=self.link.counts(),
            )
        with suppress(OSError):
            self.link.close()
        try:
            self.link.replace(self._reopen())
            found = self._greet()
        except DeviceNotFound as gone:
            raise DeviceSilent(gone.what, next_step=gone.steps, evidence=gone.evidence) from gone
        same = ("board", "serial", "protocol", "major", "minor", "patch")
        pairs = {name: (getattr(found, name), getattr(self.identity, name)) for name in same}
        if changed := {name: pair for name, pair in pairs.items() if pair[0] != pair[1]}:
            raise DeviceMismatch(
                f"The rig head that now answers at {self.name} is a different one.",
                next_step="Connect the bench's own head, or open the bench again.",
                evidence={name: {"got": got, "expected": expected} for name, (got, expected) in changed.items()},
            )
        self.identity = found

    def _greet(self) -> Identity:
        start_ns = self._clock.now_ns()
        while True:
            try:
                self.link.start()
                found = self.link.request(Hello(PROTOCOL_VERSION), Identity, attempts=1)
                break
            except DeviceSilent as silent:
                if isinstance(silent, DeviceUnplugged):
                    raise
                if seconds_between(start_ns, self._clock.now_ns()) > GREETING_S:
                    raise DeviceNotFound(
                        f"No rig head answers at {self.name}.",
                        next_step=f"Check that head.port is the head's port, and flash the head: make -C firmware "
                        f"flash PORT={self.name}.",
                        evidence={"baud": BAUD, **self.link.counts()},
                    ) from silent
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
        return found


def version(identity: Identity) -> str:
    """Return the firmware's version as text."""
    return f"{identity.major}.{identity.minor}.{identity.patch}"
