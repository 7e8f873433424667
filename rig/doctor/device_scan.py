"""Find the devices that are connected to the computer, and their settings for the configuration."""

from collections.abc import Generator, Iterator
from contextlib import closing
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import serial

from rig.bench.computer import DeviceFile, SerialPort
from rig.config import CameraConfig
from rig.config.imus import imu_kind, recognised
from rig.config.toml_file import Key
from rig.core.errors import DeviceNotFound, RigError
from rig.devices.head.head import open_head
from rig.devices.head.protocol import BAUD
from rig.devices.opencv_capture import modes_of
from rig.devices.picamera2_capture import import_picamera2
from rig.devices.v4l2 import VideoMode, choose_mode
from rig.doctor.bus_scan import (
    BAUD_RATES,
    BaudScan,
    FoundImu,
    FoundServo,
    scan_imus,
    scan_rates,
    unusable_address,
    use_another_imu,
)
from rig.doctor.computer import access, i2c_command
from rig.doctor.context import DoctorContext
from rig.doctor.examination import Check
from rig.doctor.finding import Finding, FindingCode, Severity, of_error
from rig.doctor.servo import duplicate_id


@dataclass(frozen=True, slots=True)
class FoundCamera:
    """A camera that opened, its default mode, and the modes that it offers."""

    node: DeviceFile
    width: int
    height: int
    fps: float
    modes: tuple[VideoMode, ...] = ()


@dataclass
class DeviceScan:
    """A scan of all ports, buses and cameras, and the devices found."""

    ports: tuple[str, ...] | None = None
    """Serial ports to scan; None: all on USB, and the configured one."""
    servos: list[tuple[SerialPort, FoundServo]] = field(default_factory=list)
    imus: list[FoundImu] = field(default_factory=list)
    cameras: list[FoundCamera] = field(default_factory=list)
    ribbons: list[int] = field(default_factory=list)
    """Numbers of the cameras on ribbon cables."""
    heads: list[tuple[SerialPort, str]] = field(default_factory=list)
    """Ports of rig heads, with the `imu.model` of their sensors."""
    duplicate_ids: bool = False
    """Two servos with the same id were found."""

    @property
    def settings(self) -> dict[Key, Any]:
        """The settings of the unambiguous devices: those of which exactly one was found."""
        wanted: dict[Key, Any] = {}
        for what, found in self.candidates.items():
            if len(found) == 1 and not (what == "servo" and self.duplicate_ids):
                wanted |= found[0]
        return wanted

    @property
    def candidates(self) -> dict[str, list[dict[Key, Any]]]:
        """The settings of each device found that the rig can use, by what it may be."""
        servos: list[dict[Key, Any]] = [
            _keys("servo", port=port.stable or port.path, baud=found.baud, id=found.bus_id, model=found.model)
            for port, found in self.servos
        ]
        imus: list[dict[Key, Any]] = [
            _keys("imu", model=found.driver, bus=_number_or(found.bus, "/dev/i2c-"), address=found.address)
            for found in self.imus
        ]
        heads: list[dict[Key, Any]] = [
            _keys("imu", connection="head", model=model) | _keys("head", port=port.stable or port.path)
            for port, model in self.heads
        ]
        cameras = [camera_settings(one) for one in self.cameras]
        ribbons: list[dict[Key, Any]] = [_keys("camera", source=f"picamera2:{number}") for number in self.ribbons]
        return {"servo": servos, "IMU": imus + heads, "camera": cameras + ribbons}

    @property
    def checks(self) -> tuple[Check, ...]:
        return (
            Check("servo", self.find_servos, deadline_s=90.0),
            Check("imu", self.find_imus),
            Check("camera", self.find_cameras, deadline_s=20.0),
        )

    def find_servos(self, context: DoctorContext) -> Iterator[Finding | str]:
        known = context.computer.serial_ports()
        configured = context.computer.serial_port(context.config.servo.port)
        if configured is not None and not any(context.computer.same_file(port.path, configured.path) for port in known):
            known.append(configured)
        if self.ports is not None:
            known = [port for port in known if port.path in self.ports]
        asked = [p for p in known if p.usb or context.computer.same_file(p.path, context.config.servo.port)]
        if not asked:
            yield FindingCode.NO_USB_PORT(found=[port.path for port in known])
        for port in asked:
            yield from self._on_port(context, port)

    def _on_port(self, context: DoctorContext, port: SerialPort) -> Iterator[Finding | str]:
        """Scan a port for servos, then for a rig head."""
        if problems := [finding for finding in access(context, port, "dialout") if finding.fix]:
            yield from problems
            return
        known_head = context.config.imu.connection == "head" and context.computer.same_file(
            port.path, context.config.head.port
        )
        try:
            servos = False if known_head else (yield from self._servos(context, port))
            head = False if servos else (yield from self._head(context, port))
        except DeviceNotFound as error:
            yield of_error(error)
        except (serial.SerialException, OSError) as error:
            yield FindingCode.PORT_FAILED(port=port.path, reason=str(error))
        else:
            if not (servos or head or self.duplicate_ids):
                yield FindingCode.NOTHING_ON_PORT(port=port.path, name=port.name)

    def _servos(self, context: DoctorContext, port: SerialPort) -> Generator[Finding | str, None, bool]:
        with closing(context.computer.open_serial(port.path, BAUD_RATES[0])) as wire:
            answered = yield from scan_rates(context, wire, BAUD_RATES, port.path)
        for scan in answered:
            yield from self._found(port, scan)
        return any(scan.answered for scan in answered)

    def _head(
        self, context: DoctorContext, port: SerialPort, model: str | None = None
    ) -> Generator[Finding | str, None, bool]:
        yield f"{port.path}: searching for a rig head ..."
        imu = context.config.imu.model_copy(update={"model": model or context.config.imu.model})
        head_config = context.config.head.model_copy(update={"port": port.path})
        config = context.config.model_copy(update={"head": head_config, "imu": imu})
        try:
            with closing(
                open_head(config, lambda: context.computer.open_serial(port.path, BAUD), context.computer.clock)
            ) as head:
                who = head.identity
        except DeviceNotFound:
            return False
        except RigError as error:  # a rig head with an error
            other = recognised(imu.address, imu_kind(imu.model).register, error.evidence.get("got", -1))
            if model is None and other is not None and other.driver:
                return (yield from self._head(context, port, other.key))
            yield replace(of_error(error), topic="imu")
            return True
        self.heads.append((port, imu.model))
        parts = {"model": who.model, "board": who.board, "firmware": who.firmware}
        yield replace(FindingCode.HEAD(port=port.path, **parts), topic="imu")
        return True

    def _found(self, port: SerialPort, scan: BaudScan) -> Iterator[Finding]:
        for found in scan.servos:
            place = {"port": port.path, "id": found.bus_id, "baud": found.baud}
            if found.obstacle:
                reason, fix = found.obstacle
                yield FindingCode.SERVO_NOT_DRIVEN(fix, found=found, reason=reason, **place)
                continue
            self.servos.append((port, found))
            yield FindingCode.SERVO_FOUND(found=found, **place)
        if scan.duplicate_ids:
            self.duplicate_ids = True
            yield duplicate_id(port.path, scan)
        if scan.noise:
            yield FindingCode.FOREIGN_BYTES(port=port.path, baud=scan.baud)

    def find_imus(self, context: DoctorContext) -> Iterator[Finding | str]:
        asked = 0
        before = len(self.imus)
        for node in context.computer.i2c_buses(context.config.imu.bus):
            asked += 1
            if problems := [finding for finding in access(context, node, "i2c") if finding.fix]:
                yield from problems
                continue
            yield f"{node.path}: searching for IMUs ..."
            try:
                there = scan_imus(context.computer, node.path)
            except OSError as error:
                yield FindingCode.I2C_NOT_OPENED(bus=node.path, reason=error.strerror)
                continue
            failures = {found.errno for found in there if found.errno}
            for found in there:
                if (problem := unusable_address(found)) is not None:
                    if not found.errno or found.errno in failures:  # a failing bus is reported once
                        yield problem
                    failures.discard(found.errno)
                elif found.driver:
                    self.imus.append(found)
                    yield FindingCode.IMU_FOUND(found=found, bus=found.bus, address=found.address)
                else:
                    level = Severity.WARNING
                    yield FindingCode.NO_DRIVER(use_another_imu(), level, found=found, address=found.address)
        if not asked and not self.heads:
            yield FindingCode.NO_I2C(i2c_command(context))
        elif len(self.imus) == before and not self.heads:
            yield FindingCode.NO_IMU_FOUND()

    def find_cameras(self, context: DoctorContext) -> Iterator[Finding | str]:
        nodes = context.computer.cameras()
        ribbons = context.computer.ribbon_cameras()
        for number, name in enumerate(ribbons):
            self.ribbons.append(number)
            yield ribbon_camera(name, number)
        if not nodes and not ribbons:
            yield FindingCode.NO_CAMERA()
        for node in nodes:
            if problems := [finding for finding in access(context, node, "video") if finding.fix]:
                yield from problems
                continue
            yield f"{node.path}: opening ..."
            try:
                capture = context.computer.open_capture(node.path)
            except DeviceNotFound as error:
                yield of_error(error)
                continue
            width, height = (round(capture.get(p)) for p in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
            found = FoundCamera(node, width, height, capture.get(cv2.CAP_PROP_FPS), modes_of(capture))
            capture.release()
            self.cameras.append(found)
            mode = {"path": node.path, "width": width, "height": height, "fps": found.fps}
            yield FindingCode.CAMERA(name=f"{node.path}: {node.name}", **mode)


def ribbon_camera(name: str, number: int) -> Finding:
    """Return how a camera on the ribbon cable of a Raspberry Pi is reached."""
    place = {"name": name, "number": number}
    try:
        import_picamera2()
    except DeviceNotFound as error:
        parameters = place | {"what": error.what.rstrip("."), **error.evidence}
        return FindingCode.RIBBON_CAMERA_UNREACHABLE(error.steps, **parameters)
    return FindingCode.RIBBON_CAMERA(**place)


def camera_settings(found: FoundCamera) -> dict[Key, Any]:
    """Return the settings of this camera, by key; its number may change after a restart.

    The mode is the offered one that is nearest to the default.
    """
    settings: dict[str, Any] = {"source": found.node.stable or _number_or(found.node.path, "/dev/video")}
    usual = CameraConfig()
    mode = choose_mode(found.modes, usual.width, usual.height, usual.fps)
    if mode is not None and (mode.width, mode.height) != (usual.width, usual.height):
        settings |= {"width": mode.width, "height": mode.height}
    if mode is not None and 0 < mode.fps < 0.9 * usual.fps:
        settings["fps"] = round(mode.fps, 3)
    return _keys("camera", **settings)


def _keys(section: str, **values: Any) -> dict[Key, Any]:
    return {(section, name): value for name, value in values.items()}


def _number_or(path: str, beginning: str) -> int | str:
    """Return the number of a device file, or its path if it is not named by a number."""
    number = path.removeprefix(beginning)
    return int(number) if number.isdigit() else path
