"""A serial port whose other end sends the bytes of a test, on the virtual clock."""

from collections.abc import Iterable, Iterator

from rig.devices.dynamixel.bus import DynamixelBus
from rig.devices.dynamixel.port import READ_SLICE_S, ClockedPort
from sim.clock import VirtualClock


class ScriptedSerial:
    """Answers each write with the next of ``answers``, byte by byte, and then stays silent."""

    def __init__(self, clock: VirtualClock, answers: Iterable[bytes]) -> None:
        self.baudrate = 1_000_000
        self.written: list[bytes] = []
        self.written_ns: list[int] = []
        self._clock = clock
        self._answers: Iterator[bytes] = iter(answers)
        self._waiting = bytearray()

    @property
    def in_waiting(self) -> int:
        return len(self._waiting)

    def read(self, size: int = 1) -> bytes:
        if not self._waiting:
            self._clock.sleep(READ_SLICE_S)
        data = bytes(self._waiting[:size])
        del self._waiting[:size]
        self._clock.advance_to(self._clock.now_ns() + len(data) * 10_000_000_000 // self.baudrate)
        return data

    def write(self, data: bytes, /) -> int:
        self.written.append(bytes(data))
        self.written_ns.append(self._clock.now_ns())
        self._waiting += next(self._answers, b"")
        return len(data)

    def reset_input_buffer(self) -> None:
        self._waiting.clear()

    def close(self) -> None: ...


def scripted_bus(*answers: bytes, retries: int = 0) -> tuple[DynamixelBus, ScriptedSerial]:
    clock = VirtualClock()
    wire = ScriptedSerial(clock, answers)
    return DynamixelBus(ClockedPort(wire, clock, "scripted"), retries), wire
