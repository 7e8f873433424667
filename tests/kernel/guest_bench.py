"""The rig in the virtual machine: its folder there, its programs, and the cables of its devices."""

from collections.abc import Callable
from pathlib import PurePosixPath
from typing import Any, Final

from rig.core.clock import SystemClock, seconds_between
from rig.devices.dynamixel.port import GUARDIAN
from tests.kernel.machine import PROJECT, GuestProcess, Machine, Result
from tests.kernel.played_bench import PlayedBench
from tests.kernel.usb.device import UsbDevice

FOLDER: Final = PurePosixPath("/bench")
VARIABLES: Final = {
    **{f"XDG_{kind}_HOME": str(FOLDER / kind.lower()) for kind in ("CONFIG", "DATA", "STATE", "CACHE")},
    "HOME": "/root",
    "TERM": "dumb",
    "COLUMNS": "160",
    "NO_COLOR": "1",
    "OPENBLAS_NUM_THREADS": "1",
}
LATCH: Final = FOLDER / "state/hbr-rig/hardware/latch"
APPEAR_S: Final = 30.0
_POLL_S: Final = 0.05
START_S: Final = 4.0
"""How long a small program of the rig takes from its start to its end if nothing else uses this computer."""


class GuestBench:
    """The bench in the machine: runs programs and moves cables."""

    def __init__(self, machine: Machine, played: PlayedBench) -> None:
        self.machine = machine
        """The virtual machine."""
        self.played = played
        """The devices' other end."""
        self._shown = {
            played.servo: ("/dev/serial/by-id/*", ""),
            played.imu: ("/sys/class/i2c-dev/*/name", "i2c-tiny-usb"),
            played.camera: ("/dev/v4l/by-id/*-index0", ""),
        }
        self.sh(f"mkdir -p {FOLDER}", folder="/")

    # -- programs ---------------------------------------------------------------------------------------------------

    def start(self, *words: object, **options: Any) -> GuestProcess:
        """Start `rig ...` in the bench's folder."""
        asked = {"words": [str(word) for word in words], "folder": str(FOLDER), "variables": VARIABLES, **options}
        return GuestProcess(self.machine, self.machine.ask("start", **asked))

    def rig(self, *words: object, timeout: float = 200.0, **options: Any) -> Result:
        """Return the result of `rig ...`."""
        return self.start(*words, **options).wait(timeout)

    def python(self, code: str, timeout: float = 120.0) -> Result:
        """Return the result of a piece of Python in the project's folder; it starts faster than with `sh`."""
        return self.start(code=code, folder=str(PROJECT)).wait(timeout)

    def files(self, pattern: object) -> dict[str, str]:
        """Return the files of a pattern with their text; a device file has an empty one."""
        found: dict[str, str] = self.machine.ask("files", pattern=str(pattern))
        return found

    def start_sh(self, command: str, folder: str = str(FOLDER)) -> GuestProcess:
        """Start a command of the shell."""
        return GuestProcess(
            self.machine, self.machine.ask("shell", command=command, folder=folder, variables=VARIABLES)
        )

    def sh(self, command: str, folder: str = str(FOLDER)) -> str:
        """Return the output of a command; raises AssertionError if it fails."""
        result = self.start_sh(command, folder).wait(200.0)
        assert result.code == 0, f"{command}: {result}"
        return result.output.strip()

    def restore(self) -> None:
        """End all programs, plug every device in, end all faults, and acknowledge latched faults."""
        self.machine.ask("end_all")
        self.played.restore()
        self.plug_in(*(device for device in self.played.usb if device.plug is None))
        if any(text.strip(" \0\n") for text in self.files(LATCH).values()):
            assert self.rig("acknowledge").code == 0

    @property
    def i2c_bus(self) -> str:
        """The device file of the played I2C adapter; its number depends on the computer's other adapters."""
        pattern, name = self._shown[self.played.imu]
        (file,) = (path for path, text in self.files(pattern).items() if name in text)
        return f"/dev/{PurePosixPath(file).parent.name}"

    # -- cables -----------------------------------------------------------------------------------------------------

    def plug_in(self, *devices: UsbDevice) -> None:
        """Plug devices in, and wait until their device files exist."""
        for device in devices:
            self._attach(device, self.played.usb.index(device))
        for device in devices:
            self.until(lambda device=device: self._exists(device), f"{type(device).__name__} appears")
        self.sh("udevadm settle --timeout=30")

    def plug_in_adapter(self, adapter: UsbDevice, driver: str) -> str:
        """Plug in another I2C adapter, and return its device file."""
        self._attach(adapter, len(self.played.usb))

        def buses() -> list[str]:
            names = self.files("/sys/class/i2c-dev/*/name").items()
            return [PurePosixPath(file).parent.name for file, text in names if driver in text]

        self.until(buses, f"{driver} appears")
        self.sh("udevadm settle --timeout=30")
        return f"/dev/{buses()[0]}"

    def plug_in_webcam(self, webcam: UsbDevice, number: int) -> str:
        """Plug in another webcam, and return its device file; ``number`` counts such webcams."""
        hub_port = len(self.played.usb) + number
        self._attach(webcam, hub_port)
        indices = f"/sys/devices/platform/vhci_hcd.0/usb*/*-{hub_port + 1}/*/video4linux/video*/index"

        def nodes() -> list[str]:
            return [PurePosixPath(file).parent.name for file, text in self.files(indices).items() if text == "0\n"]

        self.until(nodes, "the webcam appears")
        self.sh("udevadm settle --timeout=60")
        return f"/dev/{nodes()[0]}"

    def _attach(self, device: UsbDevice, hub_port: int) -> None:
        speed = int(device.speed)
        self.machine.ask("attach", port=device.port, hub_port=hub_port, device=hub_port + 1, speed=speed)

    def unplug(self, *devices: UsbDevice) -> None:
        """Pull the cables of devices, and wait until the kernel has noticed."""
        for device in devices:
            device.unplug()
        for device in devices:
            self.until(lambda device=device: not self._exists(device), f"{type(device).__name__} disappears")

    def _exists(self, device: UsbDevice) -> bool:
        pattern, name = self._shown[device]
        return any(name in text for text in self.files(pattern).values())

    def until(self, condition: Callable[[], object], what: str, seconds: float = APPEAR_S) -> None:
        """Wait for a condition; raises AssertionError if it does not come true in ``seconds``.

        While other programs use this computer, the time is longer by what the machine is slower now.
        """
        clock = SystemClock()
        begun_ns, limit_s = clock.now_ns(), seconds
        while not condition():
            waited_s = seconds_between(begun_ns, clock.now_ns())
            if waited_s > limit_s:
                limit_s = seconds * self.slowness()
                assert waited_s < limit_s, f"not in {limit_s:.1f} s: {what}"
            clock.sleep(_POLL_S)

    def slowness(self) -> float:
        """Return how many times longer a program takes now than on an idle computer; at least 1."""
        clock = SystemClock()
        begun_ns = clock.now_ns()
        self.sh(f"{self.machine.kernel.python} -P -m {GUARDIAN} /dev/null 57600 xl430_w250 1 </dev/null", str(PROJECT))
        return max(seconds_between(begun_ns, clock.now_ns()) / START_S, 1.0)

    def until_printed(self, process: GuestProcess, text: str, seconds: float = 120.0) -> None:
        """Wait until a program has printed a text; raises AssertionError with its output if it has not, or ends."""
        try:
            self.until(lambda: text in process.output or not process.runs, text, seconds)
            assert text in process.output
        except AssertionError:
            raise AssertionError(f"it has not printed {text!r} in {seconds:g} s:\n{process.output}") from None

    def pause(self, seconds: float) -> None:
        """Wait for some time."""
        SystemClock().sleep(seconds)
