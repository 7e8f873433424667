"""Find the devices that are connected to the computer, and their settings for the configuration."""

from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import replace
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
from rig.devices.picamera2_capture import import_picamera2
from rig.devices.v4l2 import VideoMode, choose_mode
from rig.doctor.computer import access, i2c_command
from rig.doctor.examination import Check, DoctorContext
from rig.doctor.finding import Finding, Severity, bad, fine, of_error, warning
from rig.doctor.imu import FoundImu, not_opened, rig_head, scan_imus, unusable
from rig.doctor.servo import duplicate_id, foreign_bytes
from rig.doctor.servo_scan import BAUD_RATES, scan_servos

DeviceSettings = dict[Key, Any]


class DeviceScan:
    """A scan of all ports, buses and cameras, in three checks.

    ``candidates`` are the settings of each device found that the rig can use, by what it may be.
    """

    def __init__(self) -> None:
        self.candidates: dict[str, list[DeviceSettings]] = {"servo": [], "IMU": [], "camera": []}
        self._has_head = False
        self._has_duplicate_ids = False
        self.checks = (
            Check("servo", self.find_servos, deadline_s=90.0),
            Check("imu", self.find_imus),
            Check("camera", self.find_cameras, deadline_s=20.0),
        )

    @property
    def settings(self) -> DeviceSettings:
        """The settings of the unambiguous devices: those of which exactly one was found."""
        wanted: DeviceSettings = {}
        for what, found in self.candidates.items():
            if len(found) == 1 and not (what == "servo" and self._has_duplicate_ids):
                wanted |= found[0]
        return wanted

    def find_servos(self, context: DoctorContext) -> Iterator[Finding]:
        """Scan the serial ports on USB, and the configured one, for servos and rig heads."""
        computer, configured = context.computer, context.config.servo.port
        known = computer.serial_ports()
        port = computer.serial_port(configured)
        if port is not None and not any(computer.same_file(other.path, port.path) for other in known):
            known.append(port)
        asked = [port for port in known if port.usb or computer.same_file(port.path, configured)]
        if not asked:
            fix = "Connect the U2D2"
            yield bad("no_usb_port", "no serial port on USB (found: {found})", fix, found=[port.path for port in known])
        for port in asked:
            yield from self._on_port(context, port)

    def _on_port(self, context: DoctorContext, port: SerialPort) -> Iterator[Finding]:
        if (problem := access(context, port, "dialout")).steps:
            yield problem
            return
        # A known head is not asked for servos. Another one sends all the time, which is noise at any baud rate.
        config = context.config
        is_head = config.imu.connection == "head" and context.computer.same_file(port.path, config.head.port)
        try:
            servos, noise = ([], []) if is_head else self._servos(context, port)
            found = servos + noise if servos else self._head(context, port) or noise
        except DeviceNotFound as error:
            yield of_error(error)
        except (serial.SerialException, OSError) as error:
            fix = "Connect the adapter again"
            yield bad("port_failed", "{port} failed: {reason}", fix, port=port.path, reason=str(error))
        else:
            yield from found
            if not found:
                text = "{port} ({name}): no servo and no rig head answer at any baud rate"
                fix = "Check the servo's cable and switch on its supply"
                yield warning("nothing_on_port", text, fix, port=port.path, name=port.name)

    def _servos(self, context: DoctorContext, port: SerialPort) -> tuple[list[Finding], list[Finding]]:
        """Return which servos answer at a port, and at which baud rates there is noise."""
        with closing(context.computer.open_serial(port.path, BAUD_RATES[0])) as wire:
            scans = scan_servos(wire, context.computer.clock, preferred=context.config.servo.baud)
        findings = []
        for found in (servo for scan in scans for servo in scan.servos):
            place = {"port": port.path, "id": found.bus_id, "baud": found.baud}
            if found.obstacle:
                reason, fix = found.obstacle
                text = "{port}: {found}: the rig cannot drive it: {reason}"
                findings.append(warning("servo_not_driven", text, fix, found=found, reason=reason, **place))
                continue
            own = _keys("servo", port=port.stable or port.path, baud=found.baud, id=found.bus_id, model=found.model)
            self.candidates["servo"].append(own)
            findings.append(fine("servo_found", "{port}: {found}", found=found, **place))
        self._has_duplicate_ids |= any(scan.duplicate_ids for scan in scans)
        findings += [duplicate_id(port.path, scan) for scan in scans if scan.duplicate_ids]
        return findings, [foreign_bytes(port.path, scan) for scan in scans if scan.noise]

    def _head(self, context: DoctorContext, port: SerialPort, model: str | None = None) -> list[Finding]:
        """Return what a rig head at a port says; nothing if there is none.

        A head reports an error if its sensor is another than ``model`` or the configured one: then that is tried.
        """
        imu = context.config.imu.model_copy(update={"model": model or context.config.imu.model})
        place = context.config.head.model_copy(update={"port": port.path})
        config, computer = context.config.model_copy(update={"head": place, "imu": imu}), context.computer
        try:
            with closing(open_head(config, lambda: computer.open_serial(port.path, BAUD), computer.clock)) as head:
                found = rig_head(head, port.path)
        except DeviceNotFound:
            return []
        except RigError as error:
            other = recognised(imu.address, imu_kind(imu.model).register, error.evidence.get("got", -1))
            if model is None and other is not None and other.driver:
                return self._head(context, port, other.key)
            found = of_error(error)
        else:
            own = _keys("imu", connection="head", model=imu.model)
            self.candidates["IMU"].append(own | _keys("head", port=port.stable or port.path))
            self._has_head = True
        return [replace(found, topic="imu")]

    def find_imus(self, context: DoctorContext) -> Iterator[Finding]:
        """Scan the I2C buses for IMUs."""
        nodes = context.computer.i2c_buses(context.config.imu.bus)
        before = len(self.candidates["IMU"])
        for node in nodes:
            if (problem := access(context, node, "i2c")).steps:
                yield problem
                continue
            try:
                there = scan_imus(context.computer, node.path)
            except OSError as error:
                yield not_opened(node.path, error)
                continue
            reported = set()
            for found in there:
                if (reason := unusable(context.computer, found)) is None:
                    self.candidates["IMU"].append(imu_settings(found))
                    yield fine("imu_found", "{found}", found=found, bus=found.bus, address=found.address)
                elif reason.code == "no_driver":  # it may be a clock beside the sensor
                    yield replace(reason, level=Severity.WARNING)
                elif reason.code not in reported:
                    yield reason
                # A bus that fails does so at each address, and is reported once.
                reported |= {reason.code} if reason and reason.code.startswith("i2c") else set()
        if not nodes and not self._has_head:
            yield bad("no_i2c", "no I2C bus", i2c_command(context))
        elif len(self.candidates["IMU"]) == before and not self._has_head:
            fix = "Check the sensor's 3.3 V, ground, SDA and SCL"
            yield warning("no_imu_found", "no IMU answers on any I2C bus", fix)

    def find_cameras(self, context: DoctorContext) -> Iterator[Finding]:
        """Find the cameras on USB and on ribbon cables."""
        nodes, ribbons = context.computer.cameras(), context.computer.ribbon_cameras()
        for number, name in enumerate(ribbons):
            self.candidates["camera"].append(_keys("camera", source=f"picamera2:{number}"))
            yield ribbon_camera(name, number)
        if not nodes and not ribbons:
            yield warning("no_camera", "no camera", "Connect the camera")
        for node in nodes:
            if (problem := access(context, node, "video")).steps:
                yield problem
                continue
            try:
                capture = context.computer.open_capture(node.path)
            except DeviceNotFound as error:
                yield of_error(error)
                continue
            # Its mode before anyone sets one, and what it offers.
            width, height = (round(capture.get(p)) for p in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
            fps, modes = capture.get(cv2.CAP_PROP_FPS), capture.modes()
            capture.release()
            self.candidates["camera"].append(camera_settings(node, modes))
            text = "{path}: {name}: {width}x{height} at {fps:.3g} frames/s"
            yield fine("camera", text, path=node.path, name=node.name, width=width, height=height, fps=fps)


def ribbon_camera(name: str, number: int) -> Finding:
    """Return how a camera on the ribbon cable of a Raspberry Pi is reached."""
    text, place = "{name} on the ribbon cable", {"name": name, "number": number}
    try:
        import_picamera2()
    except DeviceNotFound as error:
        why = place | {"what": error.what.rstrip("."), **error.evidence}
        return warning("ribbon_camera_unreachable", text + ": {what}: {reason}", error.steps, **why)
    return fine("ribbon_camera", text + ": camera.source is picamera2:{number}", **place)


def imu_settings(found: FoundImu) -> DeviceSettings:
    """Return the settings of this IMU, by key."""
    return _keys("imu", model=found.driver, bus=_number_or(found.bus, "/dev/i2c-"), address=found.address)


def camera_settings(node: DeviceFile, modes: Sequence[VideoMode] = ()) -> DeviceSettings:
    """Return the settings of this camera, by key; its number may change after a restart.

    The mode is the offered one that is nearest to the default.
    """
    settings: dict[str, Any] = {"source": node.stable or _number_or(node.path, "/dev/video")}
    usual = CameraConfig()
    mode = choose_mode(modes, usual.width, usual.height, usual.fps)
    if mode is not None and (mode.width, mode.height) != (usual.width, usual.height):
        settings |= {"width": mode.width, "height": mode.height}
    if mode is not None and 0 < mode.fps < 0.9 * usual.fps:
        settings["fps"] = round(mode.fps, 3)
    return _keys("camera", **settings)


def _keys(section: str, **values: Any) -> DeviceSettings:
    return {(section, name): value for name, value in values.items()}


def _number_or(path: str, beginning: str) -> int | str:
    """Return the number of a device file, or its path if it is not named by a number."""
    number = path.removeprefix(beginning)
    return int(number) if number.isdigit() else path
