"""Check the computer: the bench's state, ports and permissions, disk and clock."""

import os
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime, timedelta
from typing import Any

from rig.bench.computer import DeviceFile, SerialPort
from rig.core.camera_node import camera_node
from rig.core.json_form import plain
from rig.core.next_steps import Do, NextStep, SomeSteps
from rig.devices.dynamixel.port import GUARDIAN
from rig.doctor.examination import DoctorContext
from rig.doctor.finding import Finding, bad, fine, graded, warning
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
        text = "in use by {holder}: servo, IMU and camera are not checked"
        yield warning("bench_in_use", text, Do.STOP(), holder=who, pid=context.holder.pid)
    state = FileStore(path).load()
    if state.damage:
        what = state.fault.detail if state.fault else state.damage
        fix = (
            *("Check how far the cable is wound up, then", Do.ACKNOWLEDGE(), "If it hangs free,"),
            *(Do.SET_REVOLUTIONS(revolutions=0), "Otherwise, give the revolutions that it is wound up."),
        )
        yield bad("state_damaged", "damaged state: {what}", fix, what=what, damage=state.damage)
    elif state.fault is not None:
        text = "fault {code} ({title}) is latched since {utc}: {detail}"
        yield bad("fault_latched", text, Do.ACKNOWLEDGE(), **plain(state.fault))
    elif context.holder is None:
        yield fine("bench_free", "{bench}: free, no fault latched", bench=context.bench, state=path)


def ports(context: DoctorContext) -> Iterator[Finding]:
    """Check the servo's serial port, the IMU's bus and the camera's device file: present, permitted, free, fast."""
    config, computer = context.config, context.computer
    head = config.imu.connection == "head"
    for wanted in (config.servo.port, config.head.port)[: 1 + head]:
        port = computer.serial_port(wanted)
        if port is None:
            yield _no_serial_port(context, wanted)
            continue
        found = access(context, port, "dialout")
        yield found
        if not found.steps and computer.is_left_to_modem_manager(port):
            text = "ModemManager runs, and sends modem commands to {path} when it is plugged in"
            yield warning("modem_manager", text, udev_command(context), path=port.path)
        if port.latency_ms is not None:
            yield _latency(context, port)
    if not head:
        bus = computer.i2c_name(config.imu.bus)
        yield _device_file(context, "I2C bus", bus, computer.i2c_buses(bus), "i2c", i2c_command(context))
    camera = camera_node(config.camera.source)
    if camera is not None:  # else it is a file or a stream
        connect = "Connect the camera"
        yield _device_file(context, "camera", camera, computer.cameras(), "video", connect)


def _device_file(
    context: DoctorContext, kind: str, wanted: str, nodes: list[DeviceFile], group: str, connect: SomeSteps
) -> Finding:
    """Return whether the device file ``wanted`` is one of ``nodes`` and can be opened."""
    node = next((node for node in nodes if context.computer.same_file(node.path, wanted)), None)
    return _missing(kind, wanted, nodes, connect) if node is None else access(context, node, group)


def _no_serial_port(context: DoctorContext, wanted: str) -> Finding:
    adapters = [port for port in context.computer.serial_ports() if port.usb]
    if not adapters and (program := context.computer.running("brltty")) is not None:
        text = "there is no serial port {wanted}, and brltty (process {pid}) takes USB adapters for itself"
        return bad("brltty_takes_port", text, PORT_GRABBERS["brltty"], wanted=wanted, pid=program.pid)
    return _missing("serial port", wanted, adapters, "Plug the adapter in")


def _missing(kind: str, wanted: str, found: Sequence[DeviceFile], connect: SomeSteps) -> Finding:
    text = "there is no {kind} {wanted} (found: {found})"
    names = [f"{node.path} ({node.name})" for node in found]
    return bad("not_connected", text, Do.SETUP() if found else connect, kind=kind, wanted=wanted, found=names)


def access(context: DoctorContext, node: DeviceFile, usual_group: str) -> Finding:
    """Return whether a device file can be opened: no other program uses it, and the user has permission."""
    # A server that checks its own bench, and the guardian of its port, do not disturb it.
    others = [one for one in node.holders if one.pid != os.getpid() and GUARDIAN not in one.command]
    if others and not (context.holder and context.holder.pid in {process.pid for process in others}):
        command, pid = others[0].command, others[0].pid
        end = next((fix for name, fix in PORT_GRABBERS.items() if name in command), f"kill {pid}")
        return bad("device_file_in_use", "{path} is in use by {holders}", end, path=node.path, holders=others)
    if node.usable:
        return fine("device_file", "{path}: {name}", path=node.path, name=node.name, stable=node.stable)
    user, group = context.computer.user.name, node.group or usual_group
    if group == "root":
        code, why, fix = "root_only", ": only root has access", udev_command(context)
    elif context.computer.joined(group):
        code, why, fix = "group_at_next_login", " before the next login: group {group} is new", f"newgrp {group}"
    else:
        code, fix = "not_in_group", f"sudo usermod -aG {group} {user}"
        why = ": the group {group} has; log in again after this"
    text = f"{{user}} has no permission for {{path}} ({{name}}){why}"
    return bad(code, text, fix, user=user, path=node.path, name=node.name, group=group)


def _latency(context: DoctorContext, port: SerialPort) -> Finding:
    now = {"path": port.path, "latency_ms": port.latency_ms}
    text = "latency timer of {path} is {latency_ms} ms"
    if (port.latency_ms or 0) <= LATENCY_MS:
        return fine("latency", text, **now)
    return warning("high_latency", f"{text}: each reading waits for it", udev_command(context), **now)


def disk(context: DoctorContext) -> Iterator[Finding]:
    """Check the free space for views, and that the disk is local."""
    path = context.config.catalog_path(context.bench)
    there, user = context.computer.disk(path), context.computer.user.name
    views = there.free_bytes // VIEW_BYTES
    free: dict[str, Any] = {
        "free_gb": there.free_bytes / 1e9,
        "path": path,
        "objects": views // context.config.enroll.views,
    }
    is_bad, is_warning = there.free_bytes < TOO_LITTLE_ROOM, there.free_bytes < LITTLE_ROOM
    text = "{free_gb:.1f} GB free for {path}: about {objects} more objects"
    yield graded("free_space", text, Do.REMOVE_DELETED(), is_bad=is_bad, is_warning=is_warning, **free)
    if not there.writable:
        fix: str | NextStep = Do.SET_KEY(key="catalog.path", value="FOLDER")
        fix = f"sudo chown -R {user} {path}" if path.exists() else fix
        yield bad("not_writable", "{user} may not write to {path}", fix, user=user, path=path)
    if there.network:
        fix = Do.SET_KEY(key="catalog.path", value="FOLDER-ON-A-LOCAL-DISK")
        yield warning("network_disk", "{path} is on a network file system, where locks may fail", fix, path=path)


def clock(context: DoctorContext) -> Iterator[Finding]:
    """Check that the civil time is right."""
    now, synchronised = context.computer.clock.utc(), context.computer.time_synchronised()
    set_time, date = "sudo timedatectl set-ntp true", "{utc:%Y-%m-%d %H:%M} UTC"
    if now < _OLDEST_UTC or now > _OLDEST_UTC + timedelta(days=365 * 50):
        yield bad("wrong_date", f"the date is wrong: {date}: stored data would have a wrong date", set_time, utc=now)
    elif synchronised:
        yield fine("synchronized", f"{date}, synchronised by a time server", utc=now)
    else:
        text = f"{date}, but no time server is known to have been reached since this computer started"
        yield warning("not_synchronized", text, set_time, utc=now)


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
