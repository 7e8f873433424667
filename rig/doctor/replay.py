"""Replays a trace: against the drivers, with the recorded device at the other end, and against simulated devices.

The drivers must understand the recorded bytes as they did when they were recorded. Simulated devices receive the
recorded requests at their times, and their answers are compared with the recorded ones, register by register.
"""

from collections import Counter, deque
from contextlib import closing, suppress
from dataclasses import dataclass, field
from statistics import median
from typing import Any, Final

from rig.bench.computer import Computer
from rig.config import RigConfig
from rig.core.clock import Clock, SystemClock, seconds_between
from rig.core.errors import RequestRejected, RigError
from rig.devices.dynamixel.bus import DynamixelBus
from rig.devices.dynamixel.packets import PING, READ, WRITE, Packets, Reply
from rig.devices.dynamixel.port import READ_SLICE_S, BusBabble, ClockedPort
from rig.devices.dynamixel.registers import ControlTable, control_table
from rig.devices.head.link import Deframer, HeadStatistics
from rig.devices.i2c import I2cBus
from rig.devices.imu import open_imu
from rig.devices.opencv_camera import OpenCvCamera
from rig.devices.trace import Trace, TraceEvent, camera_notes, imu_notes

# 1°, 6 °/s, 10 % of the torque, 0.5 V, 5 °C: smaller ones show each reading's noise; larger ones hide a wrong model
_ANGLE_DEG, _RATE_DPS = 1.0, 6.0
_TOLERANCES: Final = {
    **dict.fromkeys(("Present Load", "Present Current", "Present PWM"), 100.0),
    **dict.fromkeys(("Present Input Voltage", "Present Voltage", "Present Temperature"), 5.0),
}
"""How much registers may differ that measure something; angles and speeds depend on the model."""
_ANGLES: Final = ("Present Position", "Position Trajectory")
_RATES: Final = ("Present Velocity", "Velocity Trajectory")
_SWITCHING: Final = ("Moving", "Moving Status")
"""Registers that change at a moment: one reading earlier or later is no difference."""
_OF_THE_BUS: Final = ("ID", "Baud Rate", "Secondary ID", "Protocol Type")
_ONLY_WRITTEN: Final = ("Goal", "Profile", "Bus Watchdog", "LED", "Moving Speed", "Torque", "Realtime Tick")
"""Beginnings of the registers that depend on what happened before the trace, until they are written."""
_SET_UP_S: Final = 60.0
"""Longest time in which the simulated servo rotates to the recorded angle."""


class Replay:
    """What a replay has compared; ``reply_ms`` are the times of the servo's replies, recorded and now."""

    def __init__(self) -> None:
        self.reply_ms: list[tuple[float, float]] = []
        self._compared: Counter[str] = Counter()
        self._differing: Counter[str] = Counter()
        self._first: dict[str, str] = {}

    def compare(self, name: str, t_ns: int, recorded: Any, now: Any, tolerance: float = 0.0) -> None:
        """Compare two values of a register or of another field."""
        self._compared[name] += 1
        if recorded != now and not (tolerance and abs(recorded - now) <= tolerance):
            self._differing[name] += 1
            self._first.setdefault(name, f"at {t_ns * 1e-9:.3f} s: recorded {recorded}, now {now}")

    def as_dict(self) -> dict[str, Any]:
        """Return the result as `--json` prints it."""
        times = dict(zip(("recorded", "now"), zip(*self.reply_ms, strict=True), strict=False))
        return {
            "compared": self._compared.total(),
            "differences": [
                f"{name} {first} ({self._differing[name]} of {self._compared[name]} differ)"
                for name, first in self._first.items()
            ],
            "reply_ms": {key: {"median": median(ms), "longest": max(ms)} for key, ms in times.items()},
        }


def replay_drivers(trace: Trace) -> Replay:
    """Let the drivers read the recorded bytes; compare what they understand with what they understood then."""
    result, clock = Replay(), _TraceClock()
    port = _PlayedPort(clock, result)
    bus = DynamixelBus(ClockedPort(port, clock))
    for request in _requests(trace):
        port.request = request
        result.compare("servo reply", request.t_ns, request.reply, _ask(bus, request, 0, result))
    notes = trace.notes("imu")
    if "samples" in notes and trace.config.imu.connection == "i2c":
        clock = _TraceClock()
        sensor, now = _PlayedI2c(clock, trace.of("imu")), {}
        with suppress(RigError, ValueError), closing(open_imu(trace.config.imu, sensor, clock)) as imu:
            now = imu_notes(imu, clock)
        for name in now or notes:
            result.compare(f"imu {name}", clock.now_ns(), notes.get(name), now.get(name))
    # Of a rig head, the frames: a corrupt one is a difference.
    deframer = Deframer(statistics := HeadStatistics())
    for event in trace.of("head"):
        before, _ = statistics.crc_errors + statistics.malformed, list(deframer.feed(event.read or b""))
        result.compare("head corrupt frames", event.t_ns, before, statistics.crc_errors + statistics.malformed)
    return result


def replay_devices(trace: Trace, computer: Computer) -> Replay:
    """Send the recorded requests to simulated devices, and compare their answers with the recorded ones."""
    assert computer.simulated  # no limit of the table holds here
    result, config, clock = Replay(), trace.config, computer.clock
    if requests := _requests(trace):
        with closing(computer.open_serial(config.servo.port, config.servo.baud)) as connection:
            servo = _Servo(DynamixelBus(ClockedPort(connection, clock)), config, requests)
            servo.set_up(clock)
            start_ns = clock.now_ns()
            for request in requests:
                servo.compare(result, request, _ask(servo.bus, request, start_ns, result))
    if registers := [event for event in trace.of("imu") if event.address is not None]:
        with closing(I2cBus(computer.i2c_path(config.imu.bus))) as bus:
            _compare_imu(result, registers, config.imu.address, bus, clock)
    if notes := trace.notes("camera"):
        capture = computer.open_capture(config.camera.source)
        with closing(OpenCvCamera(capture, clock=clock, settings=config.camera)) as camera:
            for name, now in camera_notes(camera).items():
                result.compare(f"camera {name}", 0, notes.get(name), now)
    return result


# -- the servo ----------------------------------------------------------------------------------------------------


@dataclass(slots=True)
class _Request:
    """An instruction to the servo, the bytes that came until the next one, and the reply that was accepted then."""

    t_ns: int
    packet: bytes
    instruction: tuple[int, int, bytes]
    received: list[tuple[int, bytes]] = field(default_factory=list)
    reply: Reply | None = None
    reply_ms: float = 0.0


def _requests(trace: Trace) -> list[_Request]:
    packets = Packets()
    requests: list[_Request] = []
    for event in trace.of("servo"):
        if event.write is not None:
            with suppress(ValueError, IndexError):  # not an instruction
                requests.append(_Request(event.t_ns, event.write, packets.instruction(event.write)))
        elif event.read and requests:
            requests[-1].received.append((event.t_ns, event.read))
        elif event.reply is not None and requests:
            requests[-1].reply, requests[-1].reply_ms = event.reply, (event.t_ns - requests[-1].t_ns) * 1e-6
    return requests


def _ask(bus: DynamixelBus, request: _Request, start_ns: int, result: Replay) -> Reply | None:
    """Send a request at its time after ``start_ns``, and return the reply that the driver accepts."""
    clock = bus.port.clock
    clock.sleep(seconds_between(clock.now_ns(), start_ns + request.t_ns))
    begun_ns = clock.now_ns()
    bus_id, kind, parameters = request.instruction
    reply: Reply | None = None
    with suppress(BusBabble, IndexError):
        size = int.from_bytes(parameters[2:], "little") if kind == READ else 3 * (kind == PING)
        reply = bus.ask(bus_id, kind, parameters, size)[0].get(bus_id)
    bus.port.is_using = False
    if reply is not None and request.reply is not None:
        result.reply_ms.append((request.reply_ms, seconds_between(begun_ns, clock.now_ns()) * 1e3))
    return reply


class _Servo:
    def __init__(self, bus: DynamixelBus, config: RigConfig, requests: list[_Request]) -> None:
        self.bus, self._id = bus, config.servo.id
        self._table: ControlTable = control_table(config.servo.model)
        self._table = control_table(config.servo.model, self._first(requests).get("Firmware Version"))
        self._initial = self._first(requests)
        self._written: set[int] = set()
        self._last: dict[str, tuple[int, int]] = {}
        row = self._table.row
        self._tolerances = _TOLERANCES | dict.fromkeys(_ANGLES, max(_ANGLE_DEG / row.deg_per_count, 1.0))
        self._tolerances |= dict.fromkeys(_RATES, max(_RATE_DPS / row.dps_per_unit, 1.0))

    def set_up(self, clock: Clock) -> None:
        """Give it the recorded settings and angle; what it does not accept shows as a difference later."""
        first, table = self._initial, self._table
        for name in first:
            if table[name].address < table.ram_start and name not in _OF_THE_BUS:
                self._write(name, first[name])
        if (angle := first.get("Present Position")) is not None:
            self._write("Torque Enable", 1)
            self._write("Goal Position", angle)
            end_ns = clock.now_ns() + round(_SET_UP_S * 1e9)
            while abs(self.bus.read(self._id, table["Present Position"]) - angle) > 1 and clock.now_ns() < end_ns:
                clock.sleep(0.1)
            clock.sleep(0.5)  # it comes to rest
            self._write("Torque Enable", 0)

    def compare(self, result: Replay, request: _Request, reply: Reply | None) -> None:
        """Compare its reply to a request with the recorded one."""
        recorded, t_ns = request.reply, request.t_ns
        _, kind, parameters = request.instruction
        if kind == WRITE:
            self._written.add(int.from_bytes(parameters[:2], "little"))
        if recorded is None or reply is None:
            result.compare("servo answer", t_ns, recorded and recorded.data.hex(), reply and reply.data.hex())
            return
        result.compare("servo error", t_ns, (recorded.error, recorded.alert), (reply.error, reply.alert))
        values = self._values(request, reply)
        for name, before in self._values(request, recorded).items():
            if name.startswith(_ONLY_WRITTEN) and self._table[name].address not in self._written:
                continue
            now = values.get(name)
            if now is not None and name in _SWITCHING:
                last, self._last[name] = self._last.get(name, (before, now)), (before, now)
                now = before if now == last[0] or before == last[1] else now
            result.compare(f"servo {name}", t_ns, before, now, 0.0 if now is None else self._tolerances.get(name, 0.0))

    def _first(self, requests: list[_Request]) -> dict[str, int]:
        answered = [(request, request.reply) for request in requests if request.reply is not None]
        return {name: value for one in reversed(answered) for name, value in self._values(*one).items()}

    def _values(self, request: _Request, reply: Reply) -> dict[str, int]:
        """Return the registers in the reply to a read or a ping."""
        _, kind, parameters = request.instruction
        if reply.error or kind not in (READ, PING):
            return {}
        if kind == PING:  # after the Model Number, it reports the firmware, which has another address
            return self._table.decoded(0, reply.data[:2])
        return self._table.decoded(int.from_bytes(parameters[:2], "little"), reply.data)

    def _write(self, name: str, value: int) -> None:
        with suppress(RequestRejected):
            self.bus.write(self._id, self._table[name], value)


class _TraceClock(SystemClock):
    """The time in a trace."""

    time_ns = 0

    def now_ns(self) -> int:
        return self.time_ns

    def sleep(self, seconds: float) -> None:
        self.time_ns += max(round(seconds * 1e9), 0)


class _PlayedPort:
    """A port at whose other end the recorded servo answers each request at its time."""

    baudrate, in_waiting = 57_600, 0  # the recorded times matter, not the rate
    request: _Request

    def __init__(self, clock: _TraceClock, result: Replay) -> None:
        self._clock, self._result = clock, result
        self._coming: deque[tuple[int, bytes]] = deque()

    def read(self, size: int = 1) -> bytes:
        end_ns = self._clock.time_ns + round(READ_SLICE_S * 1e9)
        if not self._coming or self._coming[0][0] > end_ns:
            self._clock.time_ns = end_ns
            return b""
        t_ns, data = self._coming.popleft()
        self._clock.time_ns = max(self._clock.time_ns, t_ns)
        if len(data) > size:
            self._coming.appendleft((t_ns, data[size:]))
        return data[:size]

    def write(self, data: bytes, /) -> int:
        self._result.compare("servo request", self.request.t_ns, self.request.packet.hex(), data.hex())
        self._coming.extend(self.request.received)
        return len(data)

    def reset_input_buffer(self) -> None:
        self._coming.clear()

    def close(self) -> None: ...


# -- the IMU ------------------------------------------------------------------------------------------------------


class _PlayedI2c(I2cBus):
    """A bus on which the recorded sensor answers: each register with its recorded values, in their order."""

    def __init__(self, clock: _TraceClock, events: list[TraceEvent]) -> None:
        self.name, self._clock = "the trace", clock
        self._answers: dict[int | None, deque[TraceEvent]] = {event.address: deque() for event in events}
        for event in events:
            if event.read is not None:
                self._answers[event.address].append(event)

    def read(self, address: int, register: int, count: int) -> bytes:  # noqa: ARG002 - there is one sensor
        event = self._answers[register].popleft() if self._answers.get(register) else None
        if event is None or event.read is None or len(event.read) != count:
            raise OSError(0, "the sensor was asked something else when it was recorded")
        self._clock.time_ns = max(self._clock.time_ns, event.t_ns)
        return event.read

    def write(self, address: int, register: int, values: bytes) -> None: ...

    def close(self) -> None: ...


def _compare_imu(result: Replay, events: list[TraceEvent], address: int, bus: I2cBus, clock: Clock) -> None:
    """Compare the registers that the driver has written, and those that it read before: the identity."""
    start_ns, settings = clock.now_ns(), set[int]()
    for event in events:
        at, now = event.address or 0, b""
        clock.sleep(seconds_between(clock.now_ns(), start_ns + event.t_ns))
        with suppress(OSError, ValueError):
            if event.write is not None:
                settings |= set(range(at, at + len(event.write)))
                bus.write(address, at, event.write)
                continue
            now = bus.read(address, at, len(event.read or b""))
        for number, value in enumerate(event.read or b"", start=at):
            if number in settings or not settings:
                found = now[number - at] if now else None
                result.compare(f"imu register {number:#04x}", event.t_ns, value, found)
