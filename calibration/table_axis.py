"""Measure the table's axis in the camera's frame, and its wobble, with a board on the table.

The board's poses lie on circles about the axis: the axes of the rotations between them give its direction, a linear fit
to their centres a point on it. Starting from there, one fit uses all corners, with the encoder's angles θ as they are:

    x = project(a + L(θ)·R(u, θ)·(X₀ − a)),    X₀ the board's points at θ = 0

by `least_squares(loss="soft_l1")`, with L the lean of a bearing that is out of true; its direction rotates twice per
revolution.

The result sets ``view.roi``: the part of the frame in which the objects stay while they rotate, for any position of the
camera.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from itertools import combinations
from math import degrees, hypot, radians
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.optimize import least_squares

from calibration import camera_model
from calibration.board_views import STANDS as ALL_STANDS
from calibration.board_views import BoardView, as_json, plot_views, points, reject_loose_board, span_deg, take_views
from calibration.camera_model import PARAMETERS, matrix_of
from calibration.procedure import Evaluation, Measured, Procedure
from rig.bench import Bench
from rig.calibrations import CalibrationResult, Contribution, Estimate, RejectionCode
from rig.charts.xy import LIMIT, MODEL, Axis, Chart, Series
from rig.jobs.desk import Progress
from rig.views.charuco_board import CharucoBoard

NAME = "table.axis"

STANDS = ("calibration-board upright", "calibration-board back")
# wider: the axis is known better; from beyond 60° the board's corners are hardly found
ANGLES_DEG = tuple(float(angle) for angle in range(-60, 61, 10))
MIN_VIEWS = 8  # each view adds six unknown numbers; fewer than eight over 60° leave the axis' tilt uncertain
MIN_SPAN_DEG = 60.0
MAX_RMS_PX = 0.4  # as for `calibration.camera_model`, and the table's wobble
MAX_WOBBLE_DEG = 0.5  # more is a bent horn, or a board that moved
MAX_UNCERTAINTY_PX = 0.3  # the region is set in whole pixels
MAX_LENS_OFF = 0.06
"""Relative error of a distance from lens to axis that is measured by hand."""
MAX_CUT = 0.1
"""Largest share of the object space that the frame may cut off on a side, because objects seldom fill its corners."""
ROBUST_PX = 0.3  # three times the scatter of a good corner: larger residuals are wrong corners and count less
CORNER_PX = 0.1
"""Uncertainty of a corner: it weighs the corners against the known camera parameters."""
PIVOT_MM = 80.0
"""Typical distance of the bearing below the board's middle."""
REST_DEG = 0.03
"""Standard uncertainty of the table's angle at a rest: an encoder count of 0.088°, uniform, and its noise.

It moves all corners of a view together, so more corners do not reduce it.
"""
BIAS_PX = 0.02
"""Common error of OpenCV's corners; more corners do not reduce it."""
SQUARE_SIGMA_MM = 0.03  # ±0.05 mm of a caliper, uniform
"""Standard uncertainty of the side of a square, measured on the print. Images alone do not determine lengths."""
FIRST_POSE = 15
"""Parameters before the poses of the board: direction, point and lean (two each), the pivot, and the camera."""

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class ObjectSpace:
    """The cylinder about the axis that holds the objects, and the board's place in it."""

    radius_mm: float = 80.0
    height_mm: float = 150.0
    """Radius and height of the cylinder, which stands on the platter."""
    board_mm: float = 75.0
    """Height of the board's middle above the platter in the first position."""
    lens_mm: float | None = None
    """Distance from the lens to the axis at that height, measured by hand; None if it was not measured."""


def region_of_interest(estimates: Mapping[str, Estimate], intrinsics: CalibrationResult, space: ObjectSpace) -> Floats:
    """Return the corners of the image of the object space, float64 (2, 2): lowest and highest x and y.

    They may lie outside the frame.
    """
    value = {name: estimate.value for name, estimate in estimates.items()}
    up = np.array([value["ux"], value["uy"], value["uz"]])
    foot = np.array([value["x"], value["y"], value["z"]]) - up * space.board_mm
    side = np.cross(up, [0.0, 0.0, 1.0])
    side /= np.linalg.norm(side)
    depth = np.cross(side, up)
    around = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    ring = space.radius_mm * (np.cos(around)[:, None] * side + np.sin(around)[:, None] * depth)
    cylinder = np.concatenate([foot + ring, foot + ring + up * space.height_mm])
    matrix, distortion = matrix_of(intrinsics)
    seen = cv2.projectPoints(cylinder, np.zeros(3), np.zeros(3), matrix, np.array(distortion))[0].reshape(-1, 2)
    return np.stack([seen.min(axis=0), seen.max(axis=0)]).astype(np.float64)


def plot(result: CalibrationResult) -> Chart | None:
    """Return a chart of the path of the board's middle about the axis, seen along it, and of the fitted circles."""
    if not result.estimates:
        return None
    value = {name: estimate.value for name, estimate in result.estimates.items()}
    up = np.array([value["ux"], value["uy"], value["uz"]])
    offset = np.array(result.evidence["board_centres_mm"]) - np.array([value["x"], value["y"], value["z"]])
    side = np.cross(up, [0.0, 0.0, 1.0])
    side /= np.linalg.norm(side)
    across, along = offset @ -side, offset @ np.cross(side, up)  # the camera is below
    around = np.linspace(0.0, 2 * np.pi, 97)
    return Chart(
        f"The board about the axis, seen from above; wobble {result.estimates['wobble']}",
        Axis("mm"),
        Axis("mm from the axis"),
        [
            *(
                Series("", (r * np.cos(around)).tolist(), (r * np.sin(around)).tolist(), MODEL, dots=False, curve=True)
                for r in result.evidence["radius_mm"]
            ),
            Series("middle of the board", across.tolist(), along.tolist()),
            Series("axis", [0.0], [0.0], LIMIT),
        ],
        square=True,
    )


@dataclass(frozen=True)
class TableAxis(Procedure):
    """A procedure that takes views of the board in two positions, from thirteen sides each, and fits the axis.

    Needs the camera's calibration.
    """

    result_name, devices, valid_days = NAME, ("camera", "servo"), 365
    reference = "encoder of the servo; ChArUco board, {board.columns} × {board.rows} squares of {board.square_mm:g} mm"
    requires, plots = (camera_model.NAME,), (plot, partial(plot_views, limit_px=MAX_RMS_PX))
    board: CharucoBoard = field(default_factory=CharucoBoard)
    space: ObjectSpace = field(default_factory=ObjectSpace)

    def measure(self, bench: Bench, *required: CalibrationResult) -> Measured:
        (intrinsics,) = required
        stands = {stand: ALL_STANDS[stand] for stand in STANDS}
        stands[STANDS[0]] += f", its middle {self.space.board_mm:g} mm above the platter"
        found = Evaluation(name=NAME)
        views = yield from take_views(bench, self.board, stands, ANGLES_DEG, found)
        evaluate(views, self.board, intrinsics, self.space, found)
        if found.passed:
            cut = ", ".join(found.evidence["cut_off"])
            words = (
                f"The lens is {_from_lens(found.estimates):.0f} mm from the axis. If this is wrong, the squares of the "
                f"board are not {self.board.square_mm:g} mm. Objects are seen within {found.settings['view.roi']} "
                "(x, y, width, height)"
            )
            yield Progress(1.0, f"{words}; the frame cuts off {cut} of the space for them" if cut else words)
        return found


def evaluate(
    views: Sequence[BoardView],
    board: CharucoBoard,
    intrinsics: CalibrationResult,
    space: ObjectSpace = ObjectSpace(),
    found: Evaluation | None = None,
) -> Evaluation:
    """Fit the axis to ``views`` of the board; see `calibration.camera_model.evaluate`."""
    found = found or Evaluation(name=NAME)
    found.residual_unit, found.limit = "px", MAX_RMS_PX
    found.evidence = {"intrinsics": intrinsics.id, "views": as_json(views), "room": asdict(space)}
    span = span_deg(views)
    if len(views) < MIN_VIEWS or span < MIN_SPAN_DEG:
        values = {"found": len(views), "span_deg": span, "needed": MIN_VIEWS, "needed_deg": MIN_SPAN_DEG}
        return found.reject(RejectionCode.TOO_FEW_VIEWS, **values)
    matrix, distortion = matrix_of(intrinsics)
    poses = [pose(board, view, matrix, distortion) for view in views]
    reject_loose_board(found, views, poses)
    axis = _Axis(views, board, intrinsics, poses)
    found.estimates, found.residual = axis.fit()
    found.evidence |= {"board_centres_mm": axis.centres_mm.round(3).tolist(), "radius_mm": axis.radii_mm}
    found.evidence["view_rms_px"] = axis.view_rms_px
    found.evidence["lens"] = axis.lens
    _check(found, board, space)

    # The region of interest: the image of the object space, as far as it is within the frame.
    size = np.array(intrinsics.evidence["size"])
    corners = region_of_interest(found.estimates, intrinsics, space)
    low, high = np.floor(corners[0] + 0.5).astype(int), np.ceil(corners[1] + 0.5).astype(int)
    over = np.array([-low, high - size])  # left, top; right, bottom
    sides = {"left": over[0, 0], "top": over[0, 1], "right": over[1, 0], "bottom": over[1, 1]}
    found.evidence["cut_off"] = [f"{pixels} px at the {side}" for side, pixels in sides.items() if pixels > 0]
    found.reject_if(
        (over > MAX_CUT * (high - low)).any(),
        RejectionCode.OBJECTS_CUT_OFF,
        **{f"{side}_px": max(int(pixels), 0) for side, pixels in sides.items()},
        radius_mm=space.radius_mm,
        height_mm=space.height_mm,
        board_mm=space.board_mm,
    )
    low, high = np.clip(low, 0, size - 1), np.clip(high, 1, size)
    found.proposed = {"view.roi": [*low.tolist(), *(high - low).tolist()]}
    return found


class _Axis:
    """The fit: two angles of the axis, two offsets of a point on it, its lean, the camera, and a pose per position.

    The camera and the height about which the axis leans enter with their known values and uncertainties.
    """

    def __init__(
        self,
        views: Sequence[BoardView],
        board: CharucoBoard,
        intrinsics: CalibrationResult,
        poses: Sequence[tuple[Floats, Floats]],
    ) -> None:
        self._views = views
        camera = [intrinsics.estimates[name] for name, _ in PARAMETERS]
        self._known = np.array([-PIVOT_MM, *(estimate.value for estimate in camera)])
        # Rows that weigh the known values: of unit variance, and without correlation.
        known = block_diag((PIVOT_MM / 2) ** 2, camera_model.covariance(intrinsics))
        self._whiten = np.linalg.inv(np.linalg.cholesky(known))
        self._points = [points(board, view) for view in views]
        self._corners_px = np.concatenate([view.corners_px for view in views])
        self._middle, self._square_mm = board.points_mm().mean(axis=0), board.square_mm
        self._stands = sorted({view.stand for view in views})
        self._up, self._origin = first_axis(views, poses, self._middle)
        # Two directions across the axis, in which the point on the axis may move and the axis may lean.
        first = np.cross(self._up, [0.0, 0.0, 1.0])
        first /= np.linalg.norm(first)
        self._across = np.stack([first, np.cross(self._up, first)])
        self._start = np.zeros(FIRST_POSE + 6 * len(self._stands))
        self._start[6:FIRST_POSE] = self._known
        for number, stand in enumerate(self._stands):
            index = min((i for i, v in enumerate(views) if v.stand == stand), key=lambda i: abs(views[i].table_deg))
            back = cv2.Rodrigues(self._up * -radians(views[index].table_deg))[0]
            rotation, translation = poses[index]
            at_zero = back @ cv2.Rodrigues(rotation)[0]
            place = self._origin + back @ (translation.ravel() - self._origin)
            begin = FIRST_POSE + 6 * number
            self._start[begin : begin + 3] = cv2.Rodrigues(at_zero)[0].ravel()
            self._start[begin + 3 : begin + 6] = place
        self.view_rms_px: list[float] = []
        self.lens: list[float] = []
        """The camera's parameters that belong to the fitted axis: the known ones, moved within their uncertainty."""
        self.centres_mm = np.array([cv2.Rodrigues(r)[0] @ self._middle + t.ravel() for r, t in poses])
        offset = self.centres_mm - self._origin
        radial = np.linalg.norm(offset - np.outer(offset @ self._up, self._up), axis=1)
        self.radii_mm = [
            float(np.mean([r for r, v in zip(radial, views, strict=True) if v.stand == stand]))
            for stand in self._stands
        ]

    def fit(self) -> tuple[dict[str, Estimate], float]:
        """Return the estimates, and the root mean square of the corners' residuals in pixels."""
        # Without a lean at the start, the fit may end at a lean to the wrong side. Try three starts, and use the best.
        starts = [self._start.copy() for _ in range(3)]
        for start, angle in zip(starts, np.radians([0.0, 120.0, 240.0]), strict=True):
            start[4:6] = radians(0.05) * np.array([np.cos(angle), np.sin(angle)])
        tried = [self._solved(start, evaluations=15) for start in starts]
        solved = self._solved(min(tried, key=lambda found: float(found.cost)).x, evaluations=60)
        self.lens = solved.x[7:FIRST_POSE].tolist()
        known = self._known.size
        residuals = self._residuals(solved.x)[:-known]
        squares = (residuals.reshape(-1, 2) ** 2).sum(axis=1)
        ends = np.cumsum([len(part) for part in self._points])[:-1]
        self.view_rms_px = [round(float(np.sqrt(part.mean())), 3) for part in np.split(squares, ends)]
        freedom = max(residuals.size - solved.x.size, 1)
        rms = float(np.sqrt(squares.mean()))
        # The corners scatter as their residuals show, the known values as they are known: `CORNER_PX` in their rows.
        inverse = np.linalg.inv(solved.jac.T @ solved.jac)
        covariances = [
            inverse @ rows.T @ rows @ inverse * variance
            for rows, variance in (
                (solved.jac[:-known], float((residuals**2).sum()) / freedom),
                (solved.jac[-known:], CORNER_PX**2),
                (self._by_angle(solved.x, solved.jac), radians(REST_DEG) ** 2),
            )
        ]
        # Uncertainties of the reported quantities: their derivatives by the parameters, from differences.
        reported = self._reported(solved.x)
        steps = np.sqrt(np.diag(sum(covariances))) * 1e-2 + 1e-12
        jacobian = np.column_stack(
            [
                (self._reported(solved.x + step * unit) - reported) / step
                for step, unit in zip(steps, np.eye(steps.size), strict=True)
            ]
        )
        sigma = np.sqrt([np.diag(jacobian @ covariance @ jacobian.T) for covariance in covariances])
        names = ("x", "y", "z", "ux", "uy", "uz", "px", "py", "wobble")
        units = ("mm", "mm", "mm", "", "", "", "px", "px", "°")
        estimates = {
            name: self._estimate(value, unit, of)
            for name, unit, value, of in zip(names, units, reported.tolist(), sigma.T, strict=True)
        }
        across = np.linalg.norm(sigma[:, :3], axis=1)
        estimates["eccentricity"] = self._estimate(self.radii_mm[0], "mm of the board", across)
        return estimates, rms

    def _estimate(self, value: float, unit: str, sigma: Floats) -> Estimate:
        """Return an estimate; ``sigma`` (3,) are the contributions of the corners, known values and table's angles."""
        budget = [
            Contribution("scatter of the corners about the fit", "A", float(sigma[0]), unit),
            Contribution("calibration of the camera, and height of the bearing", "B", float(sigma[1]), unit),
            Contribution("angle of the encoder at a rest", "B", REST_DEG, "°", float(sigma[2]) / REST_DEG),
        ]
        if unit == "px":
            budget.append(Contribution("common error of all corners", "B", BIAS_PX, "px"))
        if unit.startswith("mm"):
            scale = value / self._square_mm
            budget.append(Contribution("side of the board's squares, measured", "B", SQUARE_SIGMA_MM, "mm", scale))
        return Estimate(value, tuple(budget), unit)

    def _by_angle(self, p: Floats, jacobian: Floats) -> Floats:
        """Return how an error (rad) of the angle of each view acts on the normal equations, (views, parameters)."""
        step = 1e-4
        moved = (self._residuals(p, step) - self._residuals(p)) / step
        ends = 2 * np.cumsum([len(part) for part in self._points])
        parts = zip(np.split(moved, ends)[:-1], np.split(jacobian, ends)[:-1], strict=True)
        return np.stack([by_parameter.T @ by_angle for by_angle, by_parameter in parts])

    def _solved(self, start: Floats, evaluations: int) -> Any:
        return least_squares(
            self._residuals, start, loss="soft_l1", f_scale=ROBUST_PX, x_scale="jac", max_nfev=evaluations
        )

    def _geometry(self, p: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the axis' direction, the point on it about which it leans, and the lean."""
        up = self._up + p[0:2] @ self._across
        up = up / np.linalg.norm(up)
        return up, self._origin + p[2:4] @ self._across + p[6] * up, p[4:6]

    def _seen(self, points_mm: Floats, p: Floats) -> Floats:
        fx, fy, cx, cy, *distortion = p[7:FIRST_POSE]
        matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        seen = cv2.projectPoints(points_mm, np.zeros(3), np.zeros(3), matrix, np.array(distortion))[0]
        return np.asarray(seen, dtype=np.float64).reshape(-1, 2)

    def _reported(self, p: Floats) -> Floats:
        """Return the reported quantities: the point on the axis beside the first board's middle, its direction, ..."""
        up, point, lean = self._geometry(p)
        pose = p[FIRST_POSE : FIRST_POSE + 6]
        middle = cv2.Rodrigues(pose[:3])[0] @ self._middle + pose[3:]
        beside = point + up * float((middle - point) @ up)
        return np.concatenate([beside, up, self._seen(beside[None], p)[0], [degrees(hypot(*lean))]])

    def _residuals(self, p: Floats, further: float = 0.0) -> Floats:
        """Return the residuals of corners and known values, with the table rotated ``further`` (rad) in each view."""
        up, point, lean = self._geometry(p)
        parts = []
        for view, board_points in zip(self._views, self._points, strict=True):
            begin = FIRST_POSE + 6 * self._stands.index(view.stand)
            at_zero = board_points @ cv2.Rodrigues(p[begin : begin + 3])[0].T + p[begin + 3 : begin + 6]
            angle = radians(view.table_deg) + further
            c, s = np.cos(2 * angle), np.sin(2 * angle)
            leaning = (c * lean[0] - s * lean[1]) * self._across[0] + (s * lean[0] + c * lean[1]) * self._across[1]
            rotation = cv2.Rodrigues(leaning)[0] @ cv2.Rodrigues(up * angle)[0]
            parts.append(point + (at_zero - point) @ rotation.T)
        corners = (self._seen(np.concatenate(parts), p) - self._corners_px).ravel()
        return np.concatenate([corners, CORNER_PX * self._whiten @ (p[6:FIRST_POSE] - self._known)])


def pose(board: CharucoBoard, view: BoardView, matrix: Floats, distortion: Sequence[float]) -> tuple[Floats, Floats]:
    """Return rotation vector and translation (mm) of the board in the camera's frame."""
    _, rotation, translation = cv2.solvePnP(points(board, view), view.corners_px, matrix, np.array(distortion))
    return np.asarray(rotation, dtype=np.float64), np.asarray(translation, dtype=np.float64)


def first_axis(
    views: Sequence[BoardView], poses: Sequence[tuple[Floats, Floats]], middle: Floats
) -> tuple[Floats, Floats]:
    """Return direction and a point of the axis, from the rotations between poses and the circles of the middles."""
    direction = np.zeros(3)
    equations, values = [], []
    for (a, (rotation_a, shift_a)), (b, (rotation_b, shift_b)) in combinations(zip(views, poses, strict=True), 2):
        if a.stand != b.stand or abs(b.table_deg - a.table_deg) <= 15.0:  # too little rotation shows no axis
            continue
        before, after = cv2.Rodrigues(rotation_a)[0], cv2.Rodrigues(rotation_b)[0]
        between = after @ before.T
        rotated = cv2.Rodrigues(between)[0].ravel()
        direction += rotated * np.sign(b.table_deg - a.table_deg)
        centre_a, centre_b = before @ middle + shift_a.ravel(), after @ middle + shift_b.ravel()
        equations.append(np.eye(3) - between)
        values.append(centre_b - between @ centre_a)
    direction /= np.linalg.norm(direction)
    # The position along the axis is not determined: take the point nearest to the boards.
    centres = np.array([cv2.Rodrigues(r)[0] @ middle + t.ravel() for r, t in poses])
    equations.append(direction[None])
    values.append(np.array([float(centres.mean(axis=0) @ direction)]))
    point = np.linalg.lstsq(np.concatenate(equations), np.concatenate(values), rcond=None)[0]
    return direction, np.asarray(point, dtype=np.float64)


def _from_lens(estimates: Mapping[str, Estimate]) -> float:
    """Return the distance (mm) from the lens to the point on the axis at the height of the board's middle."""
    return float(np.linalg.norm([estimates[name].value for name in ("x", "y", "z")]))


def _check(found: Evaluation, board: CharucoBoard, space: ObjectSpace) -> None:
    """Reject a poor fit, a wobbling axis, and a board whose size contradicts the measured distance."""
    found.reject_above(MAX_RMS_PX, RejectionCode.CIRCLES_OFF, rms_px=found.residual)
    uncertainty = max(found.estimates["px"].uncertainty, found.estimates["py"].uncertainty)
    found.reject_above(MAX_UNCERTAINTY_PX, RejectionCode.AXIS_UNCERTAIN, uncertainty_px=uncertainty)
    wobble = found.estimates["wobble"]
    found.reject_if(
        wobble.value - 2 * wobble.uncertainty > MAX_WOBBLE_DEG,
        RejectionCode.AXIS_WOBBLES,
        wobble_deg=wobble.value,
        limit_deg=MAX_WOBBLE_DEG,
    )
    # Images alone do not determine lengths. Only the measured distance shows that the board has another size.
    if space.lens_mm is not None:
        lens_mm = _from_lens(found.estimates)
        found.reject_if(
            abs(lens_mm - space.lens_mm) > MAX_LENS_OFF * space.lens_mm,
            RejectionCode.BOARD_SIZE_WRONG,
            found_mm=lens_mm,
            lens_mm=space.lens_mm,
            true_square_mm=board.square_mm * space.lens_mm / lens_mm,
            square_mm=board.square_mm,
        )
