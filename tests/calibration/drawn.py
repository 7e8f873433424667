"""Measurements without a simulator, random or exact, for the evaluations of the procedures."""

import numpy as np

from calibration.gyro_rotation import SPEEDS, TimedLeg
from calibration.imu_mounting import GravityReading, RecordedMove
from calibration.legs import Leg
from calibration.procedure import Evaluation
from rig.calibrations import CalibrationResult, RejectionCode

AXIS = np.array([0.02, -0.03, 1.0]) / np.linalg.norm([0.02, -0.03, 1.0])
COUNT_DEG = 360 / 4096


def codes(found: Evaluation | CalibrationResult) -> list[RejectionCode]:
    """Return the codes of the rejections of a calibration."""
    return [rejection.code for rejection in found.rejections]


def in_sigmas(found: Evaluation | CalibrationResult, **truth: float) -> list[float]:
    """Return the errors of some estimates, in their stated uncertainties."""
    return [(found.estimates[name].value - true) / found.estimates[name].uncertainty for name, true in truth.items()]


def rests(rng: np.random.Generator, stops_deg: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return rests anywhere within an encoder count of these angles, and what the encoder reads there."""
    true_deg = stops_deg + rng.uniform(-COUNT_DEG / 2, COUNT_DEG / 2, len(stops_deg))
    return true_deg, np.round(true_deg / COUNT_DEG) * COUNT_DEG


def measured(
    axis=AXIS, *, zero_g=(0.01, -0.02, 0.03), table_axis_deg=(0.0, 0.0)
) -> tuple[list[RecordedMove], list[GravityReading]]:
    """Return the measurements of a bench without noise."""
    rate = np.linspace(10.0, 90.0, 20)
    moves = [RecordedMove(45.0 * axis, 0.01, 0.002 * rate, rate) for _ in range(8)]
    levels = []
    for angle in np.arange(8) * 45.0:
        c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
        x, y = np.radians(table_axis_deg)
        levels.append(
            GravityReading(float(angle), axis + zero_g + np.array([c * x + s * y, -s * x + c * y, 0.0]), 1e-4)
        )
    return moves, levels


def moves(
    seed: int, *, true: float = 1.0, repeats: int = 10, backlash_deg: float = 0.4, invalid: str = ""
) -> list[TimedLeg]:
    """Return rotations that scatter by ``true`` times the stated σ, with a backlash and a scale."""
    rng = np.random.default_rng(seed)
    made = []
    for number, speed in enumerate(SPEEDS):
        for index in range(2 * repeats):
            way = 1 - 2 * (index % 2)
            sigma = 0.02 * 3.0**number
            gyro = way * 60 / 1.03 - way * backlash_deg + true * sigma * float(rng.standard_normal())
            made.append(TimedLeg(speed, 1.7 * 3.0**number, Leg(way * 60.0, gyro, sigma, invalid)))
    return made
