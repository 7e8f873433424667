"""The computer of a bench: its ports, buses and cameras, the programs that use them, and the user's permissions.

Everything is read from Linux files (sysfs, /proc, /etc) below a root folder, so that a simulated bench or a test can
provide its own computer. Devices are opened by the same functions as for a bench.

Decision: docs/decisions/0008.
"""

import grp
import os
import pwd
import re
import shutil
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rig.core.camera_node import camera_node
from rig.core.clock import Clock, SystemClock
from rig.core.errors import BenchBusy

if TYPE_CHECKING:
    from rig.devices.camera import Capture
    from rig.devices.dynamixel.port import SerialConnection

SERIAL_NAMES = re.compile(r"tty(USB|ACM|AMA|S)\d+")
_CAMERAS = "sys/class/video4linux"
_COMPUTERS_OWN = re.compile(r"smbus|i915|nvidia|amdgpu|radeon|gmbus|aux|ddc|hdmi|\bdp\b", re.IGNORECASE)
"""I2C buses of memory, monitors and clock chips, which must not be scanned."""
_CONVERTERS = re.compile(r"bcm2835-(isp|codec)|pispbe|hevc", re.IGNORECASE)
"""Video devices of a Raspberry Pi that convert images; some claim to capture."""
_RAW_RECEIVERS = re.compile(r"unicam|rp1-cfe", re.IGNORECASE)
"""Receivers of ribbon cables: they deliver raw values of the sensor, which OpenCV cannot develop."""
_SENSORS = re.compile(r"((?:imx|ov|gc|s5k|hm|arducam)[\w-]*) \d+-[0-9a-f]{4}")
"""Names of the sensors' own nodes (v4l-subdev), with their I2C bus and address."""
_NETWORK_FILE_SYSTEMS = frozenset({"nfs", "nfs4", "cifs", "smb3", "smbfs", "sshfs", "fuse.sshfs", "9p", "afs"})


@dataclass(frozen=True, slots=True)
class Process:
    """A program that has a device open."""

    pid: int
    command: str

    def __str__(self) -> str:
        return f"process {self.pid} ({self.command})"


@dataclass(frozen=True, slots=True)
class DeviceFile:
    """A device file, and its properties that are known without opening it.

    ``stable`` is its name that stays the same after replugging, ``group`` its user group. ``usable`` says whether this
    user may open it. ``holders`` are the programs that have it open, as far as this user may see them.
    """

    path: str
    name: str
    stable: str | None
    group: str
    usable: bool
    holders: tuple[Process, ...]


@dataclass(frozen=True, slots=True)
class SerialPort(DeviceFile):
    """A serial port; ``latency_ms`` is the adapter's latency timer, None if it has none."""

    latency_ms: int | None
    usb: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class User:
    """The user of this program; ``gids`` are the groups of this login."""

    name: str
    uid: int
    gids: frozenset[int]

    @classmethod
    def current(cls) -> "User":
        uid = os.geteuid()
        try:
            name = pwd.getpwuid(uid).pw_name
        except KeyError:
            name = str(uid)
        return cls(name, uid, frozenset({os.getegid(), *os.getgroups()}))


@dataclass(frozen=True, slots=True)
class Disk:
    """The disk of a folder: whether it is on the network, and whether this user may write."""

    free_bytes: int
    network: bool
    writable: bool = True


@dataclass
class Computer:
    """A computer with Linux, described by its files below ``root``; default: the computer that runs the program.

    It finds and opens devices. ``simulated`` says whether they are simulated.
    """

    root: Path = Path("/")
    clock: Clock = field(default_factory=SystemClock)
    user: User = field(default_factory=User.current)
    simulated: bool = False

    @property
    def model(self) -> str:
        """The computer's model; empty if it is not known."""
        return self._text("/proc/device-tree/model") or self._text("/sys/class/dmi/id/product_name")

    def serial_ports(self) -> list[SerialPort]:
        """Return the ports that are connected to hardware; the computer's own come last."""
        # sysfs lists every terminal; a port of an adapter has a device.
        ports = []
        for entry in self._entries("sys/class/tty"):
            device = entry / "device"
            if not SERIAL_NAMES.fullmatch(entry.name) or not device.exists():
                continue
            if entry.name.startswith("ttyS") and device.resolve().parent.name.startswith("serial8250"):
                continue  # reserved by the kernel, without hardware
            latency = self._text(f"/sys/bus/usb-serial/devices/{entry.name}/latency_timer")
            usb = self._usb(device)
            name = " ".join(usb[key] for key in ("manufacturer", "product") if usb.get(key)) or "serial port"
            ports.append(
                SerialPort(
                    **self._node(f"/dev/{entry.name}", name, "dev/serial/by-id"),
                    latency_ms=int(latency) if latency.isdigit() else None,
                    usb=usb,
                )
            )
        return sorted(ports, key=lambda port: (not port.usb, _natural(port.path)))

    def is_left_to_modem_manager(self, port: SerialPort) -> bool:
        """Return whether ModemManager runs and will open a port, because udev has no property that prevents it."""
        if self.running("ModemManager") is None or not port.usb:
            return False
        try:
            device = self._at(port.path).stat().st_rdev
        except OSError:
            return False
        known = self._text(f"/run/udev/data/c{os.major(device)}:{os.minor(device)}")
        return not re.search(r"^E:ID_MM_(PORT|DEVICE)_IGNORE=1$", known, re.MULTILINE)

    def serial_port(self, path: str) -> SerialPort | None:
        """Return the port ``path``, which may be a pseudo-terminal; None if it does not exist."""
        known = next((port for port in self.serial_ports() if self.same_file(port.path, path)), None)
        if known is not None or not self._at(path).exists():
            return known
        node = self._node(path, "not an adapter of this computer", "")
        node["holders"] = ()  # a pseudo-terminal is always open in the program at its other end
        return SerialPort(**node, latency_ms=None, usb={})

    def i2c_buses(self, configured: int | str | None = None) -> list[DeviceFile]:
        """Return the I2C buses for sensors, and the configured one; not those of monitors, memory and clock chips."""
        nodes = self._nodes("sys/class/i2c-dev", "")
        monitors = {entry.resolve().name for entry in self._at("sys/class/drm").glob("*/ddc")}
        bus = None if configured is None else self.i2c_name(configured)

        def computers_own(node: DeviceFile) -> bool:
            name = Path(node.path).name
            kind = self._text(f"sys/class/i2c-dev/{name}/device/of_node/compatible")
            return name in monitors or "hdmi" in kind or _COMPUTERS_OWN.search(node.name) is not None

        return [n for n in nodes if (bus and self.same_file(n.path, bus)) or not computers_own(n)]

    def i2c_driver(self, bus: int | str, address: int) -> str | None:
        """Return the kernel driver that uses an address of a bus; None if there is none."""
        from rig.devices.i2c import kernel_driver

        return kernel_driver(self._at(self.i2c_name(bus)).resolve().name, address, self.root)

    def cameras(self) -> list[DeviceFile]:
        """Return the device files that deliver images: no converters, no metadata, no second file of one camera.

        Cameras that the texts of their maker do not distinguish have one name in by-id, which leads to any of them: the
        stable name of each is its place.
        """
        nodes = [n for n in self._nodes(_CAMERAS, "dev/v4l/by-id") if self._is_camera(n)]
        described = {n.path: self._usb(self.root / _CAMERAS / Path(n.path).name / "device") for n in nodes}
        texts = {
            path: (
                usb.get("manufacturer", usb["idVendor"]),
                usb.get("product", usb.get("idProduct")),
                usb.get("serial"),
            )
            for path, usb in described.items()
            if usb
        }
        repeated = {path for path, text in texts.items() if list(texts.values()).count(text) > 1}
        return [
            replace(n, stable=self._link("dev/v4l/by-path", self._at(n.path).resolve())) if n.path in repeated else n
            for n in nodes
        ]

    def ribbon_cameras(self) -> list[str]:
        """Return the sensors on ribbon cables of a Raspberry Pi, for example imx708; libcamera develops the images."""
        receivers = any(_RAW_RECEIVERS.search(node.name) for node in self._nodes(_CAMERAS, ""))
        names = (self._text(f"{_CAMERAS}/{entry.name}/name") for entry in self._entries(_CAMERAS))
        sensors = [found[1] for name in names if (found := _SENSORS.fullmatch(name))]
        return sensors or (["unknown sensor"] if receivers else [])

    def video_capabilities(self, path: str) -> int | None:
        """Return the capabilities of a video device; None if it does not report them."""
        from rig.devices.v4l2 import capabilities

        return capabilities(self._at(path))

    def _is_camera(self, node: DeviceFile) -> bool:
        from rig.devices.v4l2 import captures

        if not node.path.startswith("/dev/video") or _CONVERTERS.search(node.name) or _RAW_RECEIVERS.search(node.name):
            return False
        if (caps := self.video_capabilities(node.path)) is not None and not captures(caps):
            return False
        return self._text(f"{_CAMERAS}/{Path(node.path).name}/index") in ("", "0")

    def camera_device(self, source: int | str) -> str | None:
        """Return the identity of the camera of a source: its USB ids and serial number, or else its place.

        The number of a camera and its path can mean another camera after replugging. None for a file or a stream, and
        if the system does not show more than the path.
        """
        if str(source).startswith("picamera2"):
            from rig.devices.picamera2_capture import camera_id, camera_number

            number = camera_number(source)
            return None if number is None else camera_id(number)
        path = camera_node(source)
        if path is None:
            return None
        # By what the camera says of itself, as far as that distinguishes it; else by its place.
        file = self._at(path).resolve()
        usb = self._usb(self.root / _CAMERAS / file.name / "device")
        kind = (
            f"USB {usb['idVendor']}:{usb.get('idProduct', '')}" if usb else self._text(f"{_CAMERAS}/{file.name}/name")
        )
        if usb.get("product"):  # some products of one manufacturer have the same number
            kind += f" ({usb['product']})"
        if usb.get("serial"):
            return f"{kind}, serial number {usb['serial']}"
        place = self._link("dev/v4l/by-path", file)
        return f"{kind} at {Path(place).name}" if place else None

    def device_node(self, source: int | str) -> tuple[int, ...] | None:
        """Return the identity of a camera's device file, valid until it is unplugged; None if there is no file."""
        try:
            status = self._at(camera_node(source) or str(source)).stat()
        except OSError:
            return None
        return status.st_dev, status.st_ino, status.st_rdev, status.st_ctime_ns

    def same_file(self, one: str, other: str) -> bool:
        """Return whether two paths, which may be links, are the same device."""
        return self._at(one).resolve() == self._at(other).resolve()

    def joined(self, group: str) -> bool:
        """Return whether the user is a member of the group, in this login or only after the next one."""
        # In the file a new membership counts at once, for processes only after the next login.
        for line in self._text("/etc/group").splitlines():
            name, _, rest = line.partition(":")
            if name == group:
                gid, _, members = rest.partition(":")[2].partition(":")
                return self.user.name in members.split(",") or (gid.isdigit() and int(gid) in self.user.gids)
        return False

    def time_synchronised(self) -> bool | None:
        """Return whether a time server sets the clock; None if no service reports it."""
        if self._at("/run/systemd/timesync").is_dir():
            return self._at("/run/systemd/timesync/synchronized").exists()
        return True if any(self._at(f"/run/{name}").exists() for name in ("chrony", "ntpd.pid", "ptp4l")) else None

    def disk(self, path: Path) -> Disk:
        """Return the disk of ``path``, which need not exist yet."""
        there = path.absolute()
        while not there.exists():
            there = there.parent
        # The mount with the longest path holds it.
        mounts = [line.split() for line in self._text("/proc/mounts").splitlines()]
        holding = [m for m in mounts if len(m) > 2 and there.is_relative_to(m[1].replace("\\040", " "))]
        kind = max(holding, key=lambda m: len(m[1]))[2] if holding else ""
        return Disk(shutil.disk_usage(there).free, kind in _NETWORK_FILE_SYSTEMS, os.access(there, os.W_OK))

    def running(self, command: str) -> Process | None:
        """Return a running program of that name; None if there is none."""
        for entry in self._entries("proc"):
            if entry.name.isdigit() and self._text(f"/proc/{entry.name}/comm") == command:
                return Process(int(entry.name), command)
        return None

    # -- opening ----------------------------------------------------------------------------------------------------

    def require_unused(self, path: str) -> None:
        """Raise `BenchBusy` if another program has the serial port open, also if it has not locked the port.

        The guardian of a killed program does not count: `open_serial` waits for it.
        """
        from rig.devices.dynamixel.port import GUARDIAN

        port = self.serial_port(path)
        holders = [process for process in port.holders if GUARDIAN not in process.command] if port else []
        if holders:
            raise BenchBusy(
                f"The port {path} is in use by {', '.join(map(str, holders))}.",
                next_step=f"Close that program. If it hangs: `kill {holders[0].pid}`.",
                evidence={"port": path, "pids": [process.pid for process in holders]},
            )

    def open_serial(self, path: str, baud: int, device: str = "servo") -> "SerialConnection":
        """Open the serial port of ``device``, a section of the configuration; wait for a guardian that uses it."""
        from rig.devices.dynamixel.port import open_serial

        return open_serial(path, baud, device, self.clock)

    def i2c_name(self, bus: int | str) -> str:
        """Return the name of a bus: its device file."""
        return bus if isinstance(bus, str) else f"/dev/i2c-{bus}"

    def i2c_path(self, bus: int | str) -> str:
        """Return the path by which smbus2 opens a bus."""
        return self.i2c_name(bus)

    def open_capture(self, source: int | str) -> "Capture":
        from rig.devices.opencv_capture import open_capture

        return open_capture(source)

    # -- files ------------------------------------------------------------------------------------------------------

    def _at(self, path: str) -> Path:
        return self.root / path.lstrip("/")

    def _text(self, path: str) -> str:
        """Return the text of a small file; empty if it cannot be read."""
        try:
            return self._at(path).read_text(encoding="utf-8", errors="replace").strip("\0\n ")
        except OSError:
            return ""

    def _entries(self, folder: str) -> list[Path]:
        try:
            return sorted((self.root / folder).iterdir(), key=lambda entry: _natural(entry.name))
        except OSError:
            return []

    def _nodes(self, folder: str, links: str) -> list[DeviceFile]:
        return [
            DeviceFile(**self._node(f"/dev/{entry.name}", self._text(f"/{folder}/{entry.name}/name"), links))
            for entry in self._entries(folder)
        ]

    def _node(self, path: str, name: str, links: str) -> dict[str, Any]:
        file = self._at(path)
        stable = self._link(links, file.resolve())
        try:
            status = file.stat()
        except OSError:
            group, usable = "", False
        else:
            group, usable = self._group_name(status.st_gid), self._may_use(file, status)
        return {
            "path": path,
            "name": name or Path(path).name,
            "stable": stable if links else None,
            "group": group,
            "usable": usable,
            "holders": tuple(self._holders(path)),
        }

    def _link(self, folder: str, file: Path) -> str | None:
        """Return the link in a folder that leads to a file."""
        return next((f"/{folder}/{e.name}" for e in self._entries(folder) if e.resolve() == file), None)

    def _may_use(self, file: Path, status: os.stat_result) -> bool:
        if self.user == User.current():
            return os.access(file, os.R_OK | os.W_OK)  # also checks access control lists
        # A simulated user, as the kernel decides: the first class that fits counts, also if another would allow more.
        shift = 6 if status.st_uid == self.user.uid else 3 if status.st_gid in self.user.gids else 0
        return self.user.uid == 0 or status.st_mode >> shift & 0o6 == 0o6

    def _group_name(self, gid: int) -> str:
        for line in self._text("/etc/group").splitlines():
            parts = line.split(":")
            if len(parts) > 2 and parts[2] == str(gid):
                return parts[0]
        with suppress(KeyError):
            return grp.getgrgid(gid).gr_name
        return str(gid)

    def _holders(self, path: str) -> Iterator[Process]:
        # A program may have opened the port by any of its names.
        wanted = str(self._at(path).resolve())
        for process in self._entries("proc"):
            if not process.name.isdigit() or int(process.name) == os.getpid():
                continue
            try:
                handles = [str(handle.readlink()) for handle in (process / "fd").iterdir()]
            except OSError:  # another user's process, or it has ended
                continue
            if path in handles or wanted in handles:
                command = self._text(f"/proc/{process.name}/cmdline").replace("\0", " ")
                yield Process(int(process.name), command or self._text(f"/proc/{process.name}/comm"))

    def _usb(self, device: Path) -> dict[str, str]:
        """Return the USB device's description; empty if the port is not on USB."""
        # The description is in a folder above that of the interface; how far depends on the driver.
        for folder in [(real := device.resolve()), *real.parents]:
            if (folder / "idVendor").is_file():
                names = ("idVendor", "idProduct", "manufacturer", "product", "serial")
                found = {
                    name: self._text("/" + str((folder / name).relative_to(self.root.resolve()))) for name in names
                }
                return {name: text for name, text in found.items() if text}
            if folder == self.root.resolve():
                break
        return {}


def _natural(name: str) -> list[Any]:
    return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", name)]
