"""The interface of an inertial sensor on the platter."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class ImuIdentity:
    """The sensor that answers on the bus, and its noise by the datasheet."""

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
        Samples that were lost before these (FIFO overflow); an integral across them is not valid.
    time_uncertainty_ns : int or None
        Largest standard uncertainty of ``time_ns``; None if it is not known.
    """

    time_ns: NDArray[np.int64]
    gyro_dps: NDArray[np.float64]
    lost: int = 0
    time_uncertainty_ns: int | None = None


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
