"""A trace: what a bench exchanges with its devices, recorded so that it can be replayed without them.

It is a text file of JSON Lines: a `TraceHeader`, then a `TraceEvent` in each line. `TraceWriter` writes it, and
`TracedSerial` and `TracedI2c` stand between a driver and its device. docs/how-to/record-your-hardware.md describes it.
"""

import errno
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from rig.config import RigConfig
from rig.config.values import validate
from rig.core.clock import Clock
from rig.core.errors import UsageError, os_errors_as
from rig.core.files import read
from rig.core.json_form import plain
from rig.core.next_steps import Do
from rig.devices.camera import Camera
from rig.devices.dynamixel.packets import Reply
from rig.devices.dynamixel.port import SerialConnection
from rig.devices.i2c import I2cBus
from rig.devices.imu import Imu

MAX_BYTES: Final = 64_000_000  # hours of a moving table
_SECTIONS: Final = ("servo", "table", "imu", "head", "camera")
_PLACES: Final = ("port", "bus", "source")
"""Keys that say where a device is connected: they can contain serial numbers and passwords, and help no other bench."""
_BURSTS, _BURST_S = 10, 0.1

Device = Literal["servo", "imu", "head", "camera"]


class _Line(BaseModel):
    model_config = ConfigDict(val_json_bytes="hex", ser_json_bytes="hex", allow_inf_nan=False)


class TraceHeader(_Line):
    """The first line: the version of the format, who recorded it, and the configuration of the devices."""

    trace: Literal[1]
    software: str
    utc: str
    bench: str
    config: dict[str, dict[str, Any]]


class TraceEvent(_Line):
    """What happened at a time, in nanoseconds since the beginning.

    ``write`` and ``read`` are bytes: on a port, or of the IMU from a register ``address`` on. ``baud`` is set on the
    port. ``reply`` is a status packet that the servo's driver accepted. ``notes`` are facts about a device.
    """

    t_ns: int = Field(ge=0, lt=10**14)  # a day
    on: Device
    baud: int | None = None
    write: bytes | None = None
    read: bytes | None = None
    reply: Reply | None = None
    address: int | None = Field(None, ge=0, le=255)
    notes: dict[str, Any] | None = None


@dataclass(frozen=True, slots=True)
class Trace:
    """The content of a trace. ``is_cut``: its last line is incomplete, because the recording was interrupted."""

    header: TraceHeader
    config: RigConfig
    events: tuple[TraceEvent, ...]
    is_cut: bool

    def of(self, device: Device) -> list[TraceEvent]:
        """Return the events of a device; of a trace that was cut, without a last request whose answer is missing."""
        events = [event for event in self.events if event.on == device]
        while self.is_cut and events and (events[-1].write is not None or (device == "servo" and not events[-1].reply)):
            events.pop()
        return events

    def notes(self, device: Device) -> dict[str, Any]:
        """Return all notes about a device."""
        return {key: value for event in self.of(device) for key, value in (event.notes or {}).items()}


def read_trace(path: Path) -> Trace:
    """Read a trace.

    Raises `UsageError`: it cannot be read, or a line is wrong. `ConfigError`: its configuration has mistakes.
    """
    with os_errors_as(UsageError, f"The trace {path} cannot be read.", next_step="Check the name of the file."):
        *lines, rest = read(path, max_bytes=MAX_BYTES).split(b"\n")
    kind: type[_Line] = TraceHeader
    parsed: list[Any] = []
    for number, line in enumerate(lines or [rest], start=1):
        try:
            parsed.append(kind.model_validate_json(line))
        except ValidationError as error:
            problem = error.errors(include_url=False, include_input=False, include_context=False)[0]
            raise UsageError(
                f"{path} is no trace that this program can read: its line {number} is wrong.",
                next_step=("Restore the file as it was recorded, or", Do.RECORD_TRACE()),
                evidence={"key": ".".join(map(str, problem["loc"])), "reason": problem["msg"]},
            ) from error
        kind = TraceEvent
    header, *events = parsed
    config = validate(RigConfig, _without_places(header.config), where=str(path))
    # The thread that feeds a rig head may write a line a little late.
    return Trace(header, config, tuple(sorted(events, key=lambda event: event.t_ns)), is_cut=bool(rest))


def _without_places(config: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    return {name: {k: v for k, v in config.get(name, {}).items() if k not in _PLACES} for name in _SECTIONS}


class TraceWriter:
    """Writes a trace. Each line is complete on its own, so that a killed program leaves a readable file.

    A full disk ends the trace but not the work of the bench; `close` then raises `UsageError`.

    Raises `UsageError`: the file exists, or cannot be written.
    """

    def __init__(self, path: Path, clock: Clock, bench: str, config: RigConfig) -> None:
        self._clock, self._start_ns = clock, clock.now_ns()
        self._failure: OSError | None = None
        self._what = f"The trace {path} cannot be written."
        with os_errors_as(UsageError, self._what, next_step="Give a new file in a folder that exists."):
            self._file = path.open("xb", buffering=0)
        about = {"software": f"hbr-rig {version('hbr-rig')}", "utc": clock.utc().isoformat(timespec="seconds")}
        whole = _without_places(config.model_dump(mode="json", include=set(_SECTIONS)))
        self._line(TraceHeader(trace=1, **about, bench=bench, config=whole))

    def note(self, device: Device, **values: Any) -> None:
        """Write an event of now."""
        self._line(TraceEvent.model_construct(t_ns=self._clock.now_ns() - self._start_ns, on=device, **values))

    def close(self) -> None:
        """Wait until the trace is on the disk."""
        with os_errors_as(UsageError, self._what, next_step=Do.FREE_DISK()), self._file as file:
            if self._failure is not None:
                raise self._failure
            os.fsync(file.fileno())

    def _line(self, line: _Line) -> None:
        content = line.model_dump_json(exclude_none=True).encode() + b"\n"
        try:
            if self._failure is None and self._file.write(content) != len(content):
                self._failure = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        except OSError as error:
            self._failure = error


class TracedSerial:
    """An open port whose bytes go into a trace."""

    def __init__(self, connection: SerialConnection, trace: TraceWriter, device: Device) -> None:
        self._connection, self._trace, self._device = connection, trace, device
        self.close = connection.close
        trace.note(device, baud=connection.baudrate)

    @property
    def baudrate(self) -> int:
        return self._connection.baudrate

    @baudrate.setter
    def baudrate(self, baud: int) -> None:
        self._connection.baudrate = baud
        self._trace.note(self._device, baud=baud)

    @property
    def in_waiting(self) -> int:
        return self._connection.in_waiting

    def read(self, size: int = 1) -> bytes:
        if data := self._connection.read(size):
            self._trace.note(self._device, read=data)
        return data

    def write(self, data: bytes, /) -> int | None:
        self._trace.note(self._device, write=bytes(data))
        return self._connection.write(data)

    def reset_input_buffer(self) -> None:
        self.read(self.in_waiting)  # what the driver drops has also been received
        self._connection.reset_input_buffer()

    def accepted(self, reply: Reply) -> None:
        """Note a reply that the driver has found in the bytes."""
        self._trace.note(self._device, reply=reply)


class TracedI2c(I2cBus):
    """An I2C bus whose registers go into a trace."""

    def __init__(self, bus: int | str, trace: TraceWriter) -> None:
        super().__init__(bus)
        self._trace = trace

    def read(self, address: int, register: int, count: int) -> bytes:
        data = super().read(address, register, count)
        self._trace.note("imu", address=register, read=data)
        return data

    def write(self, address: int, register: int, values: bytes) -> None:
        super().write(address, register, values)
        self._trace.note("imu", address=register, write=values)


def imu_notes(imu: Imu, clock: Clock) -> dict[str, Any]:
    """Read samples for a second, and everything else once; return their numbers."""
    parts = []
    for _ in range(_BURSTS):
        clock.sleep(_BURST_S)
        parts.append(imu.read_samples().gyro_dps)
    rates = np.concatenate(parts)
    vectors = {"mean_dps": rates.mean(axis=0), "noise_dps": rates.std(axis=0)} if len(rates) else {}
    vectors["gravity_g"] = imu.read_gravity_g()
    numbers = {name: [round(float(one), 6) for one in vector] for name, vector in vectors.items()}
    return {"samples": len(rates), **numbers, "temperature_c": round(imu.temperature_c(), 6)}


def camera_notes(camera: Camera) -> dict[str, Any]:
    """Return the modes, the controls and the settings that a camera reports."""
    offered = {name: plain(getattr(camera, name, ())) for name in ("modes", "controls")}
    return {**offered, **asdict(camera.read_locks())}
