"""A register-true MPU-6050 for the simulated I2C bus, and the sensors with its registers.

The behaviour follows the register map RM-MPU-6000A rev 4.2 and the product specification PS-MPU-6000A rev 3.4; for the
MPU-6500 and the MPU-9250, RM-MPU-6500A, PS-MPU-6500A, RM-MPU-9250A and PS-MPU-9250A. The register
numbers are not the driver's (decision 0001).

Not simulated: the auxiliary bus, motion detection, self test, the cycle and single-axis standby modes, interrupts
except that of a new sample, the signal paths' reset, the motion processor, and start-up times; the bypass of the
low-pass and the separate low-pass of the accelerometer (MPU-6500); the magnetometer (MPU-9250). The low-pass is of
second order, and the accelerometer has the gyro's rate and bandwidth.
"""

from typing import ClassVar

import numpy as np

from sim.imu.inertial import SimulatedImu, Words
from sim.motion import Floats
from sim.world import World

SMPLRT_DIV, CONFIG, GYRO_CONFIG, ACCEL_CONFIG, FIFO_EN = 0x19, 0x1A, 0x1B, 0x1C, 0x23
INT_ENABLE, INT_STATUS, ACCEL_XOUT_H, GYRO_ZOUT_L = 0x38, 0x3A, 0x3B, 0x48
USER_CTRL, PWR_MGMT_1 = 0x6A, 0x6B
FIFO_COUNTH, FIFO_COUNTL, FIFO_R_W, WHO_AM_I = 0x72, 0x73, 0x74, 0x75

DATA_RDY, FIFO_OFLOW = 0x01, 0x10
DEVICE_RESET, SLEEP = 0x80, 0x40
FIFO_ENABLED, FIFO_RESET, SIG_COND_RESET = 0x40, 0x04, 0x01

LSB_PER_DPS = (131.0, 65.5, 32.8, 16.4)  # RM-MPU-6000A, 4.19 and 4.17: by FS_SEL and AFS_SEL
LSB_PER_G = (16384.0, 8192.0, 4096.0, 2048.0)
BANDWIDTH_HZ = (256.0, 188.0, 98.0, 42.0, 20.0, 10.0, 5.0, 256.0)
"""Bandwidth of the gyro by DLPF_CFG; 7 is reserved and treated as 0."""

_WRITABLE = {  # the bits that can be written; all others read as 0
    **dict.fromkeys((0x0D, 0x0E, 0x0F, 0x10, SMPLRT_DIV, 0x1F, FIFO_EN, 0x6C), 0xFF),
    **dict.fromkeys((GYRO_CONFIG, ACCEL_CONFIG), 0xF8),
    CONFIG: 0x3F,
    0x37: 0xFE,  # INT_PIN_CFG
    INT_ENABLE: 0x19,
    0x69: 0x30,  # MOT_DETECT_CTRL
    USER_CTRL: 0x70,
    PWR_MGMT_1: 0x6F,
}
_SAMPLING = {SMPLRT_DIV, CONFIG, PWR_MGMT_1}

# FIFO_EN's bits in the order of the words in the data registers (accel x, y, z, temperature, gyro x, y, z), which is
# also the order in which a sample enters the FIFO.
_FIFO_BITS = (0x08, 0x08, 0x08, 0x80, 0x40, 0x20, 0x10)


class SimMpu6050(SimulatedImu):
    """The sensor; ``who_am_i`` is another one for a clone."""

    IDENTITY: ClassVar[int] = 0x68
    FIFO_SIZE: ClassVar[int] = 1024  # bytes
    AFTER_RESET: ClassVar[int] = SLEEP
    """Value of PWR_MGMT_1."""
    BANDWIDTH_HZ: ClassVar[tuple[float, ...]] = BANDWIDTH_HZ
    LSB_PER_C: ClassVar[float] = 340.0  # RM-MPU-6000A, 4.18
    ZERO_C: ClassVar[float] = 36.53
    SELF_TEST_DPS: ClassVar[tuple[float, float, float]] = (58.0, -58.0, 58.0)
    """Change of the gyro's reading during its self-test (PS 6.1, RM 4.1: 25 to 101 °/s by the factory trim)."""
    STAYS = FIFO_R_W

    def __init__(self, world: World, *, address: int = 0x68, who_am_i: int | None = None) -> None:
        self.who_am_i = self.IDENTITY if who_am_i is None else who_am_i
        self.self_test_dps = np.array(self.SELF_TEST_DPS)
        super().__init__(world, address)

    @property
    def rate_hz(self) -> float:
        return self._internal_clock()[0] / (1 + self._registers[SMPLRT_DIV]) * (1 + self.clock_error)

    def power_cycle(self) -> None:
        super().power_cycle()
        self._registers[PWR_MGMT_1] = self.AFTER_RESET
        self._fifo = bytearray()
        self._last_popped = 0
        self._sample_from(self._clock.now_ns())

    def next_edge_ns(self, after_ns: int) -> int | None:
        """Return the time of the interrupt pin's next edge after ``after_ns``: at each sample, if enabled."""
        if self._registers[PWR_MGMT_1] & SLEEP or not self._registers[INT_ENABLE] & DATA_RDY:
            return None
        period_ns = self._internal_clock()[1] * (1 + self._registers[SMPLRT_DIV])
        return self._epoch_ns + max((after_ns - self._epoch_ns) // period_ns + 1, 1) * period_ns

    # -- bus side -------------------------------------------------------------------------------------------------

    def read(self, count: int) -> bytes:
        # Once for each burst: its bytes belong to one sample. Those that wait in the FIFO need no later samples.
        if self._pointer != FIFO_R_W or count > len(self._fifo) or self._overflows():
            self._catch_up()
        answer = bytearray()
        while len(answer) < count:
            if self._pointer == FIFO_R_W:
                answer += self._pop(count - len(answer))
            else:
                answer.append(self._get(self._pointer))
                self._advance()
        return bytes(answer)

    def _get(self, register: int) -> int:
        if register == WHO_AM_I:
            return self.who_am_i
        if register == FIFO_COUNTH:  # reading it latches both bytes
            self._registers[FIFO_COUNTH : FIFO_COUNTL + 1] = len(self._fifo).to_bytes(2, "big")
        value = self._registers[register]
        if register == INT_STATUS:
            self._registers[INT_STATUS] = 0
        return value

    def _set(self, register: int, value: int) -> None:
        if register == PWR_MGMT_1 and value & DEVICE_RESET:
            self.power_cycle()
            return
        self._catch_up()  # with the settings before the write
        changed = (self._registers[register] ^ value) & _WRITABLE.get(register, 0)
        self._registers[register] ^= changed
        if register == USER_CTRL:
            if value & FIFO_RESET and not value & FIFO_ENABLED:
                self._fifo.clear()
            if value & SIG_COND_RESET:
                self._registers[ACCEL_XOUT_H : GYRO_ZOUT_L + 1] = bytes(GYRO_ZOUT_L + 1 - ACCEL_XOUT_H)
        elif register in _SAMPLING and changed:
            self._sample_from(self._clock.now_ns())

    def _pop(self, count: int) -> bytes:
        taken = bytes(self._fifo[:count])
        del self._fifo[:count]
        self._last_popped = taken[-1] if taken else self._last_popped
        return taken.ljust(count, bytes([self._last_popped]))  # an empty FIFO repeats its last byte

    # -- sampling -------------------------------------------------------------------------------------------------

    def _internal_clock(self) -> tuple[int, int]:
        """Return the nominal rate (Hz) before the divider, and the true period (ns)."""
        internal_hz = 8000 if self._registers[CONFIG] & 0x07 in (0, 7) else 1000
        return internal_hz, round(1e9 / internal_hz / (1 + self.clock_error))

    def _due(self) -> int:
        """Return the number of samples since the settings changed."""
        if self._registers[PWR_MGMT_1] & SLEEP:
            return self._taken
        period_ns = self._internal_clock()[1] * (1 + self._registers[SMPLRT_DIV])
        return (self._clock.now_ns() - self._epoch_ns) // period_ns

    def _overflows(self) -> bool:
        """Return whether the samples that are due may not fit into the FIFO."""
        return len(self._fifo) + 2 * len(_FIFO_BITS) * (self._due() - self._taken) > self.FIFO_SIZE

    def _catch_up(self) -> None:
        due = self._due()
        if due == self._taken:
            return
        registers = self._registers
        filter_setting, decimation = registers[CONFIG] & 0x07, 1 + registers[SMPLRT_DIV]
        internal_hz, tick_ns = self._internal_clock()
        first = max(self._taken, due - self.FIFO_SIZE // 2)  # the size of the FIFO: a frame has at least one word
        self._taken = due
        ticks = np.arange(first * decimation + 1, due * decimation + 1)
        times_ns = self._epoch_ns + tick_ns * ticks
        gyro, accel = self.inertial.sample(times_ns, internal_hz, self.BANDWIDTH_HZ[filter_setting])
        kept = slice(decimation - 1, None, decimation)
        die_c = self.temperature_c + self.inertial.warmth_c(times_ns[kept])
        words = self._quantised(gyro[kept], accel[kept], die_c)
        for distort in self.distortions:
            words = distort(words)
        registers[ACCEL_XOUT_H : GYRO_ZOUT_L + 1] = words[-1].tobytes()
        registers[INT_STATUS] |= DATA_RDY
        chosen = [i for i, bit in enumerate(_FIFO_BITS) if registers[FIFO_EN] & bit]
        if chosen and registers[USER_CTRL] & FIFO_ENABLED:
            self._fifo += words[:, chosen].tobytes()
            if len(self._fifo) > self.FIFO_SIZE:
                del self._fifo[: -self.FIFO_SIZE]
                registers[INT_STATUS] |= FIFO_OFLOW

    def _quantised(self, gyro: Floats, accel: Floats, die_c: Floats) -> Words:
        """Return the samples (n, 7) as the big-endian words of the data registers, saturated."""
        under_test = [self._registers[GYRO_CONFIG] >> bit & 1 for bit in (7, 6, 5)]  # XG_ST, YG_ST, ZG_ST
        gyro = gyro + np.array(under_test) * self.self_test_dps
        values = np.empty((len(gyro), 7))
        values[:, :3] = accel * LSB_PER_G[self._registers[ACCEL_CONFIG] >> 3 & 3]
        values[:, 3] = (die_c - self.ZERO_C) * self.LSB_PER_C
        values[:, 4:] = gyro * LSB_PER_DPS[self._registers[GYRO_CONFIG] >> 3 & 3]
        words: Words = np.minimum(np.maximum(np.rint(values), -32768), 32767).astype(">i2")
        return words


class SimMpu6500(SimMpu6050):
    """An MPU-6500: a FIFO of 512 bytes, awake after a reset, and another scale of the temperature."""

    IDENTITY = 0x70
    FIFO_SIZE = 512
    AFTER_RESET = 0x01
    BANDWIDTH_HZ = (250.0, 184.0, 92.0, 41.0, 20.0, 10.0, 5.0, 3600.0)
    LSB_PER_C, ZERO_C = 333.87, 21.0
    GYRO_NOISIER = 2.0  # 0.01 °/s/√Hz


class SimMpu9250(SimMpu6500):
    """An MPU-9250, without its magnetometer."""

    IDENTITY = 0x71


class SimMpu6050Clone(SimMpu6050):
    """A clone of the MPU-6050: it has the MPU-6050's registers and the FIFO of an MPU-6500."""

    IDENTITY = 0x72
    FIFO_SIZE = 512
    GYRO_NOISIER = 2.0
