"""The bench with real devices: servo on a serial port, IMU on I2C or a rig head, camera through OpenCV.

Decision: docs/decisions/0001.
"""

import json
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from typing import Any

from pydantic import BaseModel

from rig.bench import Bench, BenchKind
from rig.bench.computer import Computer
from rig.config import CameraConfig, RigConfig, Section
from rig.config.imus import imu_kind
from rig.core.clock import Clock, SystemClock
from rig.core.errors import ConfigError, DeviceMismatch, RigError, StateNotStored
from rig.core.masking import masked
from rig.core.phrases import angle_range
from rig.devices.camera import Camera, Capture
from rig.devices.dynamixel.guardian import Guardian
from rig.devices.dynamixel.port import SerialConnection
from rig.devices.dynamixel.servo import open_servo
from rig.devices.head.head import RigHead, open_head, powered
from rig.devices.head.protocol import BAUD
from rig.devices.imu import Imu, open_imu
from rig.devices.opencv_camera import OpenCvCamera
from rig.devices.servo import Servo
from rig.devices.trace import Device, TracedI2c, TracedSerial, TraceWriter
from rig.safety.saved_state import BenchLock, FileStore, StateStore


class NoOptions(Section):
    """The real bench has no options: [servo], [table], [imu] and [camera] describe it."""


class HardwareBench(BenchKind):
    """Opens the devices in the configuration. State, calibrations and catalog belong to its name."""

    name = "hardware"
    options: type[BaseModel] = NoOptions

    def open(self, config: RigConfig, options: Any, seed: int | None) -> Bench:
        """Open the devices on the system's clock; ``seed`` is not used."""
        clock, state_path = SystemClock(), config.state_path(self.name)
        with ExitStack() as connections:
            connections.callback(BenchLock(state_path, clock).close)
            computer = connections.enter_context(self.computer(config, options, seed))
            computer.require_unused(config.servo.port)
            guardian = Guardian(config.servo.port, config.servo.baud, config.servo.model, config.servo.id)
            bench = assemble(self.name, config, clock, computer, state=FileStore(state_path), guardian=guardian)
            bench.connections = connections.pop_all()
            return bench

    @contextmanager
    def open_servo(self, config: RigConfig, options: Any, seed: int | None) -> Iterator[Servo]:
        """Open only the servo, even if the disk cannot be written, because it must be possible to stop it."""
        clock = SystemClock()
        with ExitStack() as connections:
            with suppress(StateNotStored):  # BenchBusy is not suppressed: another program then stops its own bench
                connections.callback(BenchLock(config.state_path(self.name), clock).close)
            computer = connections.enter_context(self.computer(config, options, seed))
            connections.enter_context(
                powered(config, lambda: computer.open_serial(config.head.port, BAUD, "head"), clock)
            )
            connection = computer.open_serial(config.servo.port, config.servo.baud)
            connections.callback(connection.close)
            yield open_servo(connection, config.servo, clock, config.table.mode)


def assemble(
    name: str,
    config: RigConfig,
    clock: Clock,
    computer: Computer,
    *,
    state: StateStore,
    guardian: Guardian | None = None,
) -> Bench:
    """Open the drivers on a real or a simulated computer; IMU and camera at their first use.

    Nothing moves, and the torque stays as it is. `Bench.safety` then knows whether the table may move.

    Raises `DeviceNotFound`, `DeviceMismatch`, `DeviceSilent`: a device is missing, is another one, or does not answer.
    `ConfigError`: the servo does not support the configuration, or does not reach the table's limits.
    """
    with ExitStack() as opened:
        trace: TraceWriter | None = None
        if config.trace is not None:
            trace = TraceWriter(config.trace, clock, name, config)
            opened.callback(trace.close)

        def traced(port: SerialConnection, device: Device = "servo") -> SerialConnection:
            return port if trace is None else TracedSerial(port, trace, device)

        def servo_port() -> SerialConnection:
            return computer.open_serial(config.servo.port, config.servo.baud)

        # Open the rig head and the servo.
        connection = servo_port()  # before anything is switched on: another program may use it
        opened.callback(connection.close)
        head: RigHead | None = None
        fault: RigError | None = None
        if config.imu.connection == "head":
            head = open_head(
                config, lambda: traced(computer.open_serial(config.head.port, BAUD, "head"), "head"), clock
            )
            opened.callback(head.close)
            fault = head.switch_on(config.head)  # first, because the servo's supply may go through it
        servo = open_servo(
            traced(connection), config.servo, clock, config.table.mode, lambda: traced(servo_port()), guardian
        )
        findings = servo.prepare(write=config.servo.write_settings)
        _check_reach(config, servo)
        if note := imu_kind(config.imu.model).note:
            findings += (f"imu: {note}",)

        # IMU and camera are opened at their first use, unless the head is the IMU.
        def open_sensor() -> Imu:
            if head is not None:
                return head
            i2c_bus = computer.i2c_path(config.imu.bus)
            return open_imu(config.imu, i2c_bus if trace is None else TracedI2c(i2c_bus, trace), clock)

        def open_camera() -> Camera:
            plug = CameraPlug(computer, config.camera.source)
            with ExitStack() as failed:
                source = plug.open()
                failed.callback(source.release)
                camera = OpenCvCamera(
                    source,
                    clock=clock,
                    settings=camera_settings(config, state, plug.device),
                    name=f"camera {masked(config.camera.source)}",
                    device=plug.device,
                    reopen=plug.open,
                    node=plug.node,
                )
                failed.pop_all()
            if config.camera.focus is None:
                store_focus(state, plug.device, camera.read_locks().focus)
            bench.findings += tuple(
                f"camera: {n.setting} was set to {n.asked}, but the camera reports {n.reported}"
                for n in camera.rejected_settings
            )
            return camera

        # Connect the safety layer with the devices: what the head does by itself must stop and latch the bench, too.
        bench = Bench(name, config, clock, servo, open_sensor, open_camera, findings=findings, state=state, head=head)
        bench.trace = trace
        bench.safety.connect()
        if head is not None:
            watched = head
            bench.open_devices(("imu",))
            bench.safety.monitors.append(watched.check)
            bench.safety.restore_actions.append(lambda: watched.switch_on(config.head))
        if fault is not None:
            bench.safety.latch(fault)
        bench.safety.acknowledge_checks.append(lambda: bench.imu.read_samples())
        bench.findings += bench.safety.findings
        opened.pop_all()
    return bench


class CameraPlug:
    """The camera of a source. It keeps its identity when it is plugged in again, and may get another number.

    ``device`` identifies the camera (`Computer.camera_device`), once it was opened.
    """

    def __init__(self, computer: Computer, source: int | str) -> None:
        self._computer = computer
        self._source = self._here = source
        self._opened = False
        self.device: str | None = None

    def open(self) -> Capture:
        """Open the camera. Raises DeviceNotFound, and DeviceMismatch if the source is another camera now."""
        # The first camera of the source is the bench's camera.
        if not self._opened:
            capture = self._computer.open_capture(self._source)
            self._opened, self.device = True, self._computer.camera_device(self._source)
            return capture
        # Later, only this one.
        self._here = self._found()
        capture = self._computer.open_capture(self._here)
        now = self._computer.camera_device(self._here)
        if now != self.device:
            capture.release()
            raise DeviceMismatch(
                f"The camera {self._source} is another one after it was unplugged.",
                next_step="Connect the first camera again, or start again with this one.",
                evidence={"before": self.device, "now": now},
            )
        return capture

    def node(self) -> object:
        """Return the identity of the camera's device file now; None if there is none."""
        return self._computer.device_node(self._here)

    def _found(self) -> int | str:
        """Return the camera's present source, because its number changes while a program holds the old file."""
        if self.device is None or self._computer.camera_device(self._source) == self.device:
            return self._source
        paths = (node.path for node in self._computer.cameras())
        return next((path for path in paths if self._computer.camera_device(path) == self.device), self._source)


_FOCUS_FILE = "camera-focus.json"


def camera_settings(config: RigConfig, state: StateStore, device: str | None) -> CameraConfig:
    """Return the camera's settings: the configured ones, and the focus that an earlier program has found."""
    settings = config.camera
    if settings.focus is not None:
        return settings
    # Of this camera only: another lens is sharp at another number.
    try:
        stored = json.loads(state.read_file(_FOCUS_FILE) or b"{}")
        focus = float(stored["focus"]) if stored["device"] == device else None
    except (StateNotStored, ValueError, KeyError, TypeError):  # none yet, or damaged: the autofocus settles again
        return settings
    return settings.model_copy(update={"focus": focus})


def store_focus(state: StateStore, device: str | None, focus: float | None) -> None:
    """Store the focus for the next program, because a camera forgets it without power."""
    text = json.dumps({"device": device, "focus": focus}).encode()
    with suppress(StateNotStored):  # other writes report a full disk
        if focus is not None and state.read_file(_FOCUS_FILE) != text:
            state.store_file(_FOCUS_FILE, text)


def _check_reach(config: RigConfig, servo: Servo) -> None:
    """Raise `ConfigError` if the table's limits exceed the servo's reach."""
    table, (low, high) = config.table, servo.reach_deg
    first, last = sorted(table.direction * limit + table.zero_deg for limit in table.limits_deg)
    # A count of tolerance at each end: limits of whole revolutions are no multiples of it.
    if low - servo.resolution_deg <= first and last <= high + servo.resolution_deg:
        return
    reached = sorted(table.direction * (end - table.zero_deg) for end in (low, high))
    raise ConfigError(
        f"The servo reaches {angle_range((low, high), 0)}, but the table's limits need "
        f"{angle_range((first, last), 0)}.",
        next_step=f"Set table.limits_deg within [{reached[0]:.0f}, {reached[1]:.0f}], or set table.zero_deg, the "
        "servo's angle at home, to the middle of its reach.",
        evidence={"limits_deg": list(table.limits_deg), "zero_deg": table.zero_deg, "reach_deg": [low, high]},
    )


HARDWARE: BenchKind = HardwareBench()
