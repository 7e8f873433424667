"""Legs: what encoder and gyro measured between two rests, from which several calibrations are fitted."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from rig.config import ImuConfig
from rig.motion.move import Move

COVERAGE = 4.0
"""Residuals beyond this many standard uncertainties are no chance (1 in 16 000)."""

STATED_WEIGHT = 4.0
"""As many degrees of freedom as the scatter of the legs has to outweigh what was stated of it."""


@dataclass(frozen=True, slots=True)
class Leg:
    """A rotation between two rests, in degrees: by the encoder, and by the gyro as it reads (scale 1).

    ``sigma_deg`` is the gyro's, of noise and bias alone; ``trouble`` why the gyro's rotation is not valid.
    """

    encoder_deg: float
    gyro_deg: float
    sigma_deg: float
    trouble: str = ""

    @classmethod
    def of(cls, move: Move, imu: ImuConfig) -> "Leg":
        """Return what ``move`` measured, without the scale in force and without its uncertainty."""
        gyro = move.gyro
        noise = gyro.sigma_deg**2 - (imu.scale_uncertainty * gyro.angle_deg) ** 2
        return cls(
            move.rotation_encoder_deg, gyro.angle_deg / imu.scale, sqrt(max(noise, 0.0)) / imu.scale, gyro.reason
        )


@dataclass(frozen=True, slots=True)
class LinearFit:
    """Parameters with their standard uncertainties, and the residuals (n,) with theirs, in degrees."""

    values: NDArray[np.float64]
    sigma: NDArray[np.float64]
    residuals_deg: NDArray[np.float64]
    residual_sigma_deg: NDArray[np.float64]

    @property
    def worst(self) -> int:
        """Index of the leg that is furthest off, by its own uncertainty."""
        return int(np.argmax(np.abs(self.residuals_deg) / self.residual_sigma_deg))


def fit(legs: Sequence[Leg], design: NDArray[np.float64], resolution_deg: float) -> LinearFit:
    """Fit the encoder's rotations by a linear model, by generalised least squares.

    Every rest lies anywhere within an encoder count, and consecutive legs share one with opposite signs, so that their
    errors are correlated. What the legs scatter counts beside what is stated of it: see `scatter`.

    Parameters
    ----------
    legs
        Each from the rest where the one before ended.
    design
        Float64 (n, p): what each leg's rotation by the encoder is per unit of each parameter.
    resolution_deg
        Angle of one encoder count.
    """
    n, parameters = design.shape
    count = resolution_deg**2 / 12
    shared = np.diag(np.full(n, 2 * count)) - count * (np.eye(n, k=1) + np.eye(n, k=-1))
    covariance = np.diag([leg.sigma_deg**2 for leg in legs]) + shared
    encoder = np.array([leg.encoder_deg for leg in legs])
    root = np.linalg.cholesky(covariance)
    white, white_encoder = np.linalg.solve(root, design), np.linalg.solve(root, encoder)
    values = np.linalg.lstsq(white, white_encoder, rcond=None)[0]
    square = scatter(float(((white_encoder - white @ values) ** 2).sum()), n - parameters)
    sigma = np.sqrt(np.diag(np.linalg.inv(white.T @ white)) * square)
    return LinearFit(values, sigma, encoder - design @ values, np.sqrt(np.diag(covariance)))


def scatter(chi_square: float, freedom: int) -> float:
    """Return by how much the variance of legs is larger, or smaller, than stated: the square of the Birge ratio.

    A bench may state its noise with too much caution, or too little. A few legs prove neither: what was stated weighs
    as much as `STATED_WEIGHT` of them (the mean of an inverse-gamma posterior about 1).
    """
    return (chi_square + STATED_WEIGHT) / (freedom + STATED_WEIGHT)
