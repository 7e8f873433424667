"""Check the computer: the bench's state, ports and permissions, disk and clock."""

import os
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta

from rig.bench.computer import DeviceFile, SerialPort
from rig.core.camera_node import camera_node
from rig.core.json_form import plain
from rig.core.next_steps import Do, SomeSteps
from rig.devices.dynamixel.port import GUARDIAN
from rig.doctor.context import DoctorContext
from rig.doctor.finding import Finding, FindingCode, graded
from rig.safety.saved_state import FileStore

LATENCY_MS = 1  # required latency timer of an FTDI adapter; the default is 16, and each reading waits for it

VIEW_BYTES = 500_000  # an image of 640x480 with a sensor's noise, lossless
LITTLE_ROOM, TOO_LITTLE_ROOM = 2_000_000_000, 200_000_000

# older than this program: a computer without a clock chip starts in 1970 or at its last shutdown
_OLDEST_UTC = datetime(2025, 1, 1, tzinfo=UTC)

PORT_GRABBERS = {
    "ModemManager": "sudo systemctl disable --now ModemManager",
    "brltty": "sudo apt remove brltty",
}
"""Programs of a desktop that open every new serial port, and how to stop them."""

RULES_FILES = ("/etc/udev/rules.d/60-hbr-rig.rules", "/etc/udev/rules.d/99-hbr-rig.rules")
"""Two files with the same rules. Access and ModemManager need rules before those of other programs, brltty after
them."""


def bench_state(context: DoctorContext) -> Iterator[Finding]:
    """Check whether the bench is in use, whether a fault is latched, and whether the state file is damaged."""
    path = context.config.state_path(context.bench)
    if context.holder is not None:
        who = f"process {context.holder.pid} ({context.holder.command})" if context.holder.pid else "another process"
        yield FindingCode.BENCH_IN_USE(holder=who, pid=context.holder.pid)
    state = FileStore(path).load()
    if state.damage:
        what = state.fault.detail if state.fault else state.damage
        yield FindingCode.STATE_DAMAGED(what=what, damage=state.damage)
    elif state.fault is not None:
        yield FindingCode.FAULT_LATCHED(**plain(state.fault))
    if context.holder is None and not state.damage and state.fault is None:
        yield FindingCode.BENCH_FREE(bench=context.bench, state=path)


def ports(context: DoctorContext) -> Iterator[Finding]:
    """Check the servo's serial port, the IMU's bus and the camera's device file: present, permitted, free, fast."""
    head = context.config.imu.connection == "head"
    for key, wanted in (("servo.port", context.config.servo.port), ("head.port", context.config.head.port))[: 1 + head]:
        port = context.computer.serial_port(wanted)
        if port is None:
            yield _missing(context, key, wanted, context.computer.serial_ports())
            continue
        findings = list(access(context, port, "dialout"))
        yield from findings
        if not any(one.fix for one in findings) and context.computer.is_left_to_modem_manager(port):
            yield FindingCode.MODEM_MANAGER(udev_command(context), path=port.path)
        if port.latency_ms is not None:
            yield _latency(context, port)
    if not head:
        yield from _i2c(context)
    yield from _video(context)


def _i2c(context: DoctorContext) -> Iterator[Finding]:
    bus = context.computer.i2c_name(context.config.imu.bus)
    buses = context.computer.i2c_buses(bus)
    node = next((n for n in buses if context.computer.same_file(n.path, bus)), None)
    if node is not None:
        yield from access(context, node, "i2c")
    elif buses:
        fix = Do.SET_KEY(key="imu.bus", value=buses[0].path.removeprefix("/dev/i2c-"))
        yield FindingCode.NO_I2C_BUS(fix, wanted=bus, found=_names(buses))
    else:
        yield FindingCode.NO_I2C_BUS(i2c_command(context), wanted=bus, found=[])


def _video(context: DoctorContext) -> Iterator[Finding]:
    camera = camera_node(context.config.camera.source)
    if camera is None:
        return  # a file or a stream
    cameras = context.computer.cameras()
    node = next((n for n in cameras if context.computer.same_file(n.path, camera)), None)
    if node is not None:
        yield from access(context, node, "video")
    else:
        fix: SomeSteps = ("Connect the camera, then", Do.FIND())
        if cameras:
            fix = Do.SET_KEY(key="camera.source", value=cameras[0].stable or cameras[0].path)
        yield FindingCode.NO_CAMERA_DEVICE(fix, wanted=camera, found=_names(cameras))


def disk(context: DoctorContext) -> Iterator[Finding]:
    """Check the free space for views, and that the disk is local."""
    path = context.catalog_path
    there = context.computer.disk(path)
    views = there.free_bytes // VIEW_BYTES
    free = {"free_gb": there.free_bytes / 1e9, "path": path, "objects": views // context.config.enroll.views}
    level = graded(bad=there.free_bytes < TOO_LITTLE_ROOM, warning=there.free_bytes < LITTLE_ROOM)
    yield FindingCode.FREE_SPACE((), level, **free)
    if not there.writable:
        fix: SomeSteps = (
            f"sudo chown -R {context.computer.user.name} {path}"
            if path.exists()
            else Do.SET_KEY(key="catalog.path", value="FOLDER")
        )
        yield FindingCode.NOT_WRITABLE(fix, user=context.computer.user.name, path=path)
    if there.network:
        yield FindingCode.NETWORK_DISK(path=path)


def clock(context: DoctorContext) -> Iterator[Finding]:
    """Check that the civil time is right."""
    now, synchronised = context.computer.clock.utc(), context.computer.time_synchronised()
    if now < _OLDEST_UTC or now > _OLDEST_UTC + timedelta(days=365 * 50):
        yield FindingCode.WRONG_DATE(utc=now)
    elif synchronised:
        yield FindingCode.SYNCHRONIZED(utc=now)
    else:
        code = FindingCode.NO_TIME_SERVER if synchronised is None else FindingCode.NOT_SYNCHRONIZED
        yield code(utc=now)


def udev_rules(ports_found: list[SerialPort]) -> str:
    """Return udev rules: a short latency, a permanent name, access for the logged-in user, no ModemManager, no brltty.

    brltty's rule (85-brltty.rules) starts it for many USB adapters by ``SYSTEMD_WANTS``; a later rule cancels that.
    """
    lines = [
        "# Made by `rig doctor --udev`, for two files:",
        *(f"# {file}" for file in RULES_FILES),
        f'ACTION=="add", SUBSYSTEM=="usb-serial", DRIVER=="ftdi_sio", ATTR{{latency_timer}}="{LATENCY_MS}"',
    ]
    named = False
    for port in ports_found:
        if not port.usb.get("idVendor"):
            continue
        keys = {key: port.usb[key] for key in ("idVendor", "idProduct", "serial") if port.usb.get(key)}
        link = "" if named or "serial" not in keys else ', SYMLINK+="rig-servo"'
        named = named or bool(link)
        of_port = "".join(f'ATTRS{{{key}}}=="{value}", ' for key, value in keys.items())
        of_device = "".join(f'ATTR{{{key}}}=="{value}", ' for key, value in keys.items())
        lines.append(
            f'SUBSYSTEM=="tty", {of_port}GROUP="dialout", MODE="0660", TAG+="uaccess", '
            f'ENV{{ID_MM_PORT_IGNORE}}="1"{link}'
        )
        lines.append(
            f'SUBSYSTEM=="usb", ENV{{DEVTYPE}}=="usb_device", {of_device}ENV{{ID_MM_DEVICE_IGNORE}}="1", '
            'ENV{BRLTTY_BRAILLE_DRIVER}="", ENV{SYSTEMD_WANTS}=""'
        )
    lines.append('SUBSYSTEM=="i2c-dev", GROUP="i2c", MODE="0660", TAG+="uaccess"')
    lines.append('SUBSYSTEM=="video4linux", GROUP="video", MODE="0660", TAG+="uaccess"')
    return "\n".join(lines) + "\n"


def udev_command(context: DoctorContext) -> str:
    """Return the command that installs the rules."""
    return (
        f"{context.step(Do.UDEV_RULES()).command} | sudo tee {' '.join(RULES_FILES)} && "
        "sudo udevadm control --reload && sudo udevadm trigger --action=add"
    )


def i2c_command(context: DoctorContext) -> str:
    """Return the command that enables the computer's I2C buses."""
    return "sudo raspi-config nonint do_i2c 0" if "Raspberry" in context.computer.model else "sudo modprobe i2c-dev"


def _missing(context: DoctorContext, key: str, wanted: str, found: list[SerialPort]) -> Finding:
    fix: SomeSteps
    match [port for port in found if port.usb]:
        case [] if (program := context.computer.running("brltty")) is not None:
            fix = PORT_GRABBERS["brltty"]
            return FindingCode.BRLTTY_TAKES_PORT(fix, wanted=wanted, pid=program.pid)
        case []:
            fix = ("Plug the adapter in, then", Do.FIND())
        case [one]:
            fix = Do.SET_KEY(key=key, value=one.stable or one.path)
        case _:
            fix = Do.SETUP()
    return FindingCode.NO_SERIAL_PORT(fix, wanted=wanted, found=_names(found))


def access(context: DoctorContext, node: DeviceFile, usual_group: str) -> Iterator[Finding]:
    """Check that a device file can be opened: no other program uses it, and the user has permission."""
    # A server that checks its own bench, and the guardian of its port, do not disturb it.
    others = [one for one in node.holders if one.pid != os.getpid() and GUARDIAN not in one.command]
    if others and not (context.holder and context.holder.pid in {process.pid for process in others}):
        command = others[0].command
        fix: SomeSteps = next((fix for name, fix in PORT_GRABBERS.items() if name in command), f"kill {others[0].pid}")
        yield FindingCode.DEVICE_FILE_IN_USE(fix, path=node.path, holders=others)
        return
    if node.usable:
        yield FindingCode.DEVICE_FILE(path=node.path, name=node.name, stable=node.stable)
        return
    user, group = context.computer.user.name, node.group or usual_group
    if group == "root":
        code, fix = FindingCode.ROOT_ONLY, udev_command(context)
    elif context.computer.joined(group):
        code, fix = FindingCode.GROUP_AT_NEXT_LOGIN, f"newgrp {group}"
    else:
        code, fix = FindingCode.NOT_IN_GROUP, f"sudo usermod -aG {group} {user}"
    yield code(fix, user=user, path=node.path, name=node.name, group=group)


def _latency(context: DoctorContext, port: SerialPort) -> Finding:
    now = {"path": port.path, "latency_ms": port.latency_ms}
    if port.latency_ms is None or port.latency_ms <= LATENCY_MS:
        return FindingCode.LATENCY(**now)
    fix, permanently = f"echo {LATENCY_MS} | sudo tee {port.latency_file}", context.step(Do.UDEV_RULES()).command
    return FindingCode.HIGH_LATENCY(fix, permanently=permanently, **now)


def _names(nodes: list[DeviceFile] | list[SerialPort]) -> list[str]:
    return [f"{node.path} ({node.name})" for node in nodes]
