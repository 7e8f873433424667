"""A simulated rig head: the firmware, the devices on its pins, and its serial connection to the host.

The board runs up to the virtual clock's time whenever its state is read, and every few milliseconds. The world answers
its requests, such as reading a register over I2C, for the board's own time. So the result does not depend on how often
the board runs.

Decision: docs/decisions/0001.
"""

import ctypes
from collections import deque
from collections.abc import Callable
from ctypes import CFUNCTYPE, POINTER, Structure, c_bool, c_int32, c_uint8, c_uint32, c_uint64, c_void_p
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np

from rig.devices.head.protocol import BAUD, Reset
from sim.clock import VirtualClock
from sim.head import build
from sim.i2c import I2cDevice, acknowledging
from sim.world import World

BYTE_NS = 10 * 1_000_000_000 // BAUD
QUANTUM_S = 0.005  # longest time between two runs of the board: limits how late its outputs change the world
RECEIVER_BYTES = 4096  # size of the host's receive buffer (N_TTY); later bytes are lost
ABI = 1
_NEVER = 2**64 - 1  # later than every time of the board
_ROOM = 1024  # changes of outputs that are taken at once; more remain on the board for the next call

_START_WRITE, _START_READ, _WRITE, _READ, _STOP = range(5)
_BYTE, _LIGHT, _RELAY, _RESET = range(4)
_OUTPUT = np.dtype([("ns", np.uint64), ("event", np.int32), ("value", np.int32)])

_I2c = CFUNCTYPE(c_int32, c_uint64, c_int32, POINTER(c_uint8), c_int32)
_Edge = CFUNCTYPE(c_uint64, c_uint64)


class _Environment(Structure):
    _fields_ = (("i2c", _I2c), ("edge", _Edge))


@dataclass(frozen=True, slots=True)
class PinChange:
    """A change of an output: ``pin`` is light (duty, 0 to 1) or relay (0 or 1)."""

    time_ns: int
    pin: str
    value: float


class _WorldAtBoardTime:
    """The world at the board's time; all other attributes are the world's."""

    def __init__(self, head: "SimHead", world: World) -> None:
        self.clock = SimpleNamespace(now_ns=lambda: head.now_ns)
        self._head = head
        self._world = world

    def table_deg(self, time_ns: int | None = None) -> float:
        return self._world.table_deg(self._head.now_ns if time_ns is None else time_ns)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._world, name)


class SimHead:
    """A simulated rig head.

    Drivers use `sim.head.serial_port.HeadSerial`. Tests use `estop_open`, `stuck`, `nack`, `nack_conditions`, `attach`,
    `detach` and `held` (as of `sim.i2c.SimI2cBus`; here it is for bytes to the host), `reset`, `hang`, `unplugged` (the
    board runs without its cable), the outputs and their history, and the filters.

    ``clock_error`` is the relative error of its clock, positive if it is fast, and ``serial`` the serial number in its
    flash. ``library`` is another board with the interface of ``firmware/boards/host/board.h``, by default the core on
    this computer, and ``flash`` the program for a library that emulates a microcontroller.

    ``world_at_board_time`` is the world at the board's own time, for its sensors. ``filters`` are called with
    (``to_head``, byte) for each byte, and return the byte that arrives, or None if it is lost. ``listeners`` are called
    with each `PinChange`.

    Raises `ConfigError`: the firmware cannot be built on this computer.
    """

    path = ""
    """Empty: its I2C bus is not one of the computer's."""

    def __init__(
        self,
        world: World,
        *,
        clock_error: float = 0.0,
        serial: int = 1,
        library: Path | None = None,
        flash: bytes = b"",
    ) -> None:
        self.clock: VirtualClock = world.clock
        self.world_at_board_time = cast(World, _WorldAtBoardTime(self, world))
        self.light = 0.0
        self.relay_closed = False
        self.changes: deque[PinChange] = deque(maxlen=10_000)
        self.filters: list[Callable[[bool, int], int | None]] = []
        self.listeners: list[Callable[[PinChange], None]] = []
        self.resets: list[Reset] = []
        self.nack_conditions: list[Callable[[int], bool]] = []
        self.unplugged = False
        self.held: Callable[[int], int] = int
        self._devices: dict[int, I2cDevice] = {}
        self._addressed: I2cDevice | None = None
        self._nacks = 0
        self._estop_open = False
        self._stuck = 0
        self._born_ns = self.now_ns = self.clock.now_ns()
        self._error_ppb = round(clock_error * 1e9)
        self._line_free_ns = 0
        self._coming: deque[tuple[int, int]] = deque()
        self._failure: BaseException | None = None
        self._running = False

        self._library = _load(library or build.made())
        self._environment = _Environment(_I2c(self._i2c), _Edge(self._edge))
        self._outputs = ctypes.create_string_buffer(_ROOM * _OUTPUT.itemsize)
        self._board = self._library.board_open(self._environment, flash, len(flash), serial)
        if not self._board:
            raise MemoryError("The board cannot be created.")
        self._cancel = self.clock.every(QUANTUM_S, self.catch_up)

    def close(self) -> None:
        """Free the board; a second call does nothing."""
        self._cancel()
        board, self._board = self._board, None
        if board:
            self._library.board_close(board)

    # -- for tests --------------------------------------------------------------------------------------------------

    def attach(self, address: int, device: I2cDevice) -> None:
        """Connect a device to the head's I2C bus, with its data-ready pin if it has one."""
        self._devices[address] = device

    def detach(self, address: int) -> I2cDevice:
        """Unplug the device at ``address`` and return it."""
        self.catch_up()
        return self._devices.pop(address)

    def nack(self, count: int = 1) -> None:
        """Leave the next ``count`` addresses without an acknowledge."""
        self.catch_up()
        self._nacks = count

    @property
    def estop_open(self) -> bool:
        return self._estop_open

    @estop_open.setter
    def estop_open(self, is_open: bool) -> None:
        self.catch_up()
        self._estop_open = is_open
        self._library.board_set_estop(self._board, is_open)

    @property
    def stuck(self) -> int:
        """Number of SCL clocks until the sensor releases SDA; 255 or True: never; 0: the bus is free."""
        return self._stuck

    @stuck.setter
    def stuck(self, clocks: int) -> None:
        self.catch_up()
        clocks = 255 if clocks is True else int(clocks)
        self._stuck = clocks
        self._library.board_set_stuck(self._board, clocks)

    def reset(self, cause: Reset) -> None:
        """Restart the board, as after a brown-out, its button or its supply."""
        self.catch_up()
        self._library.board_reset(self._board, cause)
        self._drain()

    def hang(self) -> None:
        """Stop the firmware's main loop, but not its interrupts."""
        self.catch_up()
        self._library.board_hang(self._board, True)

    def pulses(self, pin: str) -> list[tuple[int, float]]:
        """Return the history of ``pin``: times (ns, virtual clock) and values, oldest first."""
        self.catch_up()
        return [(c.time_ns, c.value) for c in self.changes if c.pin == pin]

    # -- serial connection-------------------------------------------------------------------------------------------

    def send(self, data: bytes) -> int:
        """Send the host's bytes to the head; return when the last one arrives (ns)."""
        self.catch_up()
        at_ns = max(self.clock.now_ns(), self._line_free_ns)
        for byte in data:
            at_ns += BYTE_NS
            if (arriving := self._filtered(True, byte)) is not None:
                self._library.board_receive(self._board, self._to_board(at_ns), arriving)
        self._line_free_ns = at_ns
        return at_ns

    def babble(self, data: bytes) -> None:
        """Send ``data`` to the host as if the head had sent it now."""
        self.catch_up()
        now_ns = self.clock.now_ns()
        added = [(now_ns + (i + 1) * BYTE_NS, byte) for i, byte in enumerate(data)]
        self._coming = deque(sorted([*self._coming, *added], key=lambda arriving: arriving[0]))

    def take(self, until_ns: int) -> bytes:
        """Return the bytes that have arrived at the host by ``until_ns``."""
        arrived = bytearray()
        while self._coming and self._coming[0][0] <= until_ns:
            arrived.append(self._coming.popleft()[1])
        return bytes(arrived)

    def arrival_ns(self, count: int) -> int | None:
        """Return when the ``count``-th byte on its way to the host arrives, or the last one; None if there is none."""
        return self._coming[min(count, len(self._coming)) - 1][0] if self._coming else None

    # -- time -------------------------------------------------------------------------------------------------------

    def catch_up(self) -> None:
        """Run the board up to the current time."""
        now_ns = self.clock.now_ns()
        if self._running or self._board is None or now_ns == self.now_ns:
            return
        self._running = True
        try:
            self._library.board_run(self._board, self._to_board(now_ns))
        finally:
            self._running = False
            self.now_ns = now_ns
        if self._failure is not None:
            failure, self._failure = self._failure, None
            raise failure
        self._drain()

    def _to_board(self, world_ns: int) -> int:
        elapsed = world_ns - self._born_ns
        return max(elapsed + elapsed * self._error_ppb // 1_000_000_000, 0)

    def _to_world(self, board_ns: int) -> int:
        return self._born_ns + board_ns - board_ns * self._error_ppb // (1_000_000_000 + self._error_ppb)

    # -- requests and outputs of the board----------------------------------------------------------------------------

    def _i2c(self, board_ns: int, operation: int, data: Any, length: int) -> int:
        try:
            self.now_ns = self._to_world(board_ns)
            return self._transfer(operation, data, length)
        except BaseException as error:  # a C function calls this; catch_up raises the error
            self._failure = error
            return 0

    def _transfer(self, operation: int, data: Any, length: int) -> int:
        device = self._addressed
        if operation in (_START_WRITE, _START_READ):
            self._addressed = device = acknowledging(self._devices, data[0], self._nacks, self.nack_conditions)
            if device is None:
                self._nacks = max(self._nacks - 1, 0)
                return 0
            device.start(operation == _START_READ)
            return 1
        if device is None:
            return 0
        if operation == _WRITE:
            return device.write(bytes(data[:length]))
        if operation == _READ:
            answer = device.read(length)
            ctypes.memmove(data, answer, length)
            return length
        device.stop()
        self._addressed = None
        return 0

    def _edge(self, board_ns: int) -> int:
        try:
            after_ns = self._to_world(board_ns)
            edges = [e for d in self._devices.values() if (e := getattr(d, "next_edge_ns", None)) is not None]
            self.now_ns = after_ns
            times = [t for edge in edges if (t := edge(after_ns)) is not None]
            return max(self._to_board(min(times)), board_ns + 1) if times else _NEVER
        except BaseException as error:
            self._failure = error
            return _NEVER

    def _drain(self) -> None:
        """Collect the board's outputs: bytes to the host and changes of its pins."""
        while taken := self._library.board_take(self._board, self._outputs, _ROOM):
            outputs = np.frombuffer(memoryview(self._outputs), _OUTPUT, taken)
            ns = outputs["ns"].astype(np.int64)
            if self._error_ppb:
                ns -= np.array([t * self._error_ppb // (1_000_000_000 + self._error_ppb) for t in ns.tolist()])
            times = (ns + self._born_ns).tolist()
            for time_ns, event, value in zip(times, outputs["event"].tolist(), outputs["value"].tolist(), strict=True):
                if event == _BYTE:
                    arriving = self._filtered(False, value) if self.filters else value
                    if arriving is not None:
                        self._coming.append((self.held(time_ns), arriving))
                else:
                    self._output(time_ns, event, value)

    def _output(self, time_ns: int, event: int, value: int) -> None:
        if event == _RESET:
            self.resets.append(Reset(value))
            while self._coming and self._coming[-1][0] > time_ns:
                self._coming.pop()
        elif event == _LIGHT:
            self.light = value / 255
            self._changed(PinChange(time_ns, "light", self.light))
        else:
            self.relay_closed = bool(value)
            self._changed(PinChange(time_ns, "relay", value))

    def _changed(self, change: PinChange) -> None:
        self.changes.append(change)
        for listener in self.listeners:
            listener(change)

    def _filtered(self, to_head: bool, byte: int) -> int | None:
        passed: int | None = byte
        for change in self.filters:
            if passed is None:
                return None
            passed = change(to_head, passed)
        return passed


def _load(path: Path) -> Any:
    library = ctypes.CDLL(str(path))
    for name, (result, *arguments) in _INTERFACE.items():
        function = getattr(library, name)
        function.restype, function.argtypes = result, arguments
    if library.board_abi() != ABI:
        raise RuntimeError(f"{path} does not have interface version {ABI}")
    return library


_INTERFACE: dict[str, tuple[Any, ...]] = {
    "board_abi": (c_uint32,),
    "board_open": (c_void_p, _Environment, ctypes.c_char_p, c_uint32, c_uint32),
    "board_run": (None, c_void_p, c_uint64),
    "board_take": (c_uint32, c_void_p, ctypes.c_char_p, c_uint32),
    "board_receive": (None, c_void_p, c_uint64, c_uint8),
    "board_set_estop": (None, c_void_p, c_bool),
    "board_set_stuck": (None, c_void_p, c_uint8),
    "board_reset": (None, c_void_p, c_uint8),
    "board_hang": (None, c_void_p, c_bool),
    "board_close": (None, c_void_p),
}
"""Result and arguments of each function of ``board.h``."""
