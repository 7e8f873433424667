"""The interface of an inertial sensor on the platter, what its drivers share, and opening the configured one."""

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from pkgutil import resolve_name
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from rig.config import ImuConfig
from rig.config.imus import ImuKind, imu_kind, likely_device, recognised
from rig.core.clock import Clock
from rig.core.errors import ConfigError, ControllerHangs, DeviceMismatch, DeviceNotFound, DeviceSilent
from rig.core.next_steps import Do
from rig.devices.i2c import AnyBus, I2cRegisters


@dataclass(frozen=True, slots=True)
class ImuIdentity:
    """The sensor that answers on the bus, with the noise that its datasheet states."""

    model: str
    bus_address: int
    who_am_i: int
    gyro_noise_dps_rthz: float


@dataclass(frozen=True, slots=True)
class ImuSamples:
    """Consecutive samples, oldest first."""

    time_ns: NDArray[np.int64]
    """int64 (n,): sample times on the bench's clock, evenly spaced."""
    gyro_dps: NDArray[np.float64]
    """float64 (n, 3): angular rate about the sensor's x, y, z."""
    lost: int = 0
    """Samples that were lost before these (FIFO overflow); an integral across them is not valid."""


class Imu(Protocol):
    """A gyroscope and accelerometer on the platter."""

    @property
    def identity(self) -> ImuIdentity: ...
    @property
    def rate_hz(self) -> float: ...

    @property
    def range_dps(self) -> float:
        """Full scale of the gyro: a sample that reaches it is saturated."""

    def read_samples(self) -> ImuSamples:
        """Return all samples since the last call."""

    def read_gravity_g(self) -> NDArray[np.float64]:
        """Return one accelerometer reading (3,), in g."""

    def temperature_c(self) -> float: ...
    def close(self) -> None: ...


class FifoTimes:
    """Dates the samples that a sensor takes by its own clock and stores in its FIFO.

    The newest sample is dated a whole number of periods after the newest one of the last reading, corrected to the
    period before the count was read. The other samples are evenly spaced between the two. So the times stay in order
    even if the sensor's clock is a little fast or slow.
    """

    def __init__(self, clock: Clock, period_ns: int) -> None:
        self.period_ns = period_ns
        self._clock = clock
        self.restart()

    def restart(self) -> None:
        """Begin again after the FIFO was emptied: the next sample comes within a period."""
        self._newest_ns = self._clock.now_ns() - self.period_ns // 2

    def due(self, now_ns: int) -> float:
        """Return how many samples the sensor should have taken since the newest one."""
        return (now_ns - self._newest_ns) / self.period_ns

    def date(self, samples: int, missing: int, before_ns: int, after_ns: int) -> NDArray[np.int64]:
        """Return the times of new samples, before which ``missing`` others were lost.

        ``before_ns`` and ``after_ns`` are the times before and after the FIFO's count was read.
        """
        if not (steps := samples + missing):
            return np.empty(0, np.int64)
        newest_ns = self._newest_ns + steps * self.period_ns
        newest_ns = min(max(newest_ns, before_ns - self.period_ns), after_ns)
        time_ns = newest_ns - (newest_ns - self._newest_ns) * np.arange(samples - 1, -1, -1) // steps
        self._newest_ns = newest_ns
        return time_ns


class I2cImu:
    """What the drivers of sensors on an I2C bus of the computer share; if they cannot be opened, the bus is closed.

    Raises `DeviceNotFound`: the bus cannot be opened, or no device acknowledges the address. `DeviceMismatch`: another
    device answers there.
    """

    KIND: ClassVar[ImuKind]
    NOISE_DPS_RTHZ: ClassVar[float]
    """Output noise density of the gyro by the datasheet."""
    ADDRESS_PIN: ClassVar[str]
    """The pin that sets the address, in words."""

    def __init__(self, bus: AnyBus, clock: Clock, address: int) -> None:
        self._clock = clock
        self._registers = I2cRegisters(bus, address, clock)
        self.statistics = self._registers.statistics
        self.close = self._registers.close
        try:
            self.identity = self._identify()
            self._set_up()
        except BaseException:
            self.close()
            raise

    def _identify(self) -> ImuIdentity:
        bus, address = self._registers.name, self._registers.address
        try:
            got = self._read_identity()
        except ControllerHangs:
            raise
        except DeviceSilent as silent:
            raise DeviceNotFound(
                f"No sensor answers at I2C address {address:#04x} of {bus}.",
                next_step=f"Check the sensor's supply, SDA, SCL and ground, and the {self.ADDRESS_PIN}; "
                f"`i2cdetect -y {bus.removeprefix('/dev/i2c-')}` lists the addresses that answer (UU: a "
                "kernel driver uses the address).",
                evidence=silent.evidence,
            ) from silent
        if got not in self.KIND.identities:
            raise another_sensor(self.KIND, got, address, bus)
        return ImuIdentity(self.KIND.name, address, got, self.NOISE_DPS_RTHZ)

    def _read_identity(self) -> int:
        return self._registers.read(self.KIND.register, 1)[0]

    @abstractmethod
    def _set_up(self) -> None: ...


def another_sensor(kind: ImuKind, got: int, address: int, bus: str) -> DeviceMismatch:
    """Return the error for a sensor that is not of ``kind``; its identity register has the value ``got``."""
    other = recognised(address, kind.register, got)
    expected = " or ".join(f"{identity:#04x}" for identity in kind.identities)
    return DeviceMismatch(
        f"The identity register {kind.register:#04x} at I2C address {address:#04x} of {bus} is {got:#04x}, "
        f"expected {expected} ({kind.name}): probably {likely_device(kind, address, got)}.",
        next_step=Do.SET_KEY(key="imu.model", value=other.key)
        if other is not None and other.driver
        else "Check the wiring, or give the address and model of the sensor (imu.address, imu.model).",
        evidence={"got": got, "expected": kind.identities[0]},
    )


def open_imu(config: ImuConfig, bus: AnyBus, clock: Clock) -> Imu:
    """Open the sensor at ``config.address`` of ``bus``.

    Raises `ConfigError`, `DeviceNotFound`, `DeviceMismatch`, `DeviceFault`, `DeviceSilent`: the driver of a plug-in
    cannot be loaded; otherwise see the driver of the model.
    """
    kind = imu_kind(config.model)
    try:
        driver: Callable[..., Imu] = resolve_name(kind.driver)
    except (ImportError, AttributeError, ValueError) as error:
        raise ConfigError(
            f"The driver {kind.driver} of the {kind.name} cannot be loaded.",
            next_step="Fix or uninstall the package that provides it, or set imu.model to another sensor.",
            evidence={"reason": str(error)},
        ) from error
    settings = {name: getattr(config, name) for name in kind.settings}
    return driver(bus, clock=clock, address=config.address, **settings)
