"""The signals of an inertial sensor on the platter and their errors, for any chip."""

from abc import abstractmethod
from collections.abc import Callable
from functools import cache
from math import cos, inf, pi, radians, sin, sqrt, tan
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from sim.motion import Floats
from sim.world import World

WARM_UP_S = 300.0  # time constant of the warming of a sensor on a small board in still air
FLICKER_NS = 100_000_000  # step of the flicker noise
Words = np.ndarray[tuple[int, int], np.dtype[np.int16]]

_BLOCK = 64  # samples that are filtered together
# With time constants a factor 4 apart, the standard deviation of each part is the Allan deviation of the sum.
_FLICKER_STEPS = 1e9 / FLICKER_NS * 4.0 ** np.arange(6)[:, None]


class InertialModel:
    """Rate and specific force at the sensor of one part, drawn from the world's noise model.

    The rate is that of the table about the vertical, which is tilted in the sensor's axes by the mounting. It is
    averaged over each internal sample, so that even a short knock is measured. It has a scale error for each axis, a
    bias with a random walk, flicker noise and a dependence on the sensor's temperature, and white noise of the given
    one-sided density. The force is gravity with a bias and white noise. Both pass a second-order Butterworth low-pass.
    The centripetal and tangential acceleration of a sensor off the axis is left out (1 cm at 90 °/s: 2.5 mg).

    ``world`` provides the motion, the noise model, and the streams ``name-part`` (drawn once), ``name-noise`` and
    ``name-flicker``. ``gyro_noisier`` is the ratio of its gyro's noise density to that of the noise model.
    """

    def __init__(self, world: World, name: str, gyro_noisier: float = 1.0) -> None:
        noise, part = world.noise, world.rng(f"{name}-part")
        self._world = world
        self._rng = world.rng(f"{name}-noise")
        self.gyro_bias_dps: Floats = noise.gyro_bias_dps * part.standard_normal(3)
        self.gyro_gain: Floats = 1 + noise.gyro_scale_error * part.standard_normal(3)
        self.accel_bias_g: Floats = noise.accel_bias_g * part.standard_normal(3)
        roll, pitch = (radians(noise.imu_tilt_deg * z) for z in part.standard_normal(2))
        self.up: Floats = np.array([-sin(pitch), sin(roll) * cos(pitch), cos(roll) * cos(pitch)])
        """float64 (3,): the vertical in the sensor's axes."""
        self.gyro_slope_dps_c: Floats = noise.gyro_bias_slope_dps_c * part.standard_normal(3)
        """float64 (3,): the true values, for tests. The random walk of the gyro's bias continues from its value; the
        bias also grows by the slope for each degree of warming."""
        self._powered_ns = world.clock.now_ns()
        self._flicker_rng = world.rng(f"{name}-flicker")
        self._flicker_dps: Floats = gyro_noisier * np.broadcast_to(noise.gyro_flicker_dps, 3)
        self._flicker, self._flicker_step = np.zeros((len(_FLICKER_STEPS), 3)), -inf
        density = gyro_noisier * np.broadcast_to(noise.gyro_noise_dps_rthz, 3)
        self._density: Floats = np.concatenate([density, np.repeat(noise.accel_noise_g_rthz, 3)])
        self.restart()

    def restart(self) -> None:
        """Start sampling now with an empty filter, after sleep or a change of settings."""
        self._last_ns = self._world.clock.now_ns()
        self._last_deg = self._world.table_deg()
        self._filter_state: tuple[Floats, Floats] | None = None

    def warmth_c(self, times_ns: NDArray[np.int64]) -> Floats:
        """Return the sensor's temperature above its surroundings at the given times, (n,)."""
        since_s = np.maximum(times_ns - self._powered_ns, 0) * 1e-9
        return -self._world.noise.imu_warm_up_c * np.expm1(-since_s / WARM_UP_S)

    def sample(self, times_ns: NDArray[np.int64], rate_hz: float, bandwidth_hz: float) -> tuple[Floats, Floats]:
        """Return rate (°/s) and specific force (g), each (n, 3), at consecutive internal sample times.

        The result does not depend on how the samples are divided among calls. If samples before the first of
        ``times_ns`` are left out, the first sample has the mean rate of that time.
        """
        n = len(times_ns)
        draws = self._rng.standard_normal((n, 9))
        elapsed_s = _steps(self._last_ns, times_ns) * 1e-9

        bias = self._world.noise.gyro_bias_walk_dps_rts * np.sqrt(elapsed_s)[:, None] * draws[:, 6:]
        bias[0] += self.gyro_bias_dps
        np.cumsum(bias, axis=0, out=bias)

        angle_deg = self._world.table_angles(times_ns)
        rate_dps = _steps(self._last_deg, angle_deg) / elapsed_s

        felt = np.empty((n, 6))
        felt[:, :3] = rate_dps[:, None] * (self.gyro_gain * self.up) + bias
        felt[:, :3] += self.warmth_c(times_ns)[:, None] * self.gyro_slope_dps_c
        if self._flicker_dps.any():
            felt[:, :3] += self._flicker_at(times_ns)
        felt[:, 3:] = self.up + self.accel_bias_g
        before, filtered_before = self._filter_state or (felt[[0, 0]],) * 2
        felt += self._density * sqrt(rate_hz / 2) * draws[:, :6]
        felt = np.concatenate([before, felt])
        filtered = np.concatenate([filtered_before, _filtered(felt, filtered_before, rate_hz, bandwidth_hz)])
        self._filter_state = felt[-2:], filtered[-2:]
        filtered = filtered[2:]

        self.gyro_bias_dps = bias[-1]
        self._last_ns, self._last_deg = int(times_ns[-1]), float(angle_deg[-1])
        return filtered[:, :3], filtered[:, 3:]

    def _flicker_at(self, times_ns: NDArray[np.int64]) -> Floats:
        """Return the flicker noise of the rate, (n, 3): a sum of first-order processes, constant within each step."""
        steps = times_ns // FLICKER_NS
        values: list[Floats] = []
        for step in range(int(steps[0]), int(steps[-1]) + 1):
            if step > self._flicker_step:
                kept = np.exp((self._flicker_step - step) / _FLICKER_STEPS)
                drawn = self._flicker_rng.standard_normal(self._flicker.shape)
                self._flicker, self._flicker_step = kept * self._flicker + np.sqrt(1 - kept**2) * drawn, step
            values.append(self._flicker.sum(axis=0))
        flicker: Floats = self._flicker_dps * np.array(values)[steps - steps[0]]
        return flicker


@cache
def _low_pass(rate_hz: float, bandwidth_hz: float) -> tuple[float, float, float, Floats]:
    """Return b₀, a₁ and a₂ of a Butterworth low-pass of second order (bilinear transform), and its response matrix.

    b₁ = 2b₀, b₂ = b₀. The matrix (`_BLOCK`, `_BLOCK`) is the response of the recursion to a block of samples.
    """
    k = tan(pi * bandwidth_hz / rate_hz)
    norm = 1 / (1 + sqrt(2) * k + k * k)
    a1, a2 = 2 * (k * k - 1) * norm, (1 - sqrt(2) * k + k * k) * norm
    response = np.eye(_BLOCK)
    for row in range(1, _BLOCK):
        response[row] -= a1 * response[row - 1] + (a2 * response[row - 2] if row > 1 else 0.0)
    return k * k * norm, a1, a2, response


def _filtered(felt: Floats, filtered_before: Floats, rate_hz: float, bandwidth_hz: float) -> Floats:
    """Return the low-pass of ``felt`` (n + 2, 6) from its third row, (n, 6); the first two rows belong to earlier ones.

    y[n] + a₁·y[n−1] + a₂·y[n−2] = b₀·(x[n] + 2x[n−1] + x[n−2]), solved block by block: importing scipy's filters would
    take longer than all other imports of the simulator.
    """
    b0, a1, a2, response = _low_pass(rate_hz, bandwidth_hz)
    right = b0 * (felt[2:] + 2 * felt[1:-1] + felt[:-2])
    done = filtered_before
    for start in range(0, len(right), _BLOCK):
        block = right[start : start + _BLOCK]
        block[0] -= a1 * done[-1] + a2 * done[-2]
        block[1:2] -= a2 * done[-1]
        done = np.concatenate([done, response[: len(block), : len(block)] @ block])
    return done[2:]


def _steps(before: float, values: NDArray[np.int64] | Floats) -> Floats:
    """Return the differences of consecutive values; ``before`` is the value before the first."""
    steps = np.empty(len(values))
    steps[0], steps[1:] = values[0] - before, values[1:] - values[:-1]
    return steps


class SimulatedImu:
    """A sensor on the platter with numbered registers; an `sim.i2c.I2cDevice`.

    Interface to the bench and its faults, besides that to the bus:
    """

    GYRO_NOISIER: ClassVar[float] = 1.0
    """Ratio of its gyro's noise to that of the bench's noise model."""
    STAYS: ClassVar[int | None] = None
    """The register after which the next one is the same."""

    def __init__(self, world: World, address: int) -> None:
        self.address = address
        self.inertial = InertialModel(world, f"imu-{address:02x}", gyro_noisier=self.GYRO_NOISIER)
        """Bias, gain, vertical and warming of this part."""
        self.temperature_c = 25.0
        """Temperature of its surroundings."""
        self.clock_error = 0.0
        """Relative error of its clock, positive if it is fast; set it before the sensor wakes, or by `run_clock`."""
        self.distortions: list[Callable[[Words], Words]] = []
        """Each receives the words of samples, int16 (n, 7): accelerometer x, y, z, temperature, gyro x, y, z. It
        returns the words that the sensor delivers."""
        self._clock = world.clock
        self.power_cycle()

    @property
    @abstractmethod
    def rate_hz(self) -> float:
        """Samples per second of the world's clock."""

    def power_cycle(self) -> None:
        """Lose all registers, as after a brown-out or a reset."""
        self._registers = bytearray(0x80)
        self._pointer, self._pointed = 0, True

    def run_clock(self, error: float) -> None:
        """Set the relative error of its clock."""
        self._catch_up()
        self.clock_error = error
        self._sample_from(self._clock.now_ns())

    # -- bus side -----------------------------------------------------------------------------------------------------

    def start(self, reading: bool) -> None:
        self._pointed = reading  # a write starts with the register's number, a read continues at the pointer

    def write(self, data: bytes) -> int:
        acknowledged = len(data)
        if data and not self._pointed:
            self._pointer, self._pointed = data[0] & 0x7F, True
            data = data[1:]
        for byte in data:
            self._set(self._pointer, byte)
            self._advance()
        return acknowledged

    def read(self, count: int) -> bytes:
        self._catch_up()
        answer = bytearray()
        for _ in range(count):
            answer.append(self._get(self._pointer))
            self._advance()
        return bytes(answer)

    def stop(self) -> None: ...

    def _advance(self) -> None:
        if self._pointer != self.STAYS:
            self._pointer = (self._pointer + 1) & 0x7F

    @abstractmethod
    def _get(self, register: int) -> int: ...

    @abstractmethod
    def _set(self, register: int, value: int) -> None: ...

    # -- sampling -----------------------------------------------------------------------------------------------------

    def _sample_from(self, time_ns: int) -> None:
        """Take the samples of the present settings from a time on."""
        self._epoch_ns, self._taken = time_ns, 0
        self.inertial.restart()

    @abstractmethod
    def _catch_up(self) -> None:
        """Take the samples that are due since the last call."""
