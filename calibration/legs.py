"""Legs: rotations between two rests by encoder and gyro, from which several calibrations are fitted."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from calibration.procedure import Evaluation
from rig.calibrations import Contribution, RejectionCode
from rig.config import ImuConfig
from rig.motion.move import Move

COVERAGE = 4.0
"""Largest residual, in standard uncertainties, that is due to chance (1 in 16 000)."""

STATED_WEIGHT = 4.0  # larger: few legs trust the data sheet; smaller: they trust a scatter that may be small by chance
"""The stated noise weighs as much as this many degrees of freedom of the legs' scatter."""


@dataclass(frozen=True, slots=True)
class Leg:
    """A rotation between two rests, in degrees: by the encoder, and by the gyro with scale 1.

    ``sigma_deg`` is the gyro's standard uncertainty from noise and bias alone. ``invalid`` is the reason why the gyro's
    rotation is not valid; empty if it is valid.
    """

    encoder_deg: float
    gyro_deg: float
    sigma_deg: float
    invalid: str = ""

    @classmethod
    def of(cls, move: Move, imu: ImuConfig) -> "Leg":
        """Return the leg of a move, without the scale in force and without the uncertainty of that scale."""
        gyro = move.gyro
        noise = gyro.sigma_deg**2 - (imu.scale_uncertainty * gyro.angle_deg) ** 2
        return cls(
            move.rotation_encoder_deg, gyro.angle_deg / imu.scale, sqrt(max(noise, 0.0)) / imu.scale, gyro.reason
        )


def reasons(legs: Sequence[Leg]) -> list[str]:
    """Return the reasons why legs are not valid, each once."""
    return list(dict.fromkeys(leg.invalid for leg in legs if leg.invalid))


@dataclass(frozen=True, slots=True)
class LinearFit:
    """Parameters (p,), and the residuals (n,) with their standard uncertainties, in degrees.

    ``scatter`` (p,) is the contribution of the legs' scatter to the standard uncertainties of the parameters;
    ``stated`` has the standard uncertainty of each other source, in degrees, and its contributions (p,).
    """

    values: NDArray[np.float64]
    scatter: NDArray[np.float64]
    stated: dict[str, tuple[float, NDArray[np.float64]]]
    residuals_deg: NDArray[np.float64]
    residual_sigma_deg: NDArray[np.float64]

    @property
    def worst(self) -> int:
        """The index of the leg with the largest residual in units of its uncertainty."""
        return int(np.argmax(np.abs(self.residuals_deg) / self.residual_sigma_deg))

    def budget(self, parameter: int, unit: str) -> list[Contribution]:
        """Return the uncertainty budget of a parameter in ``unit``."""
        return [
            Contribution("scatter of the legs about the fit", "A", float(self.scatter[parameter]), unit),
            *(
                Contribution(source, "B", sigma_deg, "°", float(part[parameter]) / sigma_deg)
                for source, (sigma_deg, part) in self.stated.items()
                if sigma_deg
            ),
        ]


def fit(legs: Sequence[Leg], design: NDArray[np.float64], resolution_deg: float) -> LinearFit:
    """Fit the encoder's rotations by a linear model, by generalised least squares.

    A rest lies anywhere within an encoder count. Consecutive legs share a rest with opposite signs, so their errors are
    correlated.

    The stated noise of a bench may be too high or too low, and a few legs do not show which. Therefore the variance of
    a parameter is a weighted mean: the stated noise has the weight of `STATED_WEIGHT` legs, the scatter that of its
    degrees of freedom. It is the mean of an inverse-gamma posterior of the square of the Birge ratio about 1.

    Each leg begins at the rest where the previous one ended. ``design``, float64 (n, p), is each leg's rotation by the
    encoder per unit of each parameter. ``resolution_deg`` is the angle of one encoder count.
    """
    n, parameters = design.shape
    # The covariance: the gyro's noise, and rests that are uniform within a count and shared by neighbours.
    count = resolution_deg**2 / 12
    shared = np.diag(np.full(n, 2 * count)) - count * (np.eye(n, k=1) + np.eye(n, k=-1))
    gyro = np.diag([leg.sigma_deg**2 for leg in legs])
    covariance = gyro + shared
    encoder = np.array([leg.encoder_deg for leg in legs])
    # Least squares of what the root of the covariance makes independent and of unit variance.
    root = np.linalg.cholesky(covariance)
    white, white_encoder = np.linalg.solve(root, design), np.linalg.solve(root, encoder)
    values = np.linalg.lstsq(white, white_encoder, rcond=None)[0]
    chi_square, weight = float(((white_encoder - white @ values) ** 2).sum()), n - parameters + STATED_WEIGHT
    spread = np.linalg.inv(white.T @ white)
    gain = spread @ np.linalg.solve(root.T, white).T  # values = gain @ encoder

    def stated(part: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(np.sqrt(np.diag(gain @ part @ gain.T) * STATED_WEIGHT / weight))

    return LinearFit(
        values,
        scatter=np.sqrt(np.diag(spread) * chi_square / weight),
        stated={
            "noise and zero of the gyro, as stated for a leg": (sqrt(float(np.diag(gyro).mean())), stated(gyro)),
            "resolution of the encoder at a rest": (sqrt(count), stated(shared)),
        },
        residuals_deg=encoder - design @ values,
        residual_sigma_deg=np.sqrt(np.diag(covariance)),
    )


def reject_slipped_leg(found: Evaluation, number: int) -> None:
    """Reject an evaluation whose largest residual, that of leg ``number`` (from 1), is above its limit."""
    assert found.limit is not None
    found.reject_above(found.limit, RejectionCode.LEG_SLIPPED, residual_deg=found.residual, leg=number)
