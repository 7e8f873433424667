"""The MPU-6050 and the sensors with its registers, on an I2C bus of the computer, through smbus2.

Registers: RM-MPU-6000A rev 4.2; noise and scales: PS-MPU-6000A rev 3.4; MPU-6500: RM-MPU-6500A and PS-MPU-6500A;
MPU-9250: RM-MPU-9250A and PS-MPU-9250A. The sensor takes the gyro's samples by its own clock and stores them in its
FIFO, so a late reader loses no rotation.
"""

from collections.abc import Callable
from typing import ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from rig.config.imus import imu_kind
from rig.core.clock import Clock
from rig.core.errors import ConfigError, DeviceFault, DeviceMismatch
from rig.devices.i2c import AnyBus
from rig.devices.imu import FifoTimes, I2cImu, Imu, ImuSamples

SMPLRT_DIV, _FIFO_EN, _ACCEL_XOUT_H, _TEMP_OUT_H = 0x19, 0x23, 0x3B, 0x41
_GYRO_CONFIG, _GYRO_SELF_TEST = 0x1B, 0xE0  # all three axes, at 250 °/s
_USER_CTRL, _PWR_MGMT_1, _FIFO_COUNTH, _FIFO_R_W = 0x6A, 0x6B, 0x72, 0x74

_DEVICE_RESET, _ASLEEP, _CLOCK_PLL_GYRO_X = 0x80, 0x40, 0x01
_FIFO_ENABLE, _FIFO_RESET, _FIFO_GYRO_XYZ = 0x40, 0x04, 0x70
_RESET_S, _START_S = 0.1, 0.05
"""After DEVICE_RESET (register 107), and the gyro's start-up of 30 ms (PS 6.1) with the PLL's settling."""

_BYTE_NS = 35_000  # a byte at 400 kHz with its acknowledge takes 22.5 µs
_SLOW_NS = 50_000_000  # this computer was busy: with so uncertain a time, an overflow could not be excluded
_FRAME = 6  # bytes of a sample in the FIFO: three words

LSB_PER_G = 16384.0
LSB_PER_DPS = {250: 131.0, 500: 65.5, 1000: 32.8, 2000: 16.4}  # by the full scale
_FILTERS = {188: 1, 98: 2, 42: 3, 20: 4, 10: 5, 5: 6}
"""DLPF_CFG by the gyro's bandwidth in Hz; all run at an internal rate of 1 kHz."""

_TESTED_SAMPLES, _TESTED_S = 50, 2.0
"""Number of samples of a clone that are tested, and longest time for them: 50 samples fit into any of the FIFOs."""
_SELF_TEST_DPS = (5.0, 220.0)
"""Smallest and largest response to the self-test; that of an MPU-6050 is 25 to 101 °/s by its factory trim (RM 4.1)."""
_SELF_TEST_SAMPLES = 4, 20  # at least, and within a second
_WILD_DPS = 20.0  # standard deviation that no table at rest shows


class Mpu6050(I2cImu):
    """An MPU-6050; implements `rig.devices.imu.Imu`.

    Opening it resets the sensor, wakes it up, writes the settings and reads them back.

    ``range_dps`` is a key of `LSB_PER_DPS`, ``rate_hz`` 1000 divided by a whole number up to 256, and ``bandwidth_hz``
    that of the gyro's low-pass, a key of `_FILTERS`, below half of the rate to avoid aliasing.

    Raises `ConfigError`: the sensor does not have this rate. `DeviceFault`: the sensor does not keep its settings.
    Others as `I2cImu`.
    """

    KIND = imu_kind("mpu6050")
    NOISE_DPS_RTHZ = 0.005  # PS-MPU-6000A, 6.1
    ADDRESS_PIN = "AD0 pin (low 0x68, high 0x69)"
    FIFO_BYTES: ClassVar[int] = 1024
    TEMPERATURE: ClassVar[tuple[float, float]] = 340.0, 36.53
    """LSB per °C, and the temperature at 0 LSB, °C."""

    def __init__(
        self,
        bus: AnyBus,
        *,
        clock: Clock,
        address: int = 0x68,
        range_dps: int = 250,
        rate_hz: float = 200.0,
        bandwidth_hz: int = 42,
    ) -> None:
        self._range_dps = range_dps
        self._settings = settings(range_dps, rate_hz, bandwidth_hz)
        self._times = FifoTimes(clock, 1_000_000 * (1 + self._settings[SMPLRT_DIV][0]))
        super().__init__(bus, clock, address)

    @property
    def rate_hz(self) -> float:
        return 1e9 / self._times.period_ns

    @property
    def range_dps(self) -> float:
        return 32767 / LSB_PER_DPS[self._range_dps]

    def read_samples(self) -> ImuSamples:
        """Return the samples in the FIFO; `FifoTimes` dates them.

        Raises `DeviceSilent`: the sensor does not answer, even after retries. `DeviceFault`: the sensor fell asleep or
        lost its settings (a brown-out).
        """
        # How many bytes are there? Two times bound the moment at which the sensor counted them.
        for _ in range(2):
            before_ns = self._clock.now_ns()
            count = self._fifo_count()
            after_ns = self._clock.now_ns()
            if after_ns - before_ns < _SLOW_NS:
                break
        if count > self.FIFO_BYTES - _FRAME or (
            self._implausible(count, after_ns) and self._implausible(count := self._fifo_count(), after_ns)
        ):
            return self._start_over()  # incomplete twice, so it is not a frame that is being written
        # How many samples should be there? Another program may have emptied the FIFO, or the sensor was reset.
        samples, missing = count // _FRAME, 0
        due = self._times.due(before_ns)
        if samples < 0.9 * due - 2:  # the sensor's clock is off by at most 5 % (PS 6.6): samples are missing
            self._check_settings()
            missing = round(due) - samples
        # A FIFO that overflows while it is read shifts its frames.
        full_ns = before_ns + round((self.FIFO_BYTES - count) // _FRAME * self._times.period_ns)
        data = self._pop(count, full_ns) if count else b""
        if data is None:
            return self._start_over()
        gyro = np.frombuffer(data, ">i2").reshape(-1, 3) / LSB_PER_DPS[self._range_dps]
        return ImuSamples(self._times.date(samples, missing, before_ns, after_ns), gyro, missing)

    def read_gravity_g(self) -> NDArray[np.float64]:
        """Return one accelerometer reading (3,), in g; raises as `read_samples` does."""
        self._check_settings()
        return np.frombuffer(self._registers.read(_ACCEL_XOUT_H, 6), ">i2") / LSB_PER_G

    def temperature_c(self) -> float:
        """Return the temperature of the sensor's die (register 65); raises as `read_samples` does."""
        self._check_settings()
        lsb_per_c, zero_c = self.TEMPERATURE
        return int.from_bytes(self._registers.read(_TEMP_OUT_H, 2), "big", signed=True) / lsb_per_c + zero_c

    # -- setting up -----------------------------------------------------------------------------------------------

    def _set_up(self) -> None:
        self._registers.write(_PWR_MGMT_1, _DEVICE_RESET)
        self._clock.sleep(_RESET_S)
        self._registers.write(_PWR_MGMT_1, _CLOCK_PLL_GYRO_X)
        self._clock.sleep(_START_S)
        for register, values in self._settings.items():
            self._registers.write(register, *values)
        self._empty_fifo()
        self._check_settings()

    def _check_settings(self) -> None:
        """Raise `DeviceFault` unless the sensor is awake and has its settings."""
        got = {register: self._registers.read(register, len(values)) for register, values in self._settings.items()}
        if got == self._settings:
            return
        # After a reset an MPU-6050 is asleep. An MPU-6500 is awake, so the check compares all settings.
        asleep = got[_USER_CTRL][1] & _ASLEEP
        reset = asleep or not any(got[register][0] for register in self._settings)
        raise DeviceFault(
            f"The {self.KIND.name} {'fell asleep' if asleep else 'was reset'}: its supply was interrupted."
            if reset
            else f"The {self.KIND.name} lost its settings: another program changed them, or the bus corrupts bytes.",
            next_step="Check its supply and cable, then open the bench again."
            if reset
            else "Close other programs that use the I2C bus, shorten its cable, then open the bench again.",
            evidence={f"register_{r:#04x}": {"got": got[r].hex(), "expected": self._settings[r].hex()} for r in got},
        )

    def _start_over(self) -> ImuSamples:
        """Drop the FIFO's content: it is full, or its frames are corrupt."""
        self.statistics.overflows += 1
        lost = max(round(self._times.due(self._clock.now_ns())), 1)
        self._empty_fifo()
        return ImuSamples(np.empty(0, np.int64), np.empty((0, 3)), lost)

    def _empty_fifo(self) -> None:
        self._registers.write(_USER_CTRL, _FIFO_RESET)  # works only while FIFO_EN is 0 (register 106)
        self._registers.write(_USER_CTRL, _FIFO_ENABLE)
        self._times.restart()

    def _implausible(self, count: int, now_ns: int) -> bool:
        """Return whether a count is impossible: an incomplete frame, or more bytes than were sampled."""
        return bool(count % _FRAME) or count > _FRAME * (1.1 * self._times.due(now_ns) + 3)

    # -- the bus --------------------------------------------------------------------------------------------------

    def _fifo_count(self) -> int:
        return int.from_bytes(self._registers.read(_FIFO_COUNTH, 2), "big")

    def _pop(self, count: int, full_ns: int) -> bytes | None:
        """Read ``count`` bytes of the FIFO.

        None if an interrupted transfer consumed some of them, or if the FIFO may have overflowed at ``full_ns`` before
        they were read, because this computer was busy: then its frames are shifted.
        """
        repeated = False

        def pop() -> bytes | None:
            nonlocal repeated
            if (repeated and self._fifo_count() < count) or self._clock.now_ns() >= full_ns:
                return None
            repeated = True
            data = self._registers.read_once(_FIFO_R_W, count)
            in_time = self._clock.now_ns() < full_ns + count * _BYTE_NS
            return data if in_time or self._fifo_count() < self.FIFO_BYTES - count else None

        return self._registers.transfer(pop)


class Mpu6500(Mpu6050):
    """An MPU-6500, which many boards sold as GY-521 carry; its low-pass is at 184, 92, 41, 20, 10 or 5 Hz."""

    KIND = imu_kind("mpu6500")
    FIFO_BYTES = 512
    NOISE_DPS_RTHZ = 0.01
    TEMPERATURE = 333.87, 21.0


class Mpu9250(Mpu6500):
    """An MPU-9250: an MPU-6500 with a magnetometer in its package, which is not used."""

    KIND = imu_kind("mpu9250")


class Mpu6050Clone(Mpu6050):
    """A clone of the MPU-6050 that has no datasheet. Opening it also tests its samples at rest.

    The driver assumes the worst values of the family: the smallest FIFO and the largest noise. The temperature has the
    MPU-6050's scale.

    Raises `DeviceMismatch`: its samples come at another rate, are all equal or wild, gravity is not 1 g, or its gyro
    does not respond to its self-test.
    """

    KIND = imu_kind("mpu6050_clone")
    FIFO_BYTES = 512
    NOISE_DPS_RTHZ = 0.01

    def _set_up(self) -> None:
        super()._set_up()
        check_clone(self, self._clock, f"of {self._registers.name}", self._self_test)

    def _self_test(self, at_rest_dps: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the change of each axis of the gyro during its self-test, (3,), in °/s."""
        self._registers.write(_GYRO_CONFIG, _GYRO_SELF_TEST)
        self._empty_fifo()
        least, most = _SELF_TEST_SAMPLES
        count = max(least, min(most, round(self.rate_hz)))
        self._clock.sleep(count / self.rate_hz)
        words = self._registers.read(_FIFO_R_W, self._fifo_count() // _FRAME * _FRAME)
        self._registers.write(SMPLRT_DIV, *self._settings[SMPLRT_DIV])
        self._empty_fifo()
        late = np.frombuffer(words, ">i2").reshape(-1, 3)[count // 2 :]  # after the low-pass has settled
        return late.mean(axis=0) / LSB_PER_DPS[250] - at_rest_dps if len(late) else np.zeros(3)


def check_clone(
    imu: Imu, clock: Clock, place: str, self_test: Callable[[NDArray[np.float64]], NDArray[np.float64]] | None = None
) -> None:
    """Test the samples of a clone at rest, gravity, and with ``self_test`` its response; see `Mpu6050Clone`."""
    due = min(float(_TESTED_SAMPLES), _TESTED_S * imu.rate_hz)
    imu.read_samples()
    clock.sleep(due / imu.rate_hz)
    samples, gravity_g = imu.read_samples(), float(np.linalg.norm(imu.read_gravity_g()))
    got, rates = len(samples.time_ns), samples.gyro_dps
    noise_dps = float(rates.std(axis=0).max()) if got else 0.0
    problems = []
    if samples.lost or abs(got - due) > 0.1 * due + 2:
        problems.append(f"it took {got} samples instead of {due:.0f}")
    elif noise_dps == 0.0:
        problems.append("all its samples are equal")
    elif noise_dps > _WILD_DPS:
        problems.append(f"its rates scatter by {noise_dps:.0f} °/s")
    if not 0.8 < gravity_g < 1.2:
        problems.append(f"gravity is {gravity_g:.2f} g")
    # Its self-test, only if the samples can be trusted.
    if self_test is not None and not problems:
        response_dps, (low_dps, high_dps) = self_test(rates.mean(axis=0)), _SELF_TEST_DPS
        if not all(low_dps <= abs(one) <= high_dps for one in response_dps):
            shown = ", ".join(f"{one:.0f}" for one in response_dps)
            problems.append(f"its gyro responds with {shown} °/s to its self-test")
    if problems:
        raise DeviceMismatch(
            f"The clone at I2C address {imu.identity.bus_address:#04x} {place} does not behave as an MPU-6050: "
            f"{'; '.join(problems)}.",
            next_step="Keep the table still and open the bench again. If it fails again, use another sensor.",
            evidence={"samples": got, "expected": due, "noise_dps": noise_dps, "gravity_g": gravity_g},
        )


DRIVERS: Final = {driver.KIND.key: driver for driver in (Mpu6050, Mpu6500, Mpu9250, Mpu6050Clone)}
"""The drivers of this module by `ImuKind.key`; a rig head has the scales of theirs."""


def settings(range_dps: int, rate_hz: float, bandwidth_hz: int) -> dict[int, bytes]:
    """Return the values to write and to check, by their first register."""
    divider = round(1000 / rate_hz) if 3.9 < rate_hz <= 1000 else 0
    if not (1 <= divider <= 256 and abs(1000 / divider - rate_hz) < 1e-6 * rate_hz):
        raise ConfigError(
            f"The IMU does not have the rate imu.rate_hz = {rate_hz:g}.",
            next_step="Give 1000 divided by a whole number up to 256.",
            evidence={"rate_hz": rate_hz},
        )
    full_scale = list(LSB_PER_DPS).index(range_dps) << 3
    return {
        SMPLRT_DIV: bytes([divider - 1, _FILTERS[bandwidth_hz], full_scale, 0]),  # and CONFIG, GYRO_, ACCEL_CONFIG
        _FIFO_EN: bytes([_FIFO_GYRO_XYZ]),
        _USER_CTRL: bytes([_FIFO_ENABLE, _CLOCK_PLL_GYRO_X]),  # and PWR_MGMT_1
    }
