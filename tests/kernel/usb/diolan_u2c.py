"""A played Diolan U2C-12: an I2C adapter for ``i2c-diolan-u2c``, which reports a bus that hangs as ETIMEDOUT.

Source: the kernel's drivers/i2c/busses/i2c-diolan-u2c.c.
"""

from collections import deque
from collections.abc import Iterator
from enum import IntEnum
from errno import ETIMEDOUT
from typing import Final

from sim.i2c import SimI2cBus
from sim.realtime.pace import RealTime
from tests.kernel.usb.descriptors import BULK, Identity, Speed, configuration, endpoint, interface
from tests.kernel.usb.device import UsbDevice

TO_DEVICE: Final = 0x02
FROM_DEVICE: Final = 4
_IN: Final = 0x80


class Command(IntEnum):
    """Commands of the adapter, as the driver sends them."""

    GET_VERSION = 0x0A
    GET_SERIAL = 0x0B
    START = 0x0C
    STOP = 0x0D
    REPEATED_START = 0x0E
    PUT_BYTE = 0x13
    GET_BYTE = 0x14
    SET_SPEED = 0x1B
    SET_STRETCHING = 0x24
    SET_STRETCHING_TIMEOUT = 0x26


class Response(IntEnum):
    """The last byte of each answer."""

    OK = 0x00
    NOT_ACKNOWLEDGED = 0x07
    TIMEOUT = 0x09


ARGUMENTS: Final = {
    Command.PUT_BYTE: 1,
    Command.GET_BYTE: 1,
    Command.SET_SPEED: 1,
    Command.SET_STRETCHING: 1,
    Command.SET_STRETCHING_TIMEOUT: 2,
}
"""Bytes that follow a command."""
_COMMANDS: Final = frozenset(map(int, Command))
_FIXED: Final = {Command.GET_VERSION: b"\x02\x04", Command.GET_SERIAL: b"\x01\x00\x00\x00"}


class DiolanU2c(UsbDevice):
    """An I2C adapter in front of a simulated bus, in real time. It answers each command by a transfer of its own."""

    identity = Identity(0x0ABF, 0x3370, 0x0100, "Diolan", "U2C-12", "1", 0x110, (255, 0, 0), 8)
    speed = Speed.FULL
    configuration = configuration(
        [interface(0, (255, 0, 0), 2), endpoint(TO_DEVICE, BULK, 64), endpoint(_IN | FROM_DEVICE, BULK, 64)]
    )

    def __init__(self, bus: SimI2cBus, time: RealTime) -> None:
        self._bus = bus
        self._time = time
        self.plugged()
        super().__init__()

    def plugged(self) -> None:
        self.answers: deque[bytes] = deque()
        self._address: int | None = None
        self._written = bytearray()

    def receive(self, endpoint: int, data: bytes) -> None:
        """Carry out the commands of one transfer, and queue their answers."""
        answers: list[bytes] = []
        addressed: int | None = None  # the answer to the address byte, which says whether it was acknowledged
        with self._time.present():
            for command, argument in commands(data):
                answer = _FIXED.get(command, b"")
                failed: Response | None = None
                match command:
                    case Command.START | Command.REPEATED_START | Command.STOP:
                        failed = self._write(last=command is Command.STOP)
                        self._address = None
                    case Command.PUT_BYTE if self._address is None:
                        self._address, addressed = argument, len(answers)
                    case Command.PUT_BYTE:
                        self._written.append(argument)
                    case Command.GET_BYTE:
                        answer, failed = self._read(last=not argument)
                if failed is not None and addressed is not None:
                    answers[addressed] = bytes([failed])
                answers.append(answer + bytes([Response.OK if failed is None else failed]))
        self.answers.extend(answers)
        self.asked(FROM_DEVICE)

    def asked(self, endpoint: int) -> None:
        while self.plug is not None and self.answers and self.plug.deliver(FROM_DEVICE, lambda _: self.answers[0]):
            self.answers.popleft()

    def _write(self, *, last: bool) -> Response | None:
        """Send what was collected for an address; return how it failed."""
        address, data, self._written = self._address, bytes(self._written), bytearray()
        if address is None or address & 1:
            return None
        return self._message(address, data, last=last)[1]

    def _read(self, *, last: bool) -> tuple[bytes, Response | None]:
        return self._message(self._address or 0, 1, last=last)

    def _message(self, address: int, content: bytes | int, *, last: bool) -> tuple[bytes, Response | None]:
        try:
            return self._bus.message(address >> 1, content, last=last), None
        except OSError as error:
            return b"", Response.TIMEOUT if error.errno == ETIMEDOUT else Response.NOT_ACKNOWLEDGED


def commands(data: bytes) -> Iterator[tuple[Command, int]]:
    """Yield the commands of a transfer with their arguments; it ends at a command that the driver does not send."""
    at = 0
    while at < len(data) and data[at] in _COMMANDS:
        command = Command(data[at])
        count = ARGUMENTS.get(command, 0)
        yield command, int.from_bytes(data[at + 1 : at + 1 + count], "little")
        at += 1 + count
