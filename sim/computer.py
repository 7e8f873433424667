"""The simulated computer of a simulated bench: the files that Linux shows, and the simulated devices behind them."""

import re
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from rig.bench.computer import SERIAL_NAMES, Computer, User
from rig.config import RigConfig, ServoConfig
from rig.core.errors import DeviceNotFound, RigError
from rig.devices.camera import Capture
from rig.devices.dynamixel import settings
from rig.devices.dynamixel.bus import DynamixelBus
from rig.devices.dynamixel.port import ClockedPort, SerialConnection
from rig.devices.dynamixel.registers import control_table
from rig.devices.v4l2 import CAPTURE
from sim.camera import CAMERA_DEVICE
from sim.devices import SimDevices
from sim.i2c import SimI2cBus


class ComputerFiles:
    """Writes the files in which Linux shows devices into a folder: device files, sysfs, /proc and /etc/group."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self._usb = 0
        for folder in ("dev", "proc", "sys/class"):
            (root / folder).mkdir(parents=True, exist_ok=True)

    def write(self, path: str, text: str = "") -> Path:
        file = self.root / path.lstrip("/")
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text, encoding="utf-8")
        return file

    def link(self, path: str, target: Path) -> None:
        file = self.root / path.lstrip("/")
        file.parent.mkdir(parents=True, exist_ok=True)
        file.unlink(missing_ok=True)  # of two devices with one name, udev's link leads to the last one
        file.symlink_to(target)

    def group(self, name: str, gid: int, *members: str) -> None:
        """Add a line to /etc/group."""
        known = (self.root / "etc/group").read_text() if (self.root / "etc/group").exists() else ""
        self.write("etc/group", f"{known}{name}:x:{gid}:{','.join(members)}\n")

    def process(self, pid: int, command: str, *holds: str) -> None:
        """Add a process with device files open."""
        self.write(f"proc/{pid}/cmdline", command.replace(" ", "\0") + "\0")
        self.write(f"proc/{pid}/comm", Path(command.split()[0]).name + "\n")
        for number, path in enumerate(holds, start=3):
            self.link(f"proc/{pid}/fd/{number}", (self.root / path.lstrip("/")).resolve())

    def serial_port(
        self,
        name: str = "ttyUSB0",
        *,
        serial: str = "SIM00001",
        latency_ms: int | None = 1,
        mode: int = 0o660,
        by_id: str | None = None,
    ) -> None:
        """Connect a U2D2 (an FTDI adapter); ``by_id`` is its stable name."""
        self._usb += 1
        usb = f"sys/devices/usb1/1-{self._usb}"
        chip = {"idVendor": "0403", "idProduct": "6014", "manufacturer": "FTDI", "product": "USB <-> Serial Converter"}
        for key, value in {**chip, "serial": serial}.items():
            self.write(f"{usb}/{key}", f"{value}\n")
        port = self.root / usb / f"1-{self._usb}:1.0" / name
        port.mkdir(parents=True)
        self.link(f"sys/class/tty/{name}/device", port)
        if latency_ms is not None:
            self.write(f"sys/bus/usb-serial/devices/{name}/latency_timer", f"{latency_ms}\n")
        self.write(f"dev/{name}").chmod(mode)
        by_id = by_id or f"/dev/serial/by-id/usb-FTDI_USB__-__Serial_Converter_{serial}-if00-port0"
        self.link(by_id, self.root / "dev" / name)

    def i2c_bus(
        self,
        number: int = 1,
        name: str = "bcm2835 (i2c@7e804000)",
        *,
        mode: int = 0o660,
        compatible: str = "",
    ) -> None:
        """Add an I2C bus; ``compatible`` is its kind in the device tree."""
        self.write(f"sys/class/i2c-dev/i2c-{number}/name", f"{name}\n")
        if compatible:
            self.write(f"sys/class/i2c-dev/i2c-{number}/device/of_node/compatible", f"{compatible}\0")
        self.write(f"dev/i2c-{number}").chmod(mode)

    def i2c_driver(self, driver: str, number: int = 1, address: int = 0x68) -> None:
        """Bind a kernel driver to an address of a bus."""
        folder = self.root / "sys/bus/i2c/drivers" / driver
        folder.mkdir(parents=True, exist_ok=True)
        self.link(f"sys/bus/i2c/devices/{number}-{address:04x}/driver", folder)

    def camera(
        self,
        number: int = 0,
        name: str = "HD Webcam",
        *,
        index: int = 0,
        mode: int = 0o660,
        serial: str | None = None,
        usb_port: str = "",
        usb: tuple[str, str, str] = ("046d", "0825", ""),
        capabilities: int = CAPTURE,
    ) -> None:
        """Add a node of a camera, on a USB port such as 1-2; nodes with an index above 0 deliver no images.

        ``usb`` are its ids and its product name.

        The node's text is the answer of VIDIOC_QUERYCAP.
        """
        self.write(f"sys/class/video4linux/video{number}/name", f"{name}\n")
        self.write(f"sys/class/video4linux/video{number}/index", f"{index}\n")
        self.write(f"dev/video{number}", f"{capabilities:#x}").chmod(mode)
        self.link(f"dev/v4l/by-id/usb-{name.replace(' ', '_')}-video-index{index}", self.root / f"dev/video{number}")
        if usb_port:
            device = f"sys/devices/{usb_port}"
            for key, value in zip(("idVendor", "idProduct", "product", "serial"), (*usb, serial), strict=True):
                if value:
                    self.write(f"{device}/{key}", f"{value}\n")
            self.link(f"sys/class/video4linux/video{number}/device", self.root / device)
            self.link(f"dev/v4l/by-path/usb-{usb_port}-video-index{index}", self.root / f"dev/video{number}")

    def keeps_time(self, synchronised: bool = True) -> None:
        """Run a time synchronisation service."""
        (self.root / "run/systemd/timesync").mkdir(parents=True, exist_ok=True)
        if synchronised:
            self.write("run/systemd/timesync/synchronized")


class SimComputer(Computer):
    """A simulated computer whose devices have the names in ``config``."""

    def __init__(self, root: Path, devices: SimDevices, config: RigConfig, user: User | None = None) -> None:
        super().__init__(root, devices.world.clock, user or User.current(), simulated=True)
        self.devices = devices
        self._port = config.servo.port
        self._head_port = config.head.port
        self._bus = self.i2c_name(config.imu.bus)

    def open_serial(self, path: str, baud: int, device: str = "servo") -> SerialConnection:  # noqa: ARG002
        if self.devices.head is not None and self.same_file(path, self._head_port):
            return self.devices.head_port()
        if not self.same_file(path, self._port):
            raise DeviceNotFound(f"No port {path}.", next_step="Connect the adapter.", evidence={"port": path})
        adapter = self.devices.reopen_adapter()
        adapter.baudrate = baud
        return adapter

    def i2c_path(self, bus: int | str) -> str:
        wired = isinstance(self.devices.i2c, SimI2cBus) and self.i2c_name(bus) == self._bus
        return self.devices.i2c.path if wired else self.i2c_name(bus)

    def video_capabilities(self, path: str) -> int | None:
        text = self._text(path)
        return int(text, 16) if text else None

    def camera_device(self, source: int | str) -> str | None:  # noqa: ARG002 - there is one camera
        return CAMERA_DEVICE

    def device_node(self, source: int | str) -> tuple[int, ...] | None:  # noqa: ARG002 - there is one camera
        return self.devices.camera.node()

    def open_capture(self, source: int | str) -> Capture:  # noqa: ARG002 - there is one camera
        if not self.devices.camera.reopen():
            raise DeviceNotFound("No camera is connected.", next_step="Connect the camera.")
        return self.devices.camera


@contextmanager
def simulated_computer(config: RigConfig, devices: SimDevices) -> Iterator[SimComputer]:
    """Yield the computer of a simulated bench. The servo is configured as by opening the bench."""
    with _temporary_folder() as folder:
        write_files(folder, config)
        with suppress(RigError):  # no supply or a fault: the doctor reports it
            configure_servo(devices, config.servo)
        yield SimComputer(folder, devices, config)


@contextmanager
def _temporary_folder() -> Iterator[Path]:
    """Yield an empty folder. Another process removes it at the end, even if this program is killed."""
    script = """trap '' PIPE; folder=$(mktemp -d "$1/sim-host-XXXXXX") && printf '%s\\n' "$folder"
        read -r _; [ -z "$folder" ] || rm -rf -- "$folder" """
    with subprocess.Popen(
        ["sh", "-c", script, "sh", tempfile.gettempdir()],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as process:
        assert process.stdout is not None
        folder = process.stdout.readline().rstrip("\n")
        if not folder:
            raise OSError(f"no folder can be created in {tempfile.gettempdir()}")
        yield Path(folder)


def write_files(folder: Path, config: RigConfig) -> None:
    """Write the files of a computer to which the devices in ``config`` are connected."""
    computer = ComputerFiles(folder)
    name = Path(config.servo.port).name
    stable = config.servo.port.startswith("/dev/serial/by-id/")
    if SERIAL_NAMES.fullmatch(name):
        computer.serial_port(name)
    else:
        computer.serial_port(by_id=config.servo.port if stable else None)
        if not stable:
            computer.link(config.servo.port, folder / "dev/ttyUSB0")
    if config.imu.connection == "i2c":
        number = re.search(r"(\d+)$", str(config.imu.bus))
        computer.i2c_bus(int(number[1]) if number else 1)
    elif SERIAL_NAMES.fullmatch(Path(config.head.port).name):
        computer.serial_port(Path(config.head.port).name, serial="SIM00002")
    else:
        computer.write(config.head.port)
    number = re.search(r"(\d+)$", str(config.camera.source))
    computer.camera(int(number[1]) if number else 0)
    computer.keeps_time()


def configure_servo(devices: SimDevices, config: ServoConfig) -> None:
    """Write the settings that the rig needs into the servo's EEPROM."""
    bus = DynamixelBus(ClockedPort(devices.adapter, devices.world.clock))
    table = control_table(config.model)
    settings.write(bus, config.id, table, settings.compare(bus, config.id, table))
