"""What the rig asks of an inertial sensor on the platter."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class ImuIdentity:
    """Who answers on the bus, and the noise its datasheet states."""

    model: str
    bus_address: int
    who_am_i: int
    gyro_noise_dps_rthz: float


@dataclass(frozen=True, slots=True)
class ImuSamples:
    """Consecutive samples, oldest first.

    Attributes
    ----------
    time_ns : int64 (n,)
        Sample times on the bench's clock, evenly spaced.
    gyro_dps : float64 (n, 3)
        Angular rate about the sensor's x, y, z.
    lost : int
        Samples that the sensor took but could not hand over (FIFO overflow) before these; an integral across them is
        void.
    time_uncertainty_ns : int or None
        Largest standard uncertainty of ``time_ns``; None where it is not known.
    """

    time_ns: NDArray[np.int64]
    gyro_dps: NDArray[np.float64]
    lost: int = 0
    time_uncertainty_ns: int | None = None


class Imu(Protocol):
    """A gyroscope (and accelerometer) that rides on the platter."""

    @property
    def identity(self) -> ImuIdentity: ...

    @property
    def rate_hz(self) -> float: ...

    @property
    def range_dps(self) -> float:
        """Full scale of the gyro: a sample that reaches it is saturated."""
        ...

    def read_samples(self) -> ImuSamples:
        """Return all samples since the last call."""
        ...

    def read_gravity_g(self) -> NDArray[np.float64]:
        """Return one accelerometer reading (3,), in g."""
        ...

    def temperature_c(self) -> float: ...

    def close(self) -> None: ...
