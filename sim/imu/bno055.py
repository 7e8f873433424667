"""A register-true BNO055 for the simulated I2C bus: fusion, calibration status, start-up and mode switch times.

The behaviour follows the data sheet BST-BNO055-DS000. The register numbers are not the driver's (decision 0001).

Not simulated: the magnetometer (its modes run like the IMU mode, without north), page 1, interrupts, axis remapping,
self test, low-power modes, UART, and stretching of the clock. The fusion is the integral of the gyro about the
vertical, with a constant tilt. It measures its bias at rest, like the device.
"""

from math import cos, pi, radians, sin

import numpy as np
from numpy.typing import NDArray

from sim.imu.inertial import SimulatedImu, Words
from sim.motion import Floats
from sim.world import World

CHIP_ID, PAGE_ID, ACC_DATA, GYR_DATA, EUL_DATA, QUA_DATA, LIA_DATA, GRV_DATA = (
    0x00,
    0x07,
    0x08,
    0x14,
    0x1A,
    0x20,
    0x28,
    0x2E,
)
TEMP, CALIB_STAT, ST_RESULT, SYS_STATUS, SYS_ERR, UNIT_SEL = 0x34, 0x35, 0x36, 0x39, 0x3A, 0x3B
OPR_MODE, PWR_MODE, SYS_TRIGGER = 0x3D, 0x3E, 0x3F

CONFIG_MODE, IMU_MODE, NDOF_MODE = 0x00, 0x08, 0x0C
# BST-BNO055-DS000, table 3-5: IMU, COMPASS, M4G, NDOF_FMC_OFF, NDOF
FUSION_MODES = frozenset({IMU_MODE, 0x09, 0x0A, 0x0B, NDOF_MODE})
IDLE, SYSTEM_ERROR, FUSION_RUNNING = 0, 1, 5  # values of SYS_STATUS
RST_SYS = 0x20

SILENT_S = 0.65  # time from reset or power-up until it answers
TO_CONFIG_S, FROM_CONFIG_S = 0.019, 0.007
TICK_NS = 10_000_000  # period of the fusion
GYRO_BANDWIDTH_HZ = 32.0
GYRO_NOISIER, GYRO_TRUER = 2.8, 0.2
"""Ratio of its gyro's noise (0.014 °/s/√Hz) and zero rate (±1 °/s) to those of the bench's noise model."""
REST_TICKS, CHECK_TICKS = 100, 20  # time at rest before the sensor measures its bias, and period of the check
REST_DPS, REST_SPREAD_DPS = 3.0, 0.5

# BST-BNO055-DS000, 4.2.1: registers that the sensor only reports
_IDENTITY = {CHIP_ID: 0xA0, 0x01: 0xFB, 0x02: 0x32, 0x03: 0x0F, 0x04: 0x11, 0x05: 0x03, 0x06: 0x15}
# bits that stay when they are written; the others are read-only or fixed
_WRITABLE = {PAGE_ID: 0x01, UNIT_SEL: 0x97, PWR_MODE: 0x03, OPR_MODE: 0x0F}
_ONLY_IN_CONFIG = frozenset({UNIT_SEL, PWR_MODE})
_G = 9.80665  # BST-BNO055-DS000, 3.6.1: 100 LSB for 1 m/s²


class SimBno055(SimulatedImu):
    """The sensor, whose fusion uses the words of the distortions.

    `yaw_deg` is the rotation that its fusion has measured up to the last reading.
    """

    GYRO_NOISIER = GYRO_NOISIER

    def __init__(self, world: World, *, address: int = 0x28, chip_id: int = 0xA0) -> None:
        self.chip_id = chip_id
        super().__init__(world, address)
        self.inertial.gyro_bias_dps *= GYRO_TRUER

    @property
    def rate_hz(self) -> float:
        return 1e9 / self._tick_ns

    def power_cycle(self) -> None:
        super().power_cycle()
        self._registers[UNIT_SEL] = 0x80
        self._silent_until_ns = self._clock.now_ns() + round(SILENT_S * 1e9)
        self._switching_until_ns = 0
        self.yaw_deg = 0.0
        self._bias_dps: Floats = np.zeros(3)
        self._recent: Floats = np.empty((0, 3))
        self._begin()

    def fail(self, error: int = 0x0A) -> None:
        """Stop the fusion with a system error, as with a damaged configuration."""
        self._catch_up()
        self._registers[SYS_STATUS], self._registers[SYS_ERR] = SYSTEM_ERROR, error

    # -- bus side ---------------------------------------------------------------------------------------------------

    @property
    def answers(self) -> bool:
        """Whether it acknowledges its address; it does not during start-up."""
        return self._clock.now_ns() >= self._silent_until_ns

    stretches = True
    """It holds SCL low while it prepares an answer (BST-BNO055-DS000, 4.6)."""

    def _get(self, register: int) -> int:
        if register == CHIP_ID:
            return self.chip_id
        return _IDENTITY.get(register, self._registers[register])

    def _set(self, register: int, value: int) -> None:
        if register == SYS_TRIGGER:
            if value & RST_SYS:
                self.power_cycle()
            return
        mode = self._registers[OPR_MODE]
        switching = self._clock.now_ns() < self._switching_until_ns
        if register not in _WRITABLE or switching or (register in _ONLY_IN_CONFIG and mode != CONFIG_MODE):
            return  # lost without an error
        self._catch_up()
        self._registers[register] = value & _WRITABLE[register]
        if register == OPR_MODE and value != mode:
            taken_s = TO_CONFIG_S if value == CONFIG_MODE else FROM_CONFIG_S
            self._switching_until_ns = self._clock.now_ns() + round(taken_s * 1e9)
            self._begin()

    # -- fusion -------------------------------------------------------------------------------------------------------

    def _begin(self) -> None:
        """Start or stop the fusion after the change of the operating mode."""
        self._registers[ACC_DATA:TEMP] = bytes(TEMP - ACC_DATA)
        self._registers[CALIB_STAT] = 0
        self._registers[SYS_STATUS], self._registers[SYS_ERR] = IDLE, 0
        self._recent = np.empty((0, 3))
        self._bias_dps = np.zeros(3)
        self._sample_from(max(self._clock.now_ns(), self._switching_until_ns, self._silent_until_ns))

    def _catch_up(self) -> None:
        registers, now_ns = self._registers, self._clock.now_ns()
        if registers[OPR_MODE] not in FUSION_MODES or registers[SYS_STATUS] == SYSTEM_ERROR:
            return
        due = (now_ns - self._epoch_ns) // self._tick_ns
        if due <= self._taken:
            return
        times: NDArray[np.int64] = self._epoch_ns + self._tick_ns * np.arange(self._taken + 1, due + 1)
        self._taken = due
        gyro, accel = self._distorted(*self.inertial.sample(times, 1e9 / TICK_NS, GYRO_BANDWIDTH_HZ))
        up = self.inertial.up
        begun = due - len(gyro)
        cuts = range(begun - begun % CHECK_TICKS + CHECK_TICKS, due + 1, CHECK_TICKS)
        parts = np.split(gyro, [cut - begun for cut in cuts])
        for i, part in enumerate(parts):
            self.yaw_deg += float(((part - self._bias_dps) @ up).sum()) * TICK_NS * 1e-9
            self._recent = np.concatenate([self._recent, part])[-REST_TICKS:]
            if i < len(cuts):
                self._learn_bias()
        registers[SYS_STATUS] = FUSION_RUNNING
        self._show(gyro[-1] - self._bias_dps, accel[-1])

    @property
    def _tick_ns(self) -> int:
        return round(TICK_NS / (1 + self.clock_error))

    def _distorted(self, gyro: Floats, accel: Floats) -> tuple[Floats, Floats]:
        if not self.distortions:
            return gyro, accel
        values = np.zeros((len(gyro), 7))
        values[:, :3], values[:, 4:] = accel * 1000.0, gyro * 16.0
        words: Words = np.clip(np.rint(values), -32768, 32767).astype(">i2")
        for distort in self.distortions:
            words = distort(words)
        return words[:, 4:] / 16.0, words[:, :3] / 1000.0

    def _learn_bias(self) -> None:
        if len(self._recent) < REST_TICKS:
            return
        recent = self._recent
        if np.abs(recent.mean(axis=0)).max() < REST_DPS and np.ptp(recent, axis=0).max() < 2 * REST_SPREAD_DPS:
            self._bias_dps = recent.mean(axis=0)
            self._registers[CALIB_STAT] = 0x30  # the gyro's bits; in the IMU mode the others do not change

    def _show(self, rate_dps: Floats, accel_g: Floats) -> None:
        """Update the data registers; UNIT_SEL selects the units."""
        units = self._registers[UNIT_SEL]
        force = accel_g * (1000.0 if units & 0x01 else _G * 100.0)
        gravity = self.inertial.up * (1000.0 if units & 0x01 else _G * 100.0)
        rate = rate_dps * (radians(1.0) * 900.0 if units & 0x02 else 16.0)
        angle = 900.0 * radians(1.0) if units & 0x04 else 16.0
        heading_deg = -self.yaw_deg % 360.0  # a clockwise rotation increases it
        words = np.zeros(22)
        words[0:3], words[6:9], words[9] = force, rate, heading_deg * angle
        words[12:16] = self._quaternion() * 2**14
        words[16:19], words[19:22] = force - gravity, gravity
        self._registers[ACC_DATA:TEMP] = np.clip(np.rint(words), -32768, 32767).astype("<i2").tobytes()
        self._registers[TEMP] = round(self.temperature_c) & 0xFF

    def _quaternion(self) -> Floats:
        """Return the orientation as w, x, y, z: the tilt of this part, then the yaw about the vertical."""
        x, y, z = self.inertial.up
        half = np.array([1.0 + z, y, -x, 0.0])  # rotates the sensor's vertical to the world's
        tilt = half / np.linalg.norm(half)
        c, s = cos(self.yaw_deg * pi / 360), sin(self.yaw_deg * pi / 360)
        w, i, j, k = tilt
        return np.array([c * w - s * k, c * i - s * j, c * j + s * i, c * k + s * w])
