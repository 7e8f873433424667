"""The boot loader of an Arduino Nano or Uno in front of a simulated rig head, as a programmer and the host see it.

It speaks the part of STK500 version 1 (Atmel, AVR061) that boot loaders have. A board starts its boot loader after a
reset. When nothing valid arrives for some time, or when the programmer is done, it starts the program in its flash.
"""

from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import Final

from sim.head.board import SimHead
from sim.head.serial_port import HeadSerial
from sim.world import World
from tests.firmware.avr import emulated_head

FLASH_BYTES: Final = 32_768
EEPROM_BYTES: Final = 1024
PAGE_BYTES: Final = 128
SIGNATURE: Final = bytes((0x1E, 0x95, 0x0F))

_END: Final = 0x20
_IN_SYNC, _OK = b"\x14", b"\x10"
_GET_PARAMETER, _SET_DEVICE, _SET_DEVICE_EXT, _LEAVE, _LOAD_ADDRESS, _UNIVERSAL = 0x41, 0x42, 0x45, 0x51, 0x55, 0x56
_PROGRAM_PAGE, _READ_PAGE, _READ_SIGNATURE = 0x64, 0x74, 0x75
_MORE: Final = {_GET_PARAMETER: 1, _SET_DEVICE: 20, _SET_DEVICE_EXT: 5, _LOAD_ADDRESS: 2, _UNIVERSAL: 4, _READ_PAGE: 3}
"""Bytes that follow a command; the first two of `_PROGRAM_PAGE` are the length of its data. Others have none."""


@dataclass(frozen=True, slots=True)
class Kind:
    """A boot loader: its baud rate, the time that it waits, and whether it distinguishes EEPROM and flash."""

    name: str
    baud: int
    wait_s: float
    has_eeprom: bool


OPTIBOOT: Final = Kind("Optiboot", 115_200, 1.0, has_eeprom=False)
"""Nano since 2018, Uno. It ignores the kind of memory: data for the EEPROM overwrites a page of the flash."""
ATMEGABOOT: Final = Kind("ATmegaBOOT", 57_600, 2.0, has_eeprom=True)
"""Nano before 2018."""


class Arduino:
    """A board with a boot loader, as a connection of `sim.realtime.port.PtyPort`.

    A pseudo-terminal does not show DTR, which resets a real board when a program opens its port. Here the board is
    reset when a program has set a baud rate, which it does when it opens the port. ``baud`` returns that rate; 0 if no
    program has set one. ``program`` is the running program; None while the boot loader runs.
    """

    def __init__(self, world: World, kind: Kind, baud: Callable[[], int]) -> None:
        self.flash = bytearray(b"\xff" * FLASH_BYTES)
        self.eeprom = bytearray(b"\xff" * EEPROM_BYTES)
        self.program: SimHead | None = None
        self.resets = 0
        self._world = world
        self._kind = kind
        self._host_baud = baud
        self._baud = 0
        self._serial: HeadSerial | None = None
        self._answer = bytearray()
        self._address = 0
        self._heard_ns = 0
        self._dialogue: Generator[None, int, None]
        self.reset()

    def reset(self) -> None:
        """Start the boot loader."""
        if self.program is not None:
            self.program.close()
        self.program = self._serial = None
        self.resets += 1
        self._answer.clear()
        self._heard_ns = self._world.clock.now_ns()
        self._dialogue = self._converse()
        next(self._dialogue)

    def close(self) -> None:
        """Free the running program."""
        if self.program is not None:
            self.program.close()

    def write(self, data: bytes, /) -> int:
        self._follow()
        for byte in data:
            if self._serial is not None:
                self._serial.write(bytes((byte,)))
            elif self._baud == self._kind.baud:  # else it receives framing errors
                self._heard_ns = self._world.clock.now_ns()
                self._dialogue.send(byte)
        return len(data)

    @property
    def in_waiting(self) -> int:
        self._follow()
        return len(self._answer) if self._serial is None else self._serial.in_waiting

    def read(self, size: int = 1) -> bytes:
        if self._serial is not None:
            return self._serial.read(size)
        data = bytes(self._answer[:size])
        del self._answer[:size]
        return data

    def _follow(self) -> None:
        """Reset the board if a program has opened the port; start the program after the boot loader's time."""
        if (baud := self._host_baud()) != self._baud:
            self._baud = baud
            if baud:
                self.reset()
        waited_s = (self._world.clock.now_ns() - self._heard_ns) * 1e-9
        if self.program is None and not self._answer and waited_s >= self._kind.wait_s and self.flash[0] != 0xFF:
            self._start()

    def _start(self) -> None:
        stored = int.from_bytes(self.eeprom[:4], "little")
        self.program = emulated_head(self._world, serial=stored, flash=bytes(self.flash))
        self._serial = HeadSerial(self.program)

    def _converse(self) -> Generator[None, int, None]:
        """Answer commands; a new byte arrives at each ``yield``."""
        while True:
            command = yield
            words = bytearray()
            if command == _PROGRAM_PAGE:
                for _ in range(3):
                    words.append((yield))
            count = int.from_bytes(words[:2], "big") if command == _PROGRAM_PAGE else _MORE.get(command, 0)
            for _ in range(count):
                words.append((yield))
            if (yield) != _END:
                continue  # out of synchronisation: a real boot loader resets itself
            self._answer += _IN_SYNC + self._done(command, bytes(words)) + _OK
            if command == _LEAVE:
                self._heard_ns -= round(self._kind.wait_s * 1e9)  # its watchdog ends the boot loader

    def _done(self, command: int, words: bytes) -> bytes:
        if command == _GET_PARAMETER:
            return bytes(({0x81: 4, 0x82: 4}.get(words[0], 3),))
        if command == _UNIVERSAL:
            return b"\0"
        if command == _READ_SIGNATURE:
            return SIGNATURE
        if command == _LOAD_ADDRESS:
            self._address = 2 * int.from_bytes(words, "little")
        elif command == _PROGRAM_PAGE:
            self._store(words[2:3] == b"E", words[3:])
        elif command == _READ_PAGE:
            memory, start = self._memory(words[2:3] == b"E")
            return bytes(memory[start : start + int.from_bytes(words[:2], "big")])
        return b""

    def _memory(self, is_eeprom: bool) -> tuple[bytearray, int]:
        if is_eeprom and self._kind.has_eeprom:
            return self.eeprom, self._address // 2
        return self.flash, self._address

    def _store(self, is_eeprom: bool, data: bytes) -> None:
        memory, start = self._memory(is_eeprom)
        if memory is self.flash:  # a page is erased as a whole
            page = start - start % PAGE_BYTES
            memory[page : page + PAGE_BYTES] = b"\xff" * PAGE_BYTES
        memory[start : start + len(data)] = data
