"""Registers of a sensor on an I2C bus of the computer, through smbus2, with retries and explained errors."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from errno import EAGAIN, EBUSY, EIO, ENODEV, ENXIO, EREMOTEIO, ETIMEDOUT
from pathlib import Path
from typing import TypeVar

from smbus2 import SMBus, i2c_msg

from rig.core.clock import Clock
from rig.core.errors import ControllerHangs, DeviceNotFound, DeviceSilent
from rig.core.next_steps import Do

ATTEMPTS, RETRY_PAUSE_S = 3, 0.002

NO_DEVICE = (ENXIO, EREMOTEIO, ENODEV)
"""Errors by which the kernel's bus drivers report that no device acknowledges an address."""
STUCK = (ETIMEDOUT, EAGAIN)

DESIGNWARE = "Synopsys DesignWare I2C adapter"
"""The kernel's name of an adapter whose controller can hang until its supply is off, as in a Raspberry Pi 5."""
RESTART_CONTROLLER = (
    "Switch the computer and the sensors off for 10 seconds: a restart is not always enough. If the controller hangs "
    "again, shorten the cable, update the kernel (`sudo apt full-upgrade`), and use a slow bus (add "
    "dtparam=i2c_arm_baudrate=50000 to /boot/firmware/config.txt, then restart)."
)
_SMBUS_BLOCK = 32  # I2C_SMBUS_BLOCK_MAX: longer reads need I2C_RDWR, which not every adapter has
_REASONS = {
    **dict.fromkeys(NO_DEVICE, "it does not acknowledge"),
    **dict.fromkeys(STUCK, "the bus is stuck: something holds SDA or SCL low"),
    EIO: "a transfer was interrupted, or the bus hangs (a USB adapter does not report which)",
}

_T = TypeVar("_T")


@dataclass(slots=True)
class I2cStatistics:
    """Statistics since the bus was opened; ``overflows`` counts lost samples, ``corrupt`` impossible readings."""

    transfers: int = 0
    retries: int = 0
    overflows: int = 0
    corrupt: int = 0


class I2cBus:
    """A bus, opened by its number or by the path of its device file. Each transfer raises OSError if the bus fails.

    Raises `DeviceNotFound`: the bus cannot be opened.
    """

    def __init__(self, bus: int | str) -> None:
        self.name = bus if isinstance(bus, str) else f"/dev/i2c-{bus}"
        self._bus = _open(self.name)

    def close(self) -> None:
        self._bus.close()

    def reopen(self) -> None:
        """Open the bus again; raises `DeviceNotFound`."""
        self._bus.close()
        self._bus = _open(self.name)

    def read(self, address: int, register: int, count: int) -> bytes:
        if count <= _SMBUS_BLOCK:
            return bytes(self._bus.read_i2c_block_data(address, register, count))
        answer = i2c_msg.read(address, count)
        self._bus.i2c_rdwr(i2c_msg.write(address, [register]), answer)
        return bytes(answer)

    def write(self, address: int, register: int, values: bytes) -> None:
        self._bus.write_i2c_block_data(address, register, list(values))


AnyBus = int | str | I2cBus


class I2cRegisters:
    """Registers of the device at ``address`` (7 bits) of ``bus``, which may be open already; errors as for `I2cBus`."""

    def __init__(self, bus: AnyBus, address: int, clock: Clock) -> None:
        self._bus = bus if isinstance(bus, I2cBus) else I2cBus(bus)
        self.name, self.close = self._bus.name, self._bus.close
        self.address = address
        self.statistics = I2cStatistics()
        self._clock = clock

    def read(self, register: int, count: int) -> bytes:
        """Return ``count`` bytes from ``register`` on, in one transfer; raises `DeviceSilent` as `transfer` does."""
        return self.transfer(lambda: self.read_once(register, count))

    def read_once(self, register: int, count: int) -> bytes:
        """Return ``count`` bytes from ``register`` on; raises OSError if the bus fails."""
        return self._bus.read(self.address, register, count)

    def write(self, register: int, *values: int) -> None:
        self.transfer(lambda: self._bus.write(self.address, register, bytes(values)))

    def transfer(self, transfer: Callable[[], _T]) -> _T:
        """Return the result of ``transfer``; repeat it if the bus fails.

        Raises `DeviceNotFound`: a kernel driver uses the address. `DeviceSilent`: every attempt failed.
        `ControllerHangs`: they failed as those of a hanging controller, also after the bus was opened again.
        """
        failures: list[int] = []
        for attempt in range(ATTEMPTS + 1):
            # Some controllers that hang work again when their device file is opened again: one more attempt.
            if attempt == ATTEMPTS:
                if not controller_hangs(self.name, failures):
                    break
                self._bus.reopen()
            if attempt:
                self.statistics.retries += 1
                self._clock.sleep(RETRY_PAUSE_S)
            self.statistics.transfers += 1
            try:
                return transfer()
            except OSError as error:
                failure = error
                failures.append(error.errno or 0)
                if error.errno == EBUSY:  # no attempt can succeed
                    raise self._in_use() from error
        # No attempt succeeded: say what to check, by the kind of the last failure.
        evidence = {"errno": failure.errno, "attempts": len(failures), "retries_so_far": self.statistics.retries}
        if controller_hangs(self.name, failures):
            raise ControllerHangs(
                f"The I2C controller of {self.name} hangs ({DESIGNWARE}, as in a Raspberry Pi 5): no transfer with the "
                f"sensor at {self.address:#04x} ends, also after the bus was opened again.",
                next_step=RESTART_CONTROLLER,
                evidence=evidence,
            ) from failure
        reason = _REASONS.get(failure.errno or 0, failure.strerror)
        raise DeviceSilent(
            f"The sensor at I2C address {self.address:#04x} of {self.name} stopped answering: {reason}.",
            next_step="Switch the supply of all sensors on this bus off and on, and check SDA and SCL for a short. "
            "Then open the bench again."
            if failure.errno in STUCK
            else "Check its plug and supply, then open the bench again.",
            evidence=evidence,
        ) from failure

    def _in_use(self) -> DeviceNotFound:
        """Return the error that a kernel driver uses the address, so that no program can."""
        bus = Path(self.name).resolve().name
        driver = kernel_driver(bus, self.address)
        return DeviceNotFound(
            f"The kernel driver {driver or '(unknown)'} uses I2C address {self.address:#04x} of {self.name}.",
            next_step=f"Unbind it: `{unbind_command(bus, self.address, driver)}`."
            if driver
            else (Do.DOCTOR(), "It names the driver and the command that unbinds it."),
            evidence={"errno": EBUSY, "driver": driver},
        )


def controller_hangs(path: str, failures: Iterable[int]) -> bool:
    """Return whether the errors of consecutive transfers are those of a controller that hangs.

    A missing sensor is not acknowledged each time, and other adapters free the bus.
    """
    failed = set(failures)
    return ETIMEDOUT in failed <= {*STUCK, EREMOTEIO} and adapter_name(path) == DESIGNWARE


def adapter_name(path: str) -> str:
    """Return the kernel's name of the adapter at a device file; empty if sysfs has none."""
    try:
        return Path("/sys/class/i2c-dev", Path(path).resolve().name, "name").read_text(encoding="utf-8").strip()
    except OSError:
        return ""


def kernel_driver(bus: str, address: int, root: Path = Path("/")) -> str | None:
    """Return the kernel driver that uses ``address`` of ``bus`` (``i2c-1``); None if sysfs shows none."""
    try:
        return (root / "sys/bus/i2c/devices" / _client(bus, address) / "driver").readlink().name
    except OSError:
        return None


def unbind_command(bus: str, address: int, driver: str) -> str:
    """Return the command that makes a kernel driver release an address until the next restart."""
    return f"echo {_client(bus, address)} | sudo tee /sys/bus/i2c/drivers/{driver}/unbind"


def _client(bus: str, address: int) -> str:
    """Return the kernel's name of a device on an I2C bus, for example 1-0068."""
    return f"{bus.removeprefix('i2c-')}-{address:04x}"


def _open(path: str) -> SMBus:
    bus = SMBus()
    try:
        bus.open(path)
    except OSError as error:
        bus.close()
        match error:
            case FileNotFoundError():
                next_step = "Enable I2C (on a Raspberry Pi: `raspi-config`); `i2cdetect -l` lists the buses."
            case PermissionError():
                next_step = "Join the group i2c (`sudo usermod -aG i2c $USER`), then log in again."
            case _:
                next_step = "Give the device file of an I2C bus; `i2cdetect -l` lists them."
        raise DeviceNotFound(
            f"The I2C bus {path} cannot be opened: {error.strerror}.",
            next_step=next_step,
            evidence={"errno": error.errno},
        ) from error
    return bus
