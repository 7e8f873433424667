"""The camera's focal length, principal point and distortion, from a board on the turning table.

Zhang's method (OpenCV's calibrateCamera, model k1, k2, p1, p2), with the standard deviations of its parameters from the
Jacobian at the solution, times the scatter that is really there.
"""

from collections.abc import Generator, Mapping, Sequence
from datetime import datetime
from typing import Any

import cv2
import numpy as np

from calibration.board_views import STANDS, BoardView, as_json, by_stand, coverage, look, points, turned_otherwise
from calibration.board_views import plot_views as plot_views_of
from calibration.events import Ask, Progress
from rig.bench import Bench
from rig.calibrations import CalibrationResult, Estimate
from rig.charts.xy import Axis, Chart, Series
from rig.events.events import Event
from rig.views.charuco_board import Board

NAME = "camera.intrinsics"
VALID_DAYS = 365

ANGLES_DEG = (-48.0, -36.0, -24.0, -12.0, 0.0, 12.0, 24.0, 36.0, 48.0)
MIN_VIEWS = 12
MIN_COVERAGE = 0.5
MAX_RMS_PX = 0.3
"""A sharp camera at rest reaches a tenth: more is blur, a board that is not flat, or one that moved."""
MAX_FOCAL_UNCERTAINTY = 0.005
ENLARGED = 100
"""By how much residuals are drawn longer than they are: a tenth of a pixel is 10."""
PARAMETERS = (
    ("fx", "px"),
    ("fy", "px"),
    ("cx", "px"),
    ("cy", "px"),
    ("k1", ""),
    ("k2", ""),
    ("p1", ""),
    ("p2", ""),
)


def live(
    bench: Bench, board: Board | None = None
) -> Generator[Event | Ask | Progress | CalibrationResult, None, CalibrationResult]:
    """Have the board put on four stands, look at it from nine sides each, and calibrate; yields events, then the fact.

    Raises
    ------
    ViewRejected, MotionTimeout, DeviceFault, DeviceSilent
        See `rig.views.capture` and `rig.motion.turntable`.
    """
    board = board or Board()
    when_utc = bench.clock.utc()
    views, troubles = yield from look(bench, board, STANDS, ANGLES_DEG)
    identity = bench.camera.identity
    fact = from_data(
        views,
        board,
        (identity.width, identity.height),
        troubles=troubles,
        when_utc=when_utc,
        device=bench.apparatus("camera"),
    )
    yield fact
    return fact


def from_data(
    views: Sequence[BoardView],
    board: Board,
    size: tuple[int, int],
    *,
    troubles: Sequence[str] = (),
    when_utc: datetime,
    device: Mapping[str, Any],
) -> CalibrationResult:
    """Fit the camera to ``views`` of the board and judge it.

    Parameters
    ----------
    views
        In the order in which they were taken.
    board
        Its layout.
    size
        Width and height of the frames.
    troubles
        Why they should not be used, found while they were taken.
    when_utc, device
        Kept with the fact.
    """
    refusals = list(troubles)
    estimates: dict[str, Estimate] = {}
    rms = None
    each: Any = ()
    cells = coverage(views, size)
    if len(views) < MIN_VIEWS:
        refusals.append(
            f"The board was found in {len(views)} views, {MIN_VIEWS} are needed: is it lit, sharp, in the frame, and "
            "the one that --print-board printed?"
        )
    else:
        rms, matrix, distortion, rotations, translations, deviations, _, each = cv2.calibrateCameraExtended(
            [points(board, view).astype(np.float32) for view in views],
            [view.corners_px.astype(np.float32) for view in views],
            size,
            np.empty(0),
            np.empty(0),
            flags=cv2.CALIB_FIX_K3,
        )
        values = [matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *np.ravel(distortion)[:4]]
        for (name, unit), value, sigma in zip(PARAMETERS, values, np.ravel(deviations)[:8], strict=True):
            estimates[name] = Estimate(float(value), float(sigma), unit)
        poses = [
            (np.asarray(r, dtype=np.float64), np.asarray(t, dtype=np.float64))
            for r, t in zip(rotations, translations, strict=True)
        ]
        _, loose = turned_otherwise(views, poses)
        refusals += [loose] if loose else []
        refusals += _judge(estimates, float(rms), np.ravel(each), float((cells > 0).mean()))
    return CalibrationResult(
        name=NAME,
        estimates=estimates,
        residual=None if rms is None else float(rms),
        limit=MAX_RMS_PX,
        residual_unit="px",
        refusals=tuple(refusals),
        valid_days=VALID_DAYS,
        when_utc=when_utc,
        device=device,
        evidence={
            "size": list(size),
            "board": {"columns": board.columns, "rows": board.rows, "square_mm": board.square_mm},
            "coverage": cells.tolist(),
            "views": as_json(views),
            "view_rms_px": np.ravel(each).round(3).tolist(),
        },
    )


def matrix_of(fact: CalibrationResult) -> tuple["np.ndarray[tuple[int, int], np.dtype[np.float64]]", list[float]]:
    """Return the camera matrix (3, 3) and the distortion k1, k2, p1, p2 of a calibrated camera."""
    value = {name: estimate.value for name, estimate in fact.estimates.items()}
    matrix = np.array([[value["fx"], 0.0, value["cx"]], [0.0, value["fy"], value["cy"]], [0.0, 0.0, 1.0]])
    return matrix, [value[name] for name in ("k1", "k2", "p1", "p2")]


def plot(fact: CalibrationResult) -> Chart | None:
    """Return where in the frame corners were seen; every stand has its colour."""
    views = fact.evidence["views"]
    if not views:
        return None
    covered = float((np.array(fact.evidence["coverage"]) > 0).mean())
    rms = "" if fact.residual is None else f", {fact.residual:.2f} px off (RMS)"
    seen = []
    for name, colour, of_stand in by_stand(views):
        x, y = np.concatenate([view["corners_px"] for view in of_stand]).T.tolist()
        seen.append(Series(name, x, y, colour))
    return Chart(
        f"Corners seen: {covered:.0%} of the frame{rms}",
        Axis("x, px"),
        Axis("y, px", falling=True),
        [_frame(fact), *seen],
        square=True,
    )


def plot_residuals(fact: CalibrationResult) -> Chart | None:
    """Return by how much and where to each corner is off the fit, enlarged; every stand has its colour."""
    views = fact.evidence["views"]
    if not views or not fact.estimates:
        return None
    matrix, distortion = matrix_of(fact)
    board = Board(**fact.evidence["board"])
    vectors = []
    for name, colour, of_stand in by_stand(views):
        for view in of_stand:
            points_mm, corners = board.points_mm()[view["ids"]], np.array(view["corners_px"])
            _, rotation, translation = cv2.solvePnP(points_mm, corners, matrix, np.array(distortion))
            fitted = cv2.projectPoints(points_mm, rotation, translation, matrix, np.array(distortion))[0].reshape(-1, 2)
            ends = corners + ENLARGED * (corners - fitted)
            for x, y in np.stack([corners, ends], axis=2).tolist():
                vectors.append(Series("", x, y, colour, dots=False, curve=True))
        vectors.append(Series(name, [], [], colour, dots=False, curve=True))
    return Chart(
        f"Corners less the fit, {ENLARGED} times enlarged: without a pattern they are noise",
        Axis("x, px"),
        Axis("y, px", falling=True),
        [_frame(fact), *vectors],
        square=True,
    )


def plot_views(fact: CalibrationResult) -> Chart | None:
    """Return how far the corners of each view are off the fit; see `calibration.board_views.plot_views`."""
    return plot_views_of(fact, MAX_RMS_PX)


def _frame(fact: CalibrationResult) -> Series:
    width, height = fact.evidence["size"]
    return Series("frame", [0, width, width, 0, 0], [0, 0, height, height, 0], "#8a8f96", dots=False, curve=True)


def _judge(estimates: Mapping[str, Estimate], rms_px: float, each: Any, covered: float) -> list[str]:
    refusals = []
    if rms_px > MAX_RMS_PX:
        refusals.append(
            f"The corners are off by {rms_px:.2f} px (RMS; view {int(np.argmax(each)) + 1} by "
            f"{float(np.max(each)):.2f}), above {MAX_RMS_PX:g}: blurred frames, a board that is not flat, or one "
            "that moved. Focus, glue it to something stiff, and calibrate again."
        )
    if covered < MIN_COVERAGE:
        refusals.append(
            f"Corners were seen in {covered:.0%} of the frame, {MIN_COVERAGE:.0%} are needed for the distortion: "
            "bring the board nearer, or to the edges of the platter."
        )
    focal = estimates["fx"]
    if focal.uncertainty > MAX_FOCAL_UNCERTAINTY * focal.value:
        refusals.append(
            f"The focal length is uncertain by {focal.uncertainty / focal.value:.1%}, more than "
            f"{MAX_FOCAL_UNCERTAINTY:.1%}: lean the board back more on some of the stands."
        )
    return refusals
