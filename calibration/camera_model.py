"""Measure the camera's focal length, principal point and distortion, with a board on the rotating table.

Zhang's method (OpenCV's calibrateCamera, model k1, k2, p1, p2), with the standard deviations of its parameters from the
Jacobian at the solution, times the scatter of the residuals.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.board_views import (
    STANDS,
    BoardView,
    as_json,
    by_stand,
    coverage,
    plot_views,
    points,
    reject_loose_board,
    span_deg,
    take_views,
)
from calibration.procedure import Evaluation, Measured, Procedure
from rig.bench import Bench
from rig.calibrations import CalibrationResult, Contribution, RejectionCode
from rig.charts.xy import Axis, Chart, Series
from rig.core.phrases import percent
from rig.views.charuco_board import CharucoBoard

NAME = "camera.intrinsics"

# wider: more perspective, which gives the focal length; and corners that are too narrow to be found
ANGLES_DEG = (-48.0, -36.0, -24.0, -12.0, 0.0, 12.0, 24.0, 36.0, 48.0)
MIN_VIEWS = 12  # eight unknown numbers of the lens, and six of each board: fewer views leave scatter to chance
MIN_COVERAGE = 0.5  # distortion is largest at the edges, and extrapolated where no corner was
MAX_RMS_PX = 0.3
"""A sharp camera at rest reaches 0.1: more means blur, or a board that is not flat or moved."""
MAX_FOCAL_UNCERTAINTY = 0.005  # 0.5 % of a distance of 500 mm is 2.5 mm, the error of a ruler held to a lens
PARAMETERS = (("fx", "px"), ("fy", "px"), ("cx", "px"), ("cy", "px"), ("k1", ""), ("k2", ""), ("p1", ""), ("p2", ""))


def matrix_of(result: CalibrationResult) -> tuple[NDArray[np.float64], list[float]]:
    """Return the camera matrix (3, 3) and the distortion k1, k2, p1, p2 of a calibrated camera."""
    value = {name: estimate.value for name, estimate in result.estimates.items()}
    matrix = np.array([[value["fx"], 0.0, value["cx"]], [0.0, value["fy"], value["cy"]], [0.0, 0.0, 1.0]])
    return matrix, [value[name] for name in ("k1", "k2", "p1", "p2")]


def covariance(result: CalibrationResult) -> NDArray[np.float64]:
    """Return the covariance (8, 8) of the parameters: the stated uncertainties, and how the views correlate them.

    The views determine some combinations far better than each parameter: a principal point that is too low, with a
    tangential distortion and tilted boards, gives nearly the same corners. The poses of the board are eliminated from
    the normal equations (the Schur complement), because only the camera stays the same.
    """
    matrix, distortion = matrix_of(result)
    board = CharucoBoard(**result.evidence["board"])
    normal = np.zeros((len(PARAMETERS), len(PARAMETERS)))
    for view in result.evidence["views"]:
        points_mm, corners = board.points_mm()[view["ids"]], np.array(view["corners_px"])
        _, rotation, translation = cv2.solvePnP(points_mm, corners, matrix, np.array(distortion))
        jacobian = cv2.projectPoints(points_mm, rotation, translation, matrix, np.array(distortion))[1]
        of_pose, of_camera = jacobian[:, :6], jacobian[:, 6 : 6 + len(PARAMETERS)]
        explained = of_pose @ np.linalg.lstsq(of_pose, of_camera, rcond=None)[0]
        normal += of_camera.T @ (of_camera - explained)
    inverse = np.linalg.inv(normal)
    stated = np.array([result.estimates[name].uncertainty for name, _ in PARAMETERS])
    scale = stated / np.sqrt(np.diag(inverse))
    return np.asarray(scale[:, None] * inverse * scale)


def plot(result: CalibrationResult) -> Chart | None:
    """Return a chart of the corners in the frame; each position of the board has its colour."""
    views = result.evidence["views"]
    if not views:
        return None
    covered = float((np.array(result.evidence["coverage"]) > 0).mean())
    rms = "" if result.residual is None else f", {result.residual:.2f} px deviation (RMS)"
    seen = []
    for name, colour, of_stand in by_stand(views):
        x, y = np.concatenate([view["corners_px"] for view in of_stand]).T.tolist()
        seen.append(Series(name, x, y, colour))
    return Chart(
        f"Corners seen: {percent(covered, 0)} of the frame{rms}",
        Axis("x, px"),
        Axis("y, px", falling=True),
        [_frame(result), *seen],
        square=True,
    )


@dataclass(frozen=True)
class CameraModel(Procedure):
    """A procedure that takes views of the board in four positions, from nine sides each."""

    result_name, devices, valid_days = NAME, ("camera",), 365
    reference = "ChArUco board, {board.columns} × {board.rows} squares of {board.square_mm:g} mm"
    plots = (plot, partial(plot_views, limit_px=MAX_RMS_PX))
    board: CharucoBoard = field(default_factory=CharucoBoard)

    def measure(self, bench: Bench, *_: CalibrationResult) -> Measured:
        found = Evaluation(name=NAME)
        views = yield from take_views(bench, self.board, STANDS, ANGLES_DEG, found)
        identity = bench.camera.identity
        return evaluate(views, self.board, (identity.width, identity.height), found)


def evaluate(
    views: Sequence[BoardView], board: CharucoBoard, size: tuple[int, int], found: Evaluation | None = None
) -> Evaluation:
    """Fit the camera to ``views`` of the board, in the order in which they were taken, of frames of a ``size``.

    ``found`` has the rejections found while the views were taken; it is completed and returned.
    """
    found = found or Evaluation(name=NAME)
    found.residual_unit, found.limit = "px", MAX_RMS_PX
    cells = coverage(views, size)
    found.evidence = {
        "size": list(size),
        "board": {"columns": board.columns, "rows": board.rows, "square_mm": board.square_mm},
        "coverage": cells.tolist(),
        "views": as_json(views),
        "view_rms_px": [],
    }
    if len(views) < MIN_VIEWS:
        values = {"found": len(views), "span_deg": span_deg(views), "needed": MIN_VIEWS, "needed_deg": 0}
        return found.reject(RejectionCode.TOO_FEW_VIEWS, **values)
    # Fit the camera and the poses of the board.
    rms, matrix, distortion, rotations, translations, deviations, _, each = cv2.calibrateCameraExtended(
        [points(board, view).astype(np.float32) for view in views],
        [view.corners_px.astype(np.float32) for view in views],
        size,
        np.empty(0),
        np.empty(0),
        flags=cv2.CALIB_FIX_K3,
    )
    view_rms = np.ravel(each)
    found.residual = float(rms)
    found.evidence["view_rms_px"] = view_rms.round(3).tolist()
    parameters = [matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *np.ravel(distortion)[:4]]
    for (name, unit), value, sigma in zip(PARAMETERS, parameters, np.ravel(deviations)[:8], strict=True):
        found.estimate(name, value, unit, Contribution("scatter of the corners about the fit", "A", float(sigma), unit))
    # Check the fit: a loose board, residuals, coverage, and the uncertainty of the focal length.
    poses = [
        (np.asarray(r, dtype=np.float64), np.asarray(t, dtype=np.float64))
        for r, t in zip(rotations, translations, strict=True)
    ]
    reject_loose_board(found, views, poses)
    worst = {"view": int(np.argmax(view_rms)) + 1, "view_px": np.max(view_rms)}
    found.reject_above(MAX_RMS_PX, RejectionCode.CORNERS_OFF, rms_px=found.residual, **worst)
    covered = float((cells > 0).mean())
    found.reject_if(covered < MIN_COVERAGE, RejectionCode.COVERAGE_TOO_SMALL, covered=covered, needed=MIN_COVERAGE)
    focal = found.estimates["fx"]
    uncertainty = focal.uncertainty / focal.value
    found.reject_above(MAX_FOCAL_UNCERTAINTY, RejectionCode.FOCAL_LENGTH_UNCERTAIN, uncertainty=uncertainty)
    return found


def _frame(result: CalibrationResult) -> Series:
    width, height = result.evidence["size"]
    return Series("frame", [0, width, width, 0, 0], [0, 0, height, height, 0], "#8a8f96", dots=False, curve=True)
