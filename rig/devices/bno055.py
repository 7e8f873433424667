"""The BNO055 on an I2C bus of the computer: a gyro with its own sensor fusion.

Registers and times: BST-BNO055-DS000. It runs in its IMU mode (gyro and accelerometer, no magnetometer, because servo
and steel distort the magnetic field). It has no FIFO. The rotation between two readings comes from the orientation that
it integrates itself, if that is less than half a revolution.

Decision: docs/decisions/0007.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rig.config.imus import imu_kind
from rig.core.clock import Clock, seconds_between
from rig.core.errors import ControllerHangs, DeviceFault, DeviceSilent
from rig.devices.i2c import AnyBus
from rig.devices.imu import I2cImu, ImuSamples

Floats = NDArray[np.float64]

RATE_HZ, RANGE_DPS = 100.0, 2000.0
"""Rate and range of its fusion modes, in which the sensor sets them itself (3.5)."""
LSB_PER_DPS, LSB_PER_MS2, LSB_PER_QUATERNION = 16.0, 100.0, 16384.0
_PAGE_ID, _ACC_DATA, _FIRST, _TEMP = 0x07, 0x08, 0x14, 0x34
_UNIT_SEL, _OPR_MODE, _LAST = 0x3B, 0x3D, 0x3E
_CONFIG_MODE, _IMU_MODE, _FUSION_RUNNING = 0x00, 0x08, 5
_TO_CONFIG_S, _FROM_CONFIG_S = 0.02, 0.01  # mode changes take 19 and 7 ms (3.3), plus a margin
_START_S, _POLL_S = 1.2, 0.05
"""The sensor is silent for 650 ms after power-up (1.2), and its fusion needs some more time."""
_LEARN_S = 3.0  # longest time to wait for the gyro's calibration
_GAP_S = 0.5  # longest time between two readings: at its highest speed (200 °/s), the table rotates by 100°
_CARRIED_DEG = 0.01
"""Difference between orientation and rate that the next reading corrects: the orientation's resolution."""
_ORIENTATION_AGE_S = 0.015  # largest age of an orientation: a period of the fusion, plus the reading
_G = 9.80665
_ATTEMPTS = 4  # readings until one is valid
_IDENTITY_READS = 8
SLOW_BUS = (
    "Use a slow bus (add dtparam=i2c_arm_baudrate=10000 to /boot/firmware/config.txt) or a software bus "
    "(dtoverlay=i2c-gpio,bus=3, and imu.bus = 3), then restart. A Raspberry Pi up to the 4 does not wait for the "
    "BNO055, which stretches the clock."
)
"""Next step if a controller corrupts the answers of a sensor that stretches the clock."""


@dataclass(frozen=True, slots=True)
class _Reading:
    """The registers from the gyro to the power mode, read in one transfer; ``calibrated`` says that of the gyro."""

    gyro_dps: Floats
    orientation: Floats
    calibrated: bool


class Bno055(I2cImu):
    """A BNO055; implements `rig.devices.imu.Imu`.

    Its samples follow the gyro's readings, and their sum is the rotation of the orientation. Between two readings that
    are further apart than the gyro's period, they are interpolated. Therefore the rates are only correct if the sensor
    is read while the table moves, as the control loop does.

    Raises `DeviceFault`: its fusion does not run, or it does not keep its settings. Others as `I2cImu`, even a second
    after power-up.
    """

    KIND = imu_kind("bno055")
    NOISE_DPS_RTHZ = 0.014  # table 0-2
    ADDRESS_PIN = "ADR pin (low 0x28, high 0x29)"
    rate_hz = RATE_HZ
    range_dps = RANGE_DPS
    _last: _Reading
    _newest_ns: int
    _owed_deg: Floats

    def __init__(self, bus: AnyBus, *, clock: Clock, address: int = 0x28) -> None:
        self._period_ns = round(1e9 / RATE_HZ)
        super().__init__(bus, clock, address)

    def read_samples(self) -> ImuSamples:
        """Return samples for the time since the last call.

        Raises `DeviceSilent`: the sensor does not answer, even after retries. `DeviceFault`: the sensor was reset, its
        fusion stopped, or its data are impossible.
        """
        now_ns = self._clock.now_ns()
        reading = self._read()
        count = (now_ns - self._newest_ns) // self._period_ns
        if count == 0:
            return ImuSamples(np.empty(0, np.int64), np.empty((0, 3)))
        if seconds_between(self._newest_ns, now_ns) > _GAP_S:
            self.statistics.overflows += 1
            self._start_over(reading, now_ns)
            return ImuSamples(np.empty(0, np.int64), np.empty((0, 3)), int(count))
        # Interpolate the gyro between this reading and the last one, one sample for each of its periods.
        share = np.arange(1, count + 1) / count
        time_ns = self._newest_ns + np.rint((now_ns - self._newest_ns) * share).astype(np.int64)
        gyro = self._last.gyro_dps + (reading.gyro_dps - self._last.gyro_dps) * (share - 0.5 / count)[:, None]
        # Correct the samples so that they add up to the rotation that the chip integrated itself. A small difference is
        # carried to the next reading: it is the orientation's resolution and age.
        owed_deg = self._owed_deg + _rotation_deg(self._last.orientation, reading.orientation) - gyro.sum(0) / RATE_HZ
        fastest = max(float(np.linalg.norm(self._last.gyro_dps)), float(np.linalg.norm(reading.gyro_dps)))
        carried = (_CARRIED_DEG + _ORIENTATION_AGE_S * fastest) / max(float(np.linalg.norm(owed_deg)), 1e-9)
        if carried < 1:
            gyro += (1 - carried) * owed_deg * RATE_HZ / count
            owed_deg = carried * owed_deg
        self._owed_deg, self._last, self._newest_ns = owed_deg, reading, now_ns
        return ImuSamples(time_ns, gyro)

    def read_gravity_g(self) -> Floats:
        """Return one accelerometer reading (3,), in g; raises as `read_samples` does."""
        self._read()
        return np.frombuffer(self._registers.read(_ACC_DATA, 6), "<i2") / (LSB_PER_MS2 * _G)

    def temperature_c(self) -> float:
        """Return the temperature of the sensor's die; raises as `read_samples` does."""
        self._read()
        return float(int.from_bytes(self._registers.read(_TEMP, 1), "little", signed=True))

    # -- setting up ---------------------------------------------------------------------------------------------------

    def _read_identity(self) -> int:
        deadline_ns = self._clock.now_ns() + round(_START_S * 1e9)
        while True:
            try:
                got = super()._read_identity()
                break
            except ControllerHangs:
                raise
            except DeviceSilent:
                if self._clock.now_ns() > deadline_ns:
                    raise
                self._clock.sleep(_POLL_S)
        # A wrong identity that changes, or is one bit late, comes from the bus, and not from another chip.
        right = self.KIND.identities
        if got not in right:
            again = {super(Bno055, self)._read_identity() for _ in range(_IDENTITY_READS)}
            if again & {*right, *(_late_by_one_bit(one) for one in right)} or len(again) > 1:
                raise DeviceFault(
                    f"The bus {self._registers.name} corrupts the answers of the BNO055.",
                    next_step=SLOW_BUS,
                    evidence={"identity": sorted(again | {got}), "expected": list(right)},
                )
        return got

    def _set_up(self) -> None:
        self._registers.write(_PAGE_ID, 0)
        self._registers.write(_OPR_MODE, _CONFIG_MODE)
        self._clock.sleep(_TO_CONFIG_S)
        self._registers.write(_UNIT_SEL, 0)  # m/s², °/s, °, °C
        self._registers.write(_LAST, 0)  # normal power
        self._registers.write(_OPR_MODE, _IMU_MODE)
        self._clock.sleep(_FROM_CONFIG_S)
        started_ns = self._clock.now_ns()
        while True:
            self._clock.sleep(_POLL_S)
            waited_s = seconds_between(started_ns, self._clock.now_ns())
            try:
                reading = self._read()
            except DeviceFault:
                if waited_s > _START_S:
                    raise
            else:
                # Without calibration the orientation drifts. On a moving table, calibration never completes.
                if reading.calibrated or waited_s > _LEARN_S:
                    break
        self._start_over(reading, self._clock.now_ns())

    def _start_over(self, reading: _Reading, now_ns: int) -> None:
        self._last, self._newest_ns, self._owed_deg = reading, now_ns, np.zeros(3)

    # -- the bus ------------------------------------------------------------------------------------------------------

    def _read(self) -> _Reading:
        """Read the data and the status that shows whether they are valid, in one transfer.

        I2C has no checksum. An orientation whose norm is not 1 was corrupted by the bus, and is read again.
        """
        for _ in range(_ATTEMPTS):
            block = self._registers.read(_FIRST, _LAST + 1 - _FIRST)
            orientation = np.frombuffer(block[0x0C:0x14], "<i2") / LSB_PER_QUATERNION
            status = block[0x25:]  # SYS_STATUS, SYS_ERR, UNIT_SEL, -, OPR_MODE, PWR_MODE
            mode = status[4] & 0x0F  # the upper bits are reserved
            good = (status[0], status[2], mode, status[5] & 3) == (_FUSION_RUNNING, 0, _IMU_MODE, 0)
            if good and abs(float(orientation @ orientation) - 1) < 0.01:
                calibrated = block[0x21] >> 4 & 3 == 3  # CALIB_STAT: 0 not at all, 3 fully, after some seconds at rest
                return _Reading(np.frombuffer(block[:6], "<i2") / LSB_PER_DPS, orientation, calibrated)
            self.statistics.corrupt += 1
        reset = mode == _CONFIG_MODE
        raise DeviceFault(
            "The BNO055 was reset: its supply was interrupted."
            if reset
            else "The BNO055's fusion does not run with its settings, or the bus corrupts bytes.",
            next_step="Check its supply and cable, then open the bench again."
            if reset
            else f"Open the bench again. {SLOW_BUS}",
            evidence={
                "system_status": {"got": status[0], "expected": _FUSION_RUNNING},
                "system_error": status[1],
                "unit_selection": {"got": status[2], "expected": 0},
                "operating_mode": {"got": mode, "expected": _IMU_MODE},
                "power_mode": {"got": status[5], "expected": 0},
                "orientation_norm": round(float(np.linalg.norm(orientation)), 4),
            },
        )


def _late_by_one_bit(value: int) -> int:
    """Return the value that a controller reads if it samples the first bit too early, while SDA is still high."""
    return 0x80 | value >> 1


def _rotation_deg(before: Floats, after: Floats) -> Floats:
    """Return the rotation from one orientation (w, x, y, z) to another as a vector (3,), in the sensor's axes."""
    w0, v0, w1, v1 = before[0], before[1:], after[0], after[1:]
    w = w0 * w1 + v0 @ v1
    v = w0 * v1 - w1 * v0 - np.cross(v0, v1)
    if w < 0:  # q and −q are the same orientation
        w, v = -w, -v
    size = float(np.linalg.norm(v))
    return np.asarray(np.degrees(2 * np.arctan2(size, w)) * v / size if size else np.zeros(3))
