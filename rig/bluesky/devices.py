"""Table, camera and IMU with the protocols of bluesky (`bluesky.protocols`).

Only one thread may use a bench. All devices of a bench share a thread of their own; a status is done when its work is
done.
"""

from collections.abc import Callable, Generator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, ExitStack
from typing import Any, Self

import numpy as np

from rig.bench import Bench
from rig.events.events import Accepted, Event
from rig.motion.turntable import Turntable
from rig.views.capture import Viewer


class WorkStatus:
    """The status of work in the thread of the bench (`bluesky.protocols.Status`)."""

    def __init__(self, future: "Future[Any]") -> None:
        self._future = future

    def add_callback(self, callback: Callable[[Any], None]) -> None:
        self._future.add_done_callback(lambda _: callback(self))

    def exception(self, timeout: float | None = 0.0) -> BaseException | None:
        return self._future.exception(timeout)

    @property
    def done(self) -> bool:
        return self._future.done()

    @property
    def success(self) -> bool:
        return self.done and self._future.exception() is None


class BenchDevices(AbstractContextManager["BenchDevices"]):
    """An open bench with its devices for a RunEngine; the torque is on in the ``with`` block if ``hold`` is set.

    ``hold`` prepares the table at the start: `table` needs it; `enroll` and `identify` prepare it themselves. No other
    thread may use the bench.
    """

    def __init__(self, bench: Bench, *, hold: bool = True) -> None:
        self.bench = bench
        self._hold = hold
        self._worker = ThreadPoolExecutor(1, "bench")
        self._held = ExitStack()
        self.turntable: Turntable | None = None
        self.table = TableDevice(self)
        self.camera = CameraDevice(self)
        self.imu = ImuDevice(self)

    def __enter__(self) -> Self:
        if self._hold:
            self.turntable = self.run(lambda: self._held.enter_context(Turntable(self.bench)))
        return self

    def __exit__(self, *_: object) -> None:
        try:
            self.run(self._held.close)
        finally:
            self._worker.shutdown()

    def run(self, work: Callable[[], Any]) -> Any:
        """Return the result of work in the thread of the bench."""
        return self._worker.submit(work).result()

    def start(self, work: Callable[[], Any]) -> WorkStatus:
        """Start work in the thread of the bench."""
        return WorkStatus(self._worker.submit(work))

    def now_s(self) -> float:
        """Return the civil time in seconds since 1970, for documents."""
        return self.bench.clock.utc().timestamp()

    def provenance(self) -> dict[str, Any]:
        """Return bench, devices and conditions as metadata of a run."""
        plain: dict[str, Any] = self.run(
            lambda: {
                "bench": self.bench.name,
                "devices": self.bench.devices(),
                "conditions": dict(self.bench.conditions),
            }
        )
        return plain


class Device:
    """A device of a bench: its name, and readings of one moment."""

    parent = None

    def __init__(self, devices: BenchDevices, name: str) -> None:
        self.name = name
        self._devices = devices
        self._reading: dict[str, Any] = {}

    def _read(self, values: dict[str, Any]) -> None:
        now = self._devices.now_s()
        self._reading = {f"{self.name}_{key}": {"value": value, "timestamp": now} for key, value in values.items()}

    def read(self) -> dict[str, Any]:
        return self._reading

    def describe(self) -> dict[str, Any]:
        return {key: data_key(self.name, one["value"]) for key, one in self._reading.items()}


def data_key(source: str, value: Any) -> dict[str, Any]:
    """Return the description of a value for documents."""
    kinds = {bool: "boolean", str: "string", int: "integer", float: "number"}
    kind = next((words for type_, words in kinds.items() if isinstance(value, type_)), "array")
    key = {"source": f"rig:{source}", "dtype": kind, "shape": list(np.shape(value)) if kind == "array" else []}
    if isinstance(value, np.ndarray):
        key["dtype_numpy"] = value.dtype.str
    return key


class TableDevice(Device):
    """The table: Movable to an angle in degrees, Stoppable, Readable."""

    def __init__(self, devices: BenchDevices) -> None:
        super().__init__(devices, "table")
        self.hints = {"fields": ["table_encoder_deg"]}

    def set(self, value: float) -> WorkStatus:
        """Rotate the table to an angle; the status has the error of a motion that fails."""
        return self._devices.start(lambda: self._goto(float(value)))

    def _goto(self, angle_deg: float) -> None:
        table = self._devices.turntable
        if table is None:
            raise RuntimeError("the table is not held: open BenchDevices with hold=True")
        move = table.goto(angle_deg)
        gyro = move.gyro
        values = {"commanded_deg": float(move.commanded_deg), "encoder_deg": float(move.encoder_deg)}
        values |= {"imu_rotation_deg": float(gyro.angle_deg) if gyro.valid else float("nan")}
        self._read(values)

    def stop(self, *, success: bool = True) -> None:  # noqa: ARG002 - a stop is a stop
        """Stop the table along its ramp; the torque stays off until the next start."""
        self._devices.bench.state.request_stop()

    def read(self) -> dict[str, Any]:
        if not self._reading:
            table = self._devices.turntable
            angle_deg = float("nan") if table is None else float(self._devices.run(table.angle_deg))
            self._read({"commanded_deg": angle_deg, "encoder_deg": angle_deg, "imu_rotation_deg": float("nan")})
        return self._reading

    def describe(self) -> dict[str, Any]:
        return {key: {**data_key(self.name, one["value"]), "units": "deg"} for key, one in self.read().items()}


class CameraDevice(Device):
    """The camera: `trigger` takes and checks a frame; it is Readable, with the image as an array."""

    def __init__(self, devices: BenchDevices) -> None:
        super().__init__(devices, "camera")

    def trigger(self) -> WorkStatus:
        return self._devices.start(self._capture)

    def _capture(self) -> None:
        bench, table = self._devices.bench, self._devices.turntable
        if table is None:
            raise RuntimeError("the table is not held: open BenchDevices with hold=True")
        viewer = Viewer(bench.camera, bench.config)
        attempts = viewer.attempts(bench.clock.now_ns(), table.check_still, table.collect_gyro)
        attempt = next(one for one in attempts if one.accepted or one.number > bench.config.view.retakes)
        evidence = attempt.evidence
        values = {"image": attempt.image_bgr, "accepted": attempt.accepted, "sharpness": float(evidence.sharpness)}
        self._read(values)


class ImuDevice(Device):
    """The IMU: `trigger` averages its samples since the last one; it is Readable."""

    def __init__(self, devices: BenchDevices) -> None:
        super().__init__(devices, "imu")

    def trigger(self) -> WorkStatus:
        return self._devices.start(self._sample)

    def _sample(self) -> None:
        bench = self._devices.bench
        bench.imu.read_samples()
        bench.clock.sleep(0.1)
        samples = bench.imu.read_samples()
        rate = samples.gyro_dps.mean(axis=0)
        self._read({"rate_dps": rate, "samples": len(samples.time_ns), "lost": int(samples.lost)})


class Steps(Device):
    """A plan of the rig as a device: each `trigger` takes the next view; `finished` is set after the last."""

    def __init__(self, devices: BenchDevices, name: str, events: Generator[Event, None, Any]) -> None:
        super().__init__(devices, name)
        self._events = events
        self.finished = False
        self.last: Event | None = None

    def trigger(self) -> WorkStatus:
        return self._devices.start(self._next)

    def _next(self) -> None:
        for event in self._events:
            self.last = event
            if isinstance(event, Accepted):
                self._read(view_values(event))
                return
        self.finished = True

    def close(self) -> None:
        """End the plan where it is; the table stops and its torque goes off."""
        self._devices.run(self._events.close)


def view_values(event: Accepted) -> dict[str, Any]:
    """Return the values of an accepted view for documents."""
    return {
        "index": int(event.index),
        "azimuth_deg": float(event.azimuth_deg),
        "sharpness": float(event.evidence.sharpness),
    }
