"""Check the computer: the bench's state, ports and permissions, disk and clock."""

from collections.abc import Iterator
from datetime import UTC, datetime, timedelta

from rig.bench.computer import DeviceFile, SerialPort
from rig.core.clock import seconds_between
from rig.doctor.context import DoctorContext
from rig.doctor.finding import Finding, bad, fine, warning
from rig.safety.saved_state import FileStore

LATENCY_MS = 1  # required latency timer of an FTDI adapter; the default is 16, and each reading waits for it

VIEW_BYTES = 500_000  # an image of 640x480 with a sensor's noise, lossless
LITTLE_ROOM, TOO_LITTLE_ROOM = 2_000_000_000, 200_000_000

_PAUSE_S, _PAUSE_ERROR_S = 0.02, 0.25
_STEP_S = 0.5
_OLDEST_UTC = datetime(2025, 1, 1, tzinfo=UTC)

RULES_FILE = "/etc/udev/rules.d/60-hbr-rig.rules"


def bench_state(context: DoctorContext) -> Iterator[Finding]:
    """Check whether the bench is in use, whether a fault is latched, and whether the state file is damaged."""
    path = context.config.state_path(context.bench)
    if context.holder is not None:
        who = f"process {context.holder.pid} ({context.holder.command})" if context.holder.pid else "another process"
        text = f"in use by {who}: servo, IMU and camera are not checked"
        yield warning("bench", text, context.rig("stop"), pid=context.holder.pid)
    state = FileStore(path).load()
    if state.damage:
        yield bad(
            "bench",
            state.fault.what if state.fault else state.damage,
            "Check how far the cable is wound up, then: "
            f"{context.rig('acknowledge')} and {context.rig('home --turns N')}",
            exit_code=5,
            damage=state.damage,
        )
    elif state.fault is not None:
        fault = state.fault
        text = f"fault {fault.code} ({fault.title}) is latched since {fault.utc}: {fault.what}"
        yield bad("bench", text, context.rig("acknowledge"), exit_code=5, code=fault.code, next_step=fault.next_step)
    if context.holder is None and not state.damage and state.fault is None:
        yield fine("bench", f"{context.bench}: free, no fault latched", state=str(path))


def ports(context: DoctorContext) -> Iterator[Finding]:
    """Check the servo's serial port, the IMU's bus and the camera's device file: present, permitted, free, fast."""
    head = context.config.imu.connection == "head"
    for key, wanted in (("servo.port", context.config.servo.port), ("head.port", context.config.head.port))[: 1 + head]:
        port = context.computer.serial_port(wanted)
        if port is None:
            yield _missing(context, key, wanted, context.computer.serial_ports())
            continue
        yield from access(context, "port", port, "dialout")
        if port.latency_ms is not None:
            yield _latency(context, port)
    if not head:
        yield from _i2c(context)
    yield from _video(context)


def _i2c(context: DoctorContext) -> Iterator[Finding]:
    bus = context.computer.i2c_name(context.config.imu.bus)
    buses = context.computer.i2c_buses()
    node = next((n for n in buses if context.computer.same_file(n.path, bus)), None)
    if node is not None:
        yield from access(context, "port", node, "i2c")
    elif buses:
        fix = context.set("imu.bus", buses[0].path.removeprefix("/dev/i2c-"))
        yield bad("port", f"there is no I2C bus {bus}; there is {_names(buses)}", fix)
    else:
        yield bad("port", f"there is no I2C bus (configured: {bus})", i2c_command(context))


def _video(context: DoctorContext) -> Iterator[Finding]:
    source = context.config.camera.source
    if isinstance(source, str) and not source.isdigit() and not source.startswith("/dev/"):
        return  # a file or a stream
    camera = f"/dev/video{source}" if str(source).isdigit() else str(source)
    cameras = context.computer.cameras()
    node = next((n for n in cameras if context.computer.same_file(n.path, camera)), None)
    if node is not None:
        yield from access(context, "port", node, "video")
    elif cameras:
        yield bad(
            "port",
            f"there is no camera {camera}; there is {_names(cameras)}",
            context.set("camera.source", cameras[0].stable or cameras[0].path),
        )
    else:
        yield bad(
            "port", f"there is no camera (configured: {camera})", "Connect the camera, then: " + context.rig("find")
        )


def disk(context: DoctorContext) -> Iterator[Finding]:
    """Check the free space for views, and that the disk is local."""
    path = context.catalog_path
    there = context.computer.disk(path)
    views = there.free_bytes // VIEW_BYTES
    text = f"{there.free_bytes / 1e9:.1f} GB free for {path}: about {views // context.config.enroll.views} more objects"
    if there.free_bytes < TOO_LITTLE_ROOM:
        yield bad("disk", text, context.rig("catalog gc"), exit_code=7, free_bytes=there.free_bytes)
    elif there.free_bytes < LITTLE_ROOM:
        yield warning("disk", text, context.rig("catalog gc"), free_bytes=there.free_bytes)
    else:
        yield fine("disk", text, free_bytes=there.free_bytes)
    if not there.writable:
        fix = (
            f"sudo chown -R {context.computer.user.name} {path}"
            if path.exists()
            else context.set("catalog.path", "FOLDER")
        )
        yield bad("disk", f"{context.computer.user.name} may not write to {path}", fix, exit_code=7)
    if there.network:
        fix = context.set("catalog.path", "FOLDER-ON-A-LOCAL-DISK")
        yield warning("disk", f"{path} is on a network file system, where locks may fail", fix)


def clock(context: DoctorContext) -> Iterator[Finding]:
    """Check the pace of the monotonic clock, and that the civil time is right."""
    time = context.computer.clock
    start_ns, start_utc = time.now_ns(), time.utc()
    time.sleep(_PAUSE_S)
    passed_s = seconds_between(start_ns, time.now_ns())
    civil_s = (time.utc() - start_utc).total_seconds()
    if not _PAUSE_S * 0.9 <= passed_s <= _PAUSE_S + _PAUSE_ERROR_S:
        text = (
            f"a pause of {1e3 * _PAUSE_S:.0f} ms took {1e3 * passed_s:.0f} ms: this computer is overloaded, or suspends"
        )
        yield warning("clock", text, "Close other programs and switch power saving off, then: " + context.rig("doctor"))
    else:
        yield fine("clock", f"a pause of {1e3 * _PAUSE_S:.0f} ms took {1e3 * passed_s:.1f} ms", pause_s=passed_s)
    now = time.utc()
    synchronised = context.computer.time_synchronised()
    fix = "sudo timedatectl set-ntp true"
    if abs(civil_s - passed_s) > _STEP_S:
        yield warning("clock", f"the civil time jumped by {civil_s - passed_s:+.1f} s during the check", fix)
    elif now < _OLDEST_UTC or now > _OLDEST_UTC + timedelta(days=365 * 50):
        yield bad("clock", f"the date is wrong: {now:%Y-%m-%d %H:%M} UTC: stored data would have a wrong date", fix, 1)
    elif synchronised is False:
        text = f"{now:%Y-%m-%d %H:%M} UTC, but no time server has been reached since this computer started"
        yield warning("clock", text, fix)
    elif synchronised is None:
        yield warning("clock", f"{now:%Y-%m-%d %H:%M} UTC, no time server that is known here", fix)
    else:
        yield fine("clock", f"{now:%Y-%m-%d %H:%M} UTC, synchronized by a time server")


def udev_rules(ports_found: list[SerialPort]) -> str:
    """Return udev rules: a short latency, a permanent name for the adapter, and access for the logged-in user."""
    lines = [
        f"# {RULES_FILE}: made by `rig doctor --udev`",
        f'ACTION=="add", SUBSYSTEM=="usb-serial", DRIVER=="ftdi_sio", ATTR{{latency_timer}}="{LATENCY_MS}"',
    ]
    named = False
    for port in ports_found:
        if port.usb.get("serial"):
            link = "" if named else ', SYMLINK+="rig-servo"'
            named = True
            lines.append(
                f'SUBSYSTEM=="tty", ATTRS{{idVendor}}=="{port.usb["idVendor"]}", '
                f'ATTRS{{idProduct}}=="{port.usb.get("idProduct", "")}", ATTRS{{serial}}=="{port.usb["serial"]}", '
                f'GROUP="dialout", MODE="0660", TAG+="uaccess"{link}'
            )
    lines.append('SUBSYSTEM=="i2c-dev", GROUP="i2c", MODE="0660", TAG+="uaccess"')
    lines.append('SUBSYSTEM=="video4linux", GROUP="video", MODE="0660", TAG+="uaccess"')
    return "\n".join(lines) + "\n"


def udev_command(context: DoctorContext) -> str:
    """Return the command that installs the rules."""
    return (
        f"{context.rig('doctor --udev')} | sudo tee {RULES_FILE} && "
        "sudo udevadm control --reload && sudo udevadm trigger --action=add"
    )


def i2c_command(context: DoctorContext) -> str:
    """Return the command that enables the computer's I2C buses."""
    return "sudo raspi-config nonint do_i2c 0" if "Raspberry" in context.computer.model else "sudo modprobe i2c-dev"


def _missing(context: DoctorContext, key: str, wanted: str, found: list[SerialPort]) -> Finding:
    usb = [port for port in found if port.usb]
    if not usb:
        fix = "Plug the adapter in, then: " + context.rig("find")
        return bad("port", f"there is no serial port on USB (configured: {wanted})", fix)
    fix = context.set(key, usb[0].stable or usb[0].path) if len(usb) == 1 else context.rig("setup")
    return bad("port", f"there is no serial port {wanted}; there is {_names(found)}", fix)


def access(context: DoctorContext, topic: str, node: DeviceFile, usual_group: str) -> Iterator[Finding]:
    """Check that a device file can be opened: no other program uses it, and the user has permission."""
    if node.holders:
        who = " and ".join(map(str, node.holders))
        if not (context.holder and context.holder.pid in {process.pid for process in node.holders}):
            modem = "ModemManager" in node.holders[0].command
            fix = "sudo systemctl disable --now ModemManager" if modem else f"kill {node.holders[0].pid}"
            yield bad(topic, f"{node.path} is in use by {who}", fix, holders=who)
            return
    if node.usable:
        yield fine(topic, f"{node.path}: {node.name}" + (f" ({node.stable})" if node.stable else ""))
        return
    group = node.group or usual_group
    text = f"{context.computer.user.name} has no permission for {node.path} ({node.name})"
    if group == "root":
        yield bad(topic, f"{text}: only root has access", udev_command(context))
    elif context.computer.joined(group):
        yield bad(
            topic, f"{text} yet: the membership in group {group} takes effect at the next login", f"newgrp {group}"
        )
    else:
        fix = f"sudo usermod -aG {group} {context.computer.user.name}"
        yield bad(topic, f"{text}: the group {group} has; log in again after this", fix, group=group)


def _latency(context: DoctorContext, port: SerialPort) -> Finding:
    text = f"latency timer of {port.path} is {port.latency_ms} ms"
    if port.latency_ms is None or port.latency_ms <= LATENCY_MS:
        return fine("port", text, latency_ms=port.latency_ms)
    return warning(
        "port",
        f"{text}: each reading waits for it, set {LATENCY_MS} ms (permanently: {context.rig('doctor --udev')})",
        f"echo {LATENCY_MS} | sudo tee {port.latency_file}",
        latency_ms=port.latency_ms,
    )


def _names(nodes: list[DeviceFile] | list[SerialPort]) -> str:
    return ", ".join(f"{node.path} ({node.name})" for node in nodes)
