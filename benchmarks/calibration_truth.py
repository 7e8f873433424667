"""Comparison of calibration results and their uncertainties with the true values of simulated benches.

`python -m benchmarks.calibration_truth [--seeds 20] [--first-seed 0] [--only servo.backlash]` prints a table in
Markdown: for each quantity the median error and uncertainty, the spread of error over uncertainty (1 is ideal), and
the share of 95 % intervals that contain the true value. Each seed's error over uncertainty goes to stderr.
"""

import argparse
import sys
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from itertools import product
from math import degrees
from typing import Any

import cv2
import numpy as np

from calibration import camera_model, table_axis
from calibration.board_views import MIN_CORNERS, STANDS, BoardView
from calibration.procedures import (
    Backlash,
    CameraModel,
    CameraTime,
    Encoder,
    GyroScale,
    ImuMounting,
    TableAxis,
)
from rig.calibrations import CalibrationResult
from rig.config import load_config
from rig.core.phrases import in_unit
from rig.views.charuco_board import CharucoBoard
from sim.bench import ShelfOperator, open_sim_bench
from sim.calibration_board import boards
from sim.noise import NoiseModel
from sim.objects.projection import HEIGHT, WIDTH
from sim.objects.shelf import shelf
from sim.optics import Optics
from sim.world import World

CORNER_PX, ENCODER_DEG = 0.095, 0.03
"""Noise of a corner that is found in a frame (23,000 corners of ten simulated cameras), and of the encoder at rest."""
EDGE_PX, FACING = 8.0, 0.35
"""Corners nearer to the edge of the frame, and boards seen from more than 70° aside, are hardly found."""

Truth = Mapping[str, tuple[float, str]]
"""True value and unit of each quantity of a result."""


@contextmanager
def opened(seed: int, **noise: float) -> Iterator[tuple[Any, Any, Optics]]:
    """Yield a simulated bench, its devices, and the camera's true optics."""
    operator = ShelfOperator(World(noise=NoiseModel(**noise), seed=seed), shelf())
    with open_sim_bench(load_config(None, ()), operator) as bench:
        yield bench, operator.devices, operator.optics


def last(events: Iterator[Any]) -> CalibrationResult:
    *_, result = events
    assert isinstance(result, CalibrationResult)
    return result


def imu_scale(seed: int) -> tuple[CalibrationResult, Truth]:
    with opened(seed) as (bench, parts, _):
        part = parts.imu.inertial
        return last(GyroScale(8).live(bench)), {"scale": (1 / float(part.gyro_gain[2] * part.up[2]), "")}


def mounting(seed: int) -> tuple[CalibrationResult, Truth]:
    with opened(seed) as (bench, parts, _):
        part = parts.imu.inertial
        truth = {f"tilt_{name}": (degrees(float(part.up[i])), "°") for i, name in enumerate("xy")}
        truth |= {f"accel_zero_{name}": (float(part.accel_bias_g[i]), "g") for i, name in enumerate("xyz")}
        truth |= {"axis_x": (0.0, "°"), "axis_y": (0.0, "°")}
        return last(ImuMounting().live(bench)), truth


def backlash(seed: int) -> tuple[CalibrationResult, Truth]:
    backlash_deg = float(np.random.default_rng(seed).uniform(0.05, 1.0))
    with opened(seed, backlash_deg=backlash_deg) as (bench, *_):
        return last(Backlash(24).live(bench)), {"backlash": (backlash_deg, "°")}


def encoder(seed: int) -> tuple[CalibrationResult, Truth]:
    with opened(seed, encoder_harmonic_deg=0.2) as (bench, parts, _):
        result = last(Encoder(2).live(bench))
        (a1, b1), (a2, b2) = parts.servo._controller.harmonics_deg
        # The angle 0 of the servo is 180° from that of the shaft, so odd harmonics change their sign.
        return result, {"cos1": (-a1, "°"), "sin1": (-b1, "°"), "cos2": (a2, "°"), "sin2": (b2, "°")}


def lens(seed: int) -> tuple[CalibrationResult, Truth]:
    with opened(seed, camera_mount=1.0) as (bench, _, optics):
        result = last(CameraModel().live(bench))
    values = (*optics.focal_px, *optics.centre_px, *optics.distortion[:4])
    return result, {name: (value, unit) for (name, unit), value in zip(camera_model.PARAMETERS, values, strict=True)}


def axis(seed: int) -> tuple[CalibrationResult, Truth]:
    with opened(seed, camera_mount=1.0) as (bench, _, optics):
        result = last(TableAxis().live(bench, last(CameraModel().live(bench))))
    return result, axis_truth(optics)


def drawn_axis(seed: int) -> tuple[CalibrationResult, Truth]:
    """Return the axis from corners that are drawn instead of found in frames: a hundred seeds take minutes."""
    rng = np.random.default_rng(seed)
    optics = Optics.drawn(rng)
    when_utc = datetime(2026, 1, 1, tzinfo=UTC)
    seen = drawn_views(optics, tuple(STANDS), camera_model.ANGLES_DEG, rng)
    intrinsics = camera_model.evaluate(seen, CharucoBoard(), (WIDTH, HEIGHT)).result(when_utc=when_utc)
    seen = drawn_views(optics, table_axis.STANDS, table_axis.ANGLES_DEG, rng)
    return table_axis.evaluate(seen, CharucoBoard(), intrinsics).result(when_utc=when_utc), axis_truth(optics)


def drawn_views(
    optics: Optics, stands: Sequence[str], angles_deg: Sequence[float], rng: np.random.Generator
) -> list[BoardView]:
    """Return the corners of the board that the camera sees, with noise."""
    views = []
    for (number, stand), angle_deg in product(enumerate(stands), angles_deg):
        board = boards(optics)[stand]
        rotation, translation = board.pose(angle_deg)
        points = board.board.points_mm()
        corners = cv2.projectPoints(
            points, cv2.Rodrigues(rotation)[0], translation, optics.matrix, np.array(optics.distortion)
        )[0].reshape(-1, 2)
        middle = rotation @ points.mean(axis=0) + translation
        ids = np.flatnonzero(((corners > EDGE_PX) & (corners < (WIDTH - EDGE_PX, HEIGHT - EDGE_PX))).all(axis=1))
        if rotation[:, 2] @ middle > FACING * np.linalg.norm(middle) and ids.size >= MIN_CORNERS:
            found = corners[ids] + rng.normal(0, CORNER_PX, (ids.size, 2))
            views.append(BoardView(number, angle_deg + float(rng.normal(0, ENCODER_DEG)), ids, found))
    return views


def axis_truth(optics: Optics) -> Truth:
    up, origin = np.array(optics.rotation).reshape(3, 3)[:, 2], np.array(optics.translation_mm)
    rotation, translation = boards(optics)[table_axis.STANDS[0]].pose(0.0)
    middle = rotation @ CharucoBoard().points_mm().mean(axis=0) + translation
    beside = origin + up * ((middle - origin) @ up)
    seen = cv2.projectPoints(beside[None], np.zeros(3), np.zeros(3), optics.matrix, np.array(optics.distortion))[0]
    names = ("x", "y", "z", "ux", "uy", "uz", "px", "py")
    units = ("mm", "mm", "mm", "", "", "", "px", "px")
    return {
        name: (float(value), unit)
        for name, value, unit in zip(names, [*beside, *up, *seen.ravel()], units, strict=True)
    }


def frame_time(seed: int) -> tuple[CalibrationResult, Truth]:
    readout_ms = float(np.random.default_rng(seed).uniform(5, 25))
    noise = NoiseModel(camera_readout_ms=readout_ms)
    with opened(seed, camera_readout_ms=readout_ms) as (bench, parts, _):
        exposure_ms = bench.config.camera.exposure_us * 1e-3
        result = last(CameraTime("mug-star").live(bench))
        offset_ms = (exposure_ms + readout_ms) / 2 - parts.camera.times.offset_ns * 1e-6
    return result, {
        "offset": (offset_ms, "ms"),
        "readout": (readout_ms, "ms"),
        "jitter": (noise.stamp_jitter_ms, "ms"),
        "lost_frames": (noise.lost_frames, ""),
    }


PROCEDURES: dict[str, Callable[[int], tuple[CalibrationResult, Truth]]] = {
    "servo.backlash": backlash,
    "servo.encoder": encoder,
    "imu.scale": imu_scale,
    "imu.mounting": mounting,
    "camera.intrinsics": lens,
    "table.axis": axis,
    "table.axis, drawn": drawn_axis,
    "camera.time": frame_time,
}


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--seeds", type=int, default=20)
    arguments.add_argument(
        "--first-seed", type=int, default=0, help="a procedure chosen on some seeds needs fresh ones"
    )
    arguments.add_argument("--only", choices=sorted(PROCEDURES))
    given = arguments.parse_args()
    print("| calibration | quantity | median error | median uncertainty | error / uncertainty, RMS | 95 % intervals |")
    print("|---|---|---|---|---|---|")
    for name, procedure in PROCEDURES.items():
        if given.only not in (None, name):
            continue
        errors: dict[str, list[tuple[float, float]]] = defaultdict(list)
        units, rejected = {}, 0
        for seed in range(given.first_seed, given.first_seed + given.seeds):
            result, truth = procedure(seed)
            rejected += not result.passed
            print(f"{name}, seed {seed}: {' '.join(map(str, result.rejections)) or 'passed'}", file=sys.stderr)
            for key, (true, unit) in truth.items():
                estimate = result.estimates[key]
                errors[key].append((estimate.value - true, estimate.uncertainty))
                units[key] = unit
                print(f"  {key} {errors[key][-1][0] / estimate.uncertainty:+.2f}", file=sys.stderr, flush=True)
        for key, pairs in errors.items():
            error, sigma = np.array(pairs).T
            z = error / sigma
            middle, stated = (in_unit(f"{np.median(one):.2g}", units[key]) for one in (np.abs(error), sigma))
            print(
                f"| {name} | {key} | {middle} | {stated} "
                f"| {np.sqrt((z**2).mean()):.2f} | {(np.abs(z) < 1.96).sum()}/{z.size} |",
                flush=True,
            )
        if rejected:
            print(f"| {name} | rejected | {rejected}/{given.seeds} | | | |")


if __name__ == "__main__":
    main()
