"""What an inertial sensor on the platter feels and how it errs, whatever chip it is."""

from math import cos, exp, pi, radians, sin, sqrt

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from sim.motion import Floats
from sim.world import World

_GRAVITY_G = 1.0


class InertialModel:
    """Rate and specific force at the sensor of one part, drawn from the world's noise model.

    The rate is the table's, about the vertical as the mounting tilt shows it to the sensor, with a scale error for each
    axis, a bias that walks, and white noise; the force is gravity with a bias and white noise. Left out: the
    centripetal and tangential acceleration of a sensor off the axis (1 cm at 90 °/s: 2.5 mg).

    Signal and noise pass a first-order low-pass. White noise of one-sided density n that enters it at the chip's
    internal rate comes out as a first-order autoregression, and stays one when only every d-th value is kept: so the
    samples carry the noise of the filter's bandwidth, and their integral what folds down from above half the sample
    rate. The signal is filtered with the same time constant at the sample rate, which keeps its integral.

    Parameters
    ----------
    world
        Gives the motion, the noise model, and the streams ``name-part`` (drawn once) and ``name-noise``.
    name
        Of the sensor.

    Attributes
    ----------
    up : float64 (3,)
        The vertical in the sensor's axes.
    gyro_gain, gyro_bias_dps, accel_bias_g : float64 (3,)
        Truth that tests compare with and may set; the gyro's bias walks on from it.
    """

    def __init__(self, world: World, name: str) -> None:
        noise, part = world.noise, world.rng(f"{name}-part")
        self._world = world
        self._rng = world.rng(f"{name}-noise")
        self.gyro_bias_dps: Floats = noise.gyro_bias_dps * part.standard_normal(3)
        self.gyro_gain: Floats = 1 + noise.gyro_scale_error * part.standard_normal(3)
        self.accel_bias_g: Floats = noise.accel_bias_g * part.standard_normal(3)
        roll, pitch = (radians(noise.imu_tilt_deg * z) for z in part.standard_normal(2))
        self.up: Floats = np.array([-sin(pitch), sin(roll) * cos(pitch), cos(roll) * cos(pitch)])
        self._density: Floats = np.repeat([noise.gyro_noise_dps_rthz, noise.accel_noise_g_rthz], 3)
        self._last_ns = world.clock.now_ns()
        self._filtered: Floats | None = None

    def restart(self) -> None:
        """Forget the filter's state: the chip was asleep or its filter has changed."""
        self._filtered = None

    def sample(
        self, times_ns: NDArray[np.int64], internal_hz: float, bandwidth_hz: float, decimation: int
    ) -> tuple[Floats, Floats]:
        """Return rate (°/s) and specific force (g), each (n, 3), at consecutive sample times.

        The result does not depend on how a row of samples is cut into calls.
        """
        n = len(times_ns)
        felt = np.empty((n, 6))
        draws = self._rng.standard_normal((n, 9))
        elapsed_s = np.empty((n, 1))
        elapsed_s[0], elapsed_s[1:, 0] = times_ns[0] - self._last_ns, np.diff(times_ns)
        elapsed_s *= 1e-9
        bias = self._world.noise.gyro_bias_walk_dps_rts * np.sqrt(elapsed_s) * draws[:, 6:]
        bias[0] += self.gyro_bias_dps
        np.cumsum(bias, axis=0, out=bias)
        self.gyro_bias_dps, self._last_ns = bias[-1], int(times_ns[-1])

        rate = self._world.table_motion(times_ns)[1]
        felt[:, :3] = rate[:, None] * (self.gyro_gain * self.up) + bias
        felt[:, 3:] = _GRAVITY_G * self.up + self.accel_bias_g

        pole = exp(-2 * pi * bandwidth_hz / internal_hz)
        sigma = self._density * sqrt(internal_hz / 2 * (1 - pole) / (1 + pole))
        pole **= decimation
        before = felt[0] if self._filtered is None else self._filtered
        driven = (1 - pole) * felt + sqrt(1 - pole**2) * sigma * draws[:, :6]
        filtered: Floats = np.asarray(lfilter([1.0], [1.0, -pole], driven, axis=0, zi=pole * before[None])[0])
        self._filtered = filtered[-1]
        return filtered[:, :3], filtered[:, 3:]
