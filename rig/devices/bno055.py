"""The BNO055 on an I2C bus of the computer: a gyro whose own fusion carries the rotation from one reading to the next.

Registers and times: BST-BNO055-DS000. It is used in its IMU mode (gyro and accelerometer, no magnetometer: servo and
steel bend the north). It has no FIFO; what happens between two readings is known by the orientation that it integrates
itself, as long as that turns by less than half a revolution meanwhile.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rig.core.clock import Clock, seconds_between
from rig.core.errors import DeviceFault, DeviceMismatch, DeviceSilent
from rig.devices.i2c import I2cRegisters, I2cStatistics
from rig.devices.imu import ImuIdentity, ImuSamples

Floats = NDArray[np.float64]

EXPECTED_ID = 0xA0
NOISE_DPS_RTHZ = 0.014
RATE_HZ, RANGE_DPS = 100.0, 2000.0
LSB_PER_DPS, LSB_PER_MS2, LSB_PER_HEADING_DEG, LSB_PER_QUATERNION = 16.0, 100.0, 16.0, 16384.0
OTHERS = {
    0x00: "nothing that drives the bus: SDA held low, or a missing ground",
    0xFF: "nothing that drives the bus: SDA is not connected",
    0xFB: "a BNO055 whose registers are read one too far: a bus that loses clocks",
}

_CHIP_ID, _PAGE_ID, _ACC_DATA, _FIRST, _EUL_DATA, _TEMP = 0x00, 0x07, 0x08, 0x14, 0x1A, 0x34
_UNIT_SEL, _OPR_MODE, _LAST = 0x3B, 0x3D, 0x3E
_CONFIG_MODE, _IMU_MODE, _FUSION_RUNNING = 0x00, 0x08, 5
_TO_CONFIG_S, _FROM_CONFIG_S = 0.02, 0.01
"""Mode switches of 19 and 7 ms (3.3), and some."""
_START_S, _POLL_S = 1.2, 0.05
"""It is silent for 650 ms after power-up (1.2), and its fusion takes some more."""
_LEARN_S = 3.0
"""Longest time that the gyro's calibration is waited for."""
_GAP_S = 0.5
"""Longest time between two readings: at the table's fastest (200 °/s) it turns by 100° meanwhile."""
_CARRIED_DEG = 0.01
"""Difference between orientation and rate that is left to the next reading: the orientation's own resolution."""
_ORIENTATION_AGE_S = 0.015
"""How old an orientation may be: a period of the fusion, and the reading."""
_G = 9.80665


@dataclass(frozen=True, slots=True)
class Bno055Calibration:
    """How well the sensor says it is calibrated: 0 not at all, 3 fully. Without magnetometer only ``gyro`` matters."""

    system: int
    gyro: int
    accelerometer: int
    magnetometer: int


@dataclass(frozen=True, slots=True)
class _Reading:
    """The registers from the gyro's to the power mode, all of one transfer."""

    gyro_dps: Floats
    orientation: Floats
    calibration: Bno055Calibration


class Bno055:
    """A BNO055 as a `rig.devices.imu.Imu`.

    Its samples follow the gyro at its readings, and add up to the rotation of the orientation: between two readings
    that are further apart than the gyro's period they are an interpolation. So it must be read while the table moves,
    as the control loop does, for its rates to be true at their times.

    Parameters
    ----------
    bus
        Number of the I2C bus, or the path of its device file.
    address
        0x28, or 0x29 with ADR high.
    clock
        The bench's clock.

    Raises
    ------
    DeviceNotFound
        When the bus cannot be opened, or nobody acknowledges the address, a second after power-up either.
    DeviceMismatch
        When something else answers there.
    DeviceFault
        When its fusion does not run, or it does not keep its settings.
    """

    _last: _Reading
    _newest_ns: int
    _owed_deg: Floats

    def __init__(self, bus: int | str, *, clock: Clock, address: int = 0x28) -> None:
        self._clock = clock
        self._wire = I2cRegisters(bus, address, clock)
        self._period_ns = round(1e9 / RATE_HZ)
        try:
            self.identity = self._identify()
            self._set_up()
        except BaseException:
            self.close()
            raise

    @property
    def statistics(self) -> I2cStatistics:
        return self._wire.statistics

    @property
    def rate_hz(self) -> float:
        return RATE_HZ

    @property
    def range_dps(self) -> float:
        return RANGE_DPS

    def close(self) -> None:
        self._wire.close()

    def read_samples(self) -> ImuSamples:
        """Return samples for the time since the last call.

        Raises
        ------
        DeviceSilent
            When the sensor does not answer, after retries.
        DeviceFault
            When it was reset, its fusion stopped, or what it says cannot be.
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
        share = np.arange(1, count + 1) / count
        time_ns = self._newest_ns + np.rint((now_ns - self._newest_ns) * share).astype(np.int64)
        gyro = self._last.gyro_dps + (reading.gyro_dps - self._last.gyro_dps) * (share - 0.5 / count)[:, None]
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
        return np.frombuffer(self._wire.read(_ACC_DATA, 6), "<i2") / (LSB_PER_MS2 * _G)

    def temperature_c(self) -> float:
        """Return the temperature of the sensor's die; raises as `read_samples` does."""
        self._read()
        return float(int.from_bytes(self._wire.read(_TEMP, 1), "little", signed=True))

    def heading_deg(self) -> float:
        """Return the fusion's own heading, counter-clockwise, from where it was at power-up; 0..360."""
        self._read()
        clockwise = int.from_bytes(self._wire.read(_EUL_DATA, 2), "little", signed=True) / LSB_PER_HEADING_DEG
        return -clockwise % 360.0

    def calibration(self) -> Bno055Calibration:
        """Return the calibration status; the gyro's reaches 3 after some seconds of rest."""
        return self._read().calibration

    # -- setting up ---------------------------------------------------------------------------------------------------

    def _identify(self) -> ImuIdentity:
        give_up_ns = self._clock.now_ns() + round(_START_S * 1e9)
        while True:
            try:
                got = self._wire.read(_CHIP_ID, 1)[0]
                break
            except DeviceSilent as silent:
                if self._clock.now_ns() > give_up_ns:
                    raise self._wire.nobody(silent, "ADR pin (low 0x28, high 0x29)") from silent
                self._clock.sleep(_POLL_S)
        address, bus = self._wire.address, self._wire.name
        if got != EXPECTED_ID:
            likely = OTHERS.get(got, "another chip; a BNO080 or BNO085 speaks another language at nearby addresses")
            raise DeviceMismatch(
                f"CHIP_ID at I2C address {address:#04x} of {bus} is {got:#04x}, expected {EXPECTED_ID:#04x} (BNO055): "
                f"probably {likely}",
                next_step="Check the wiring, or give the address and model of the sensor (imu.address, imu.model).",
                evidence={"got": got, "expected": EXPECTED_ID},
            )
        return ImuIdentity("BNO055", address, got, NOISE_DPS_RTHZ)

    def _set_up(self) -> None:
        self._wire.write(_PAGE_ID, 0)
        self._wire.write(_OPR_MODE, _CONFIG_MODE)
        self._clock.sleep(_TO_CONFIG_S)
        self._wire.write(_UNIT_SEL, 0)  # m/s², °/s, °, °C
        self._wire.write(_LAST, 0)  # normal power
        self._wire.write(_OPR_MODE, _IMU_MODE)
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
                # Until it has learned its zero it turns by itself. On a table that does not rest it never will.
                if reading.calibration.gyro == 3 or waited_s > _LEARN_S:
                    break
        self._start_over(reading, self._clock.now_ns())

    def _start_over(self, reading: _Reading, now_ns: int) -> None:
        self._last, self._newest_ns, self._owed_deg = reading, now_ns, np.zeros(3)

    # -- the bus ------------------------------------------------------------------------------------------------------

    def _read(self) -> _Reading:
        """Read everything that makes a reading, and that says whether to believe it, in one transfer.

        I2C has no checksum; an orientation that is no rotation was spoiled on its way, and is read once more.
        """
        for _ in range(2):
            block = self._wire.read(_FIRST, _LAST + 1 - _FIRST)
            orientation = np.frombuffer(block[0x0C:0x14], "<i2") / LSB_PER_QUATERNION
            status = block[0x25:]  # SYS_STATUS, SYS_ERR, UNIT_SEL, -, OPR_MODE, PWR_MODE
            mode = status[4] & 0x0F  # the upper bits are reserved
            good = (status[0], status[2], mode, status[5] & 3) == (_FUSION_RUNNING, 0, _IMU_MODE, 0)
            if good and abs(float(orientation @ orientation) - 1) < 0.01:
                stat = block[0x21]
                calibration = Bno055Calibration(stat >> 6, stat >> 4 & 3, stat >> 2 & 3, stat & 3)
                return _Reading(np.frombuffer(block[:6], "<i2") / LSB_PER_DPS, orientation, calibration)
        reset = mode == _CONFIG_MODE
        raise DeviceFault(
            "the BNO055 was reset: its supply was interrupted"
            if reset
            else "the BNO055's fusion does not run as it was set up, or the bus corrupts bytes",
            next_step="Check its supply and cable, then open the bench again."
            if reset
            else "Open the bench again. On a Raspberry Pi the BNO055 needs a slow bus (it stretches the clock): "
            "dtparam=i2c_arm_baudrate=10000, or a software bus (i2c-gpio).",
            evidence={
                "system_status": {"got": status[0], "expected": _FUSION_RUNNING},
                "system_error": status[1],
                "unit_selection": {"got": status[2], "expected": 0},
                "operating_mode": {"got": mode, "expected": _IMU_MODE},
                "power_mode": {"got": status[5], "expected": 0},
                "orientation_norm": round(float(np.linalg.norm(orientation)), 4),
            },
        )


def _rotation_deg(before: Floats, after: Floats) -> Floats:
    """Return the rotation from one orientation (w, x, y, z) to another as a vector (3,), in the sensor's axes."""
    w0, v0, w1, v1 = before[0], before[1:], after[0], after[1:]
    w = w0 * w1 + v0 @ v1
    v = w0 * v1 - w1 * v0 - np.cross(v0, v1)
    if w < 0:  # an orientation has two signs
        w, v = -w, -v
    size = float(np.linalg.norm(v))
    return np.asarray(np.degrees(2 * np.arctan2(size, w)) * v / size if size else np.zeros(3))
