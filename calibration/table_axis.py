"""Where the table's axis is in the camera's frame, and how truly it turns, from a board that rides on the table.

The board's poses lie on circles about the axis: the axes of the rotations between them give its direction, a linear
fit to their centres a point on it. From there one fit of all corners, with the encoder's angles θ taken as they are:

    x = project(a + L(θ)·R(u, θ)·(X₀ − a)),    X₀ the board's points at θ = 0

by `least_squares(loss="soft_l1")`, with L the lean of a bearing out of true, to a side that goes round twice a turn.

In force it sets ``view.roi``: the part of the frame in which the objects stay while they turn, wherever the camera
stands.
"""

from collections.abc import Generator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import datetime
from math import degrees, hypot, radians, sqrt
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from calibration.board_views import STANDS as ALL_STANDS
from calibration.board_views import BoardView, as_json, look, points, turned_otherwise
from calibration.board_views import plot_views as plot_views_of
from calibration.camera_model import PARAMETERS, matrix_of
from calibration.events import Ask, Progress
from rig.bench import Bench
from rig.calibrations import CalibrationResult, Estimate
from rig.charts.xy import LIMIT, MODEL, Axis, Chart, Series
from rig.events.events import Event
from rig.views.charuco_board import Board

NAME = "table.axis"
VALID_DAYS = 365

STANDS = ("calibration-board upright", "calibration-board back")
ANGLES_DEG = tuple(float(angle) for angle in range(-60, 61, 10))
MIN_VIEWS = 8
MIN_SPAN_DEG = 60.0
MAX_RMS_PX = 0.4
MAX_WOBBLE_DEG = 0.5
MAX_UNCERTAINTY_PX = 0.3
MAX_LENS_OFF = 0.06
"""By how much, relative, a hand may be off that measures the distance from lens to axis."""
MAX_CUT = 0.1
"""Share of the room's height or width that the frame may cut off on a side: objects seldom fill its corners."""
ROBUST_PX = 0.3
CORNER_PX = 0.1
"""How well a corner is found: what is known of the camera weighs against the corners by it."""
PIVOT_MM = 80.0
"""The bearing is about as far as this below the board's middle."""
BIAS_PX = 0.02
"""What OpenCV's corners are off by together, whatever their number."""
FIRST_POSE = 15
"""Parameters before the poses of the board: direction, point and lean (two each), the pivot, and the camera."""

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Room:
    """The cylinder about the axis that holds the objects, and where the board stands in it.

    Attributes
    ----------
    radius_mm, height_mm
        Of the cylinder, which stands on the platter.
    board_mm
        How far the board's middle is above the platter on the first stand.
    lens_mm
        How far the lens is from the axis at that height, as somebody measured it; None where nobody did.
    """

    radius_mm: float = 80.0
    height_mm: float = 150.0
    board_mm: float = 75.0
    lens_mm: float | None = None


def live(
    bench: Bench, intrinsics: CalibrationResult, board: Board | None = None, room: Room | None = None
) -> Generator[Event | Ask | Progress | CalibrationResult, None, CalibrationResult]:
    """Have the board put on two stands, look at it from thirteen sides each, and find the axis.

    Parameters
    ----------
    bench
        An open one.
    intrinsics
        The camera's calibration.
    board
        Its layout, as printed.
    room
        What the region of interest is to hold.

    Raises
    ------
    ViewRejected, MotionTimeout, DeviceFault, DeviceSilent
        See `rig.views.capture` and `rig.motion.turntable`.
    """
    board = board or Board()
    room = room or Room()
    when_utc = bench.clock.utc()
    stands = {stand: ALL_STANDS[stand] for stand in STANDS}
    stands[STANDS[0]] += f", its middle {room.board_mm:g} mm above the platter"
    views, troubles = yield from look(bench, board, stands, ANGLES_DEG)
    fact = from_data(
        views,
        board,
        intrinsics,
        room=room,
        troubles=troubles,
        when_utc=when_utc,
        device=bench.apparatus("camera", "servo"),
    )
    if fact.passed:
        cut = ", ".join(fact.evidence["cut_off"])
        words = (
            f"The lens is {_from_lens(fact.estimates):.0f} mm from the axis: if it is not, the board's squares are not "
            f"{board.square_mm:g} mm. Objects are seen within {fact.settings['view.roi']} (x, y, width, height)"
        )
        yield Progress(1.0, f"{words}; the frame cuts off {cut} of the room for them" if cut else words)
    yield fact
    return fact


def from_data(
    views: Sequence[BoardView],
    board: Board,
    intrinsics: CalibrationResult,
    *,
    room: Room = Room(),
    troubles: Sequence[str] = (),
    when_utc: datetime,
    device: Mapping[str, Any],
) -> CalibrationResult:
    """Fit the axis to ``views`` of the board and judge it; see `calibration.camera_model.from_data`."""
    refusals = list(troubles)
    estimates: dict[str, Estimate] = {}
    rms = None
    region: list[int] = []
    evidence: dict[str, Any] = {"intrinsics": intrinsics.id, "views": as_json(views), "room": asdict(room)}
    span = max((v.table_deg for v in views), default=0.0) - min((v.table_deg for v in views), default=0.0)
    if len(views) < MIN_VIEWS or span < MIN_SPAN_DEG:
        refusals.append(
            f"The board was found in {len(views)} views over {span:.0f}°, {MIN_VIEWS} over {MIN_SPAN_DEG:g}° are "
            "needed: is it lit, sharp and in the frame, and the one that --print-board printed?"
        )
    else:
        matrix, distortion = matrix_of(intrinsics)
        poses = [_pose(board, view, matrix, distortion) for view in views]
        _, loose = turned_otherwise(views, poses)
        refusals += [loose] if loose else []
        axis = _Axis(views, board, intrinsics, poses)
        estimates, rms = axis.fit()
        evidence |= {"board_centres_mm": axis.centres_mm.round(3).tolist(), "radius_mm": axis.radii_mm}
        evidence["view_rms_px"] = axis.view_rms_px
        refusals += _judge(estimates, rms) + _measured(estimates, board, room)
        corners = region_of_interest(estimates, intrinsics, room)
        region, cut, too_much = _region(corners, intrinsics.evidence["size"], room)
        refusals += [too_much] if too_much else []
        evidence["cut_off"] = cut
    return CalibrationResult(
        name=NAME,
        estimates=estimates,
        residual=rms,
        limit=MAX_RMS_PX,
        residual_unit="px",
        refusals=tuple(refusals),
        settings={} if refusals else {"view.roi": region},
        valid_days=VALID_DAYS,
        when_utc=when_utc,
        device=device,
        evidence=evidence,
    )


def region_of_interest(estimates: Mapping[str, Estimate], intrinsics: CalibrationResult, room: Room) -> Floats:
    """Return the corners in the image of what the ``room`` takes up, float64 (2, 2): x and y, lowest and highest.

    They may lie outside the frame.
    """
    value = {name: estimate.value for name, estimate in estimates.items()}
    up = np.array([value["ux"], value["uy"], value["uz"]])
    foot = np.array([value["x"], value["y"], value["z"]]) - up * room.board_mm
    side = np.cross(up, [0.0, 0.0, 1.0])
    side /= np.linalg.norm(side)
    depth = np.cross(side, up)
    around = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    ring = room.radius_mm * (np.cos(around)[:, None] * side + np.sin(around)[:, None] * depth)
    cylinder = np.concatenate([foot + ring, foot + ring + up * room.height_mm])
    matrix, distortion = matrix_of(intrinsics)
    seen = cv2.projectPoints(cylinder, np.zeros(3), np.zeros(3), matrix, np.array(distortion))[0].reshape(-1, 2)
    return np.stack([seen.min(axis=0), seen.max(axis=0)]).astype(np.float64)


def _region(corners: Floats, size: Sequence[int], room: Room) -> tuple[list[int], list[str], str]:
    """Return the region within a frame of ``size`` (x, y, width, height), what the frame cuts off, and a refusal.

    The refusal is "" where it does not cut off too much.
    """
    low, high = np.floor(corners[0] + 0.5).astype(int), np.ceil(corners[1] + 0.5).astype(int)
    over = np.array([-low, high - size])  # left, top; right, bottom
    cut = [
        f"{over[i, j]} px at the {side}"
        for (i, j), side in (((0, 0), "left"), ((0, 1), "top"), ((1, 0), "right"), ((1, 1), "bottom"))
        if over[i, j] > 0
    ]
    too_much = bool((over > MAX_CUT * (high - low)).any())
    low, high = np.clip(low, 0, np.array(size) - 1), np.clip(high, 1, size)
    region = [*low.tolist(), *(high - low).tolist()]
    if not too_much:
        return region, cut, ""
    return (
        region,
        cut,
        f"Objects of {room.radius_mm:g} mm radius and {room.height_mm:g} mm height would be cut off by the frame: "
        f"{', '.join(cut)}. Aim the camera anew or move it away; or give what your objects need, by --radius-mm and "
        f"--height-mm. Is the middle of the board {room.board_mm:g} mm above the platter (--middle-mm)?",
    )


def plot(fact: CalibrationResult) -> Chart | None:
    """Return the way of the board's middle about the axis, seen along it, and the circles that were fitted."""
    if not fact.estimates:
        return None
    value = {name: estimate.value for name, estimate in fact.estimates.items()}
    up = np.array([value["ux"], value["uy"], value["uz"]])
    offset = np.array(fact.evidence["board_centres_mm"]) - np.array([value["x"], value["y"], value["z"]])
    side = np.cross(up, [0.0, 0.0, 1.0])
    side /= np.linalg.norm(side)
    across, along = offset @ -side, offset @ np.cross(side, up)  # the camera is below
    around = np.linspace(0.0, 2 * np.pi, 97)
    return Chart(
        f"The board about the axis, seen from above; wobble {fact.estimates['wobble']}",
        Axis("mm"),
        Axis("mm from the axis"),
        [
            *(
                Series("", (r * np.cos(around)).tolist(), (r * np.sin(around)).tolist(), MODEL, dots=False, curve=True)
                for r in fact.evidence["radius_mm"]
            ),
            Series("middle of the board", across.tolist(), along.tolist()),
            Series("axis", [0.0], [0.0], LIMIT),
        ],
        square=True,
    )


def plot_views(fact: CalibrationResult) -> Chart | None:
    """Return how far the corners of each view are off the fit; see `calibration.board_views.plot_views`."""
    return plot_views_of(fact, MAX_RMS_PX)


class _Axis:
    """The fit: two angles of the axis, two offsets of a point on it, its lean, the camera, and a pose for each stand.

    The camera and the height about which the axis leans are not free: what is known of them pulls, by its uncertainty.
    """

    def __init__(
        self,
        views: Sequence[BoardView],
        board: Board,
        intrinsics: CalibrationResult,
        poses: Sequence[tuple[Floats, Floats]],
    ) -> None:
        self._views = views
        camera = [intrinsics.estimates[name] for name, _ in PARAMETERS]
        self._known = np.array([-PIVOT_MM, *(estimate.value for estimate in camera)])
        self._known_sigma = np.array([PIVOT_MM / 2, *(estimate.uncertainty for estimate in camera)])
        self._known_sigma[1:3] *= sqrt(2)  # both focal lengths err together: two of them know no more than one
        self._points = [points(board, view) for view in views]
        self._middle = board.points_mm().mean(axis=0)
        self._stands = sorted({view.stand for view in views})
        self._up, self._origin = _first_axis(views, poses, self._middle)
        # Two directions across the axis, in which the point on it may move and the axis lean.
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
        self.centres_mm = np.array([cv2.Rodrigues(r)[0] @ self._middle + t.ravel() for r, t in poses])
        offset = self.centres_mm - self._origin
        radial = np.linalg.norm(offset - np.outer(offset @ self._up, self._up), axis=1)
        self.radii_mm = [
            float(np.mean([r for r, v in zip(radial, views, strict=True) if v.stand == stand]))
            for stand in self._stands
        ]

    def fit(self) -> tuple[dict[str, Estimate], float]:
        """Return the estimates, and the root mean square of the corners' residuals in pixels."""
        # From no lean at all the fit may walk to a lean about the wrong side: it begins at three, and the best counts.
        starts = [self._start.copy() for _ in range(3)]
        for start, turn in zip(starts, np.radians([0.0, 120.0, 240.0]), strict=True):
            start[4:6] = radians(0.05) * np.array([np.cos(turn), np.sin(turn)])
        tried = [self._solved(start, evaluations=15) for start in starts]
        solved = self._solved(min(tried, key=lambda found: float(found.cost)).x, evaluations=60)
        residuals = self._residuals(solved.x)[: -self._known.size]
        squares = (residuals.reshape(-1, 2) ** 2).sum(axis=1)
        ends = np.cumsum([len(part) for part in self._points])[:-1]
        self.view_rms_px = [round(float(np.sqrt(part.mean())), 3) for part in np.split(squares, ends)]
        freedom = max(residuals.size - solved.x.size, 1)
        rms = float(np.sqrt(squares.mean()))
        covariance = np.linalg.inv(solved.jac.T @ solved.jac) * float((residuals**2).sum()) / freedom
        # How everything told depends on the parameters, by differences.
        told = self._told(solved.x)
        steps = np.sqrt(np.diag(covariance)) * 1e-2 + 1e-12
        jacobian = np.column_stack(
            [
                (self._told(solved.x + step * unit) - told) / step
                for step, unit in zip(steps, np.eye(steps.size), strict=True)
            ]
        )
        sigma = np.sqrt(np.diag(jacobian @ covariance @ jacobian.T))
        names = ("x", "y", "z", "ux", "uy", "uz", "px", "py", "wobble")
        units = ("mm", "mm", "mm", "", "", "", "px", "px", "°")
        estimates = {
            name: Estimate(float(value), float(s), unit)
            for name, unit, value, s in zip(names, units, told, sigma, strict=True)
        }
        for name in ("px", "py"):
            estimates[name] = replace(estimates[name], uncertainty=hypot(estimates[name].uncertainty, BIAS_PX))
        estimates["eccentricity"] = Estimate(self.radii_mm[0], float(np.linalg.norm(sigma[:3])), "mm of the board")
        return estimates, rms

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

    def _told(self, p: Floats) -> Floats:
        """Return what is told: the point on the axis beside the first board's middle, the direction, and the rest."""
        up, point, lean = self._geometry(p)
        pose = p[FIRST_POSE : FIRST_POSE + 6]
        middle = cv2.Rodrigues(pose[:3])[0] @ self._middle + pose[3:]
        beside = point + up * float((middle - point) @ up)
        return np.concatenate([beside, up, self._seen(beside[None], p)[0], [degrees(hypot(*lean))]])

    def _residuals(self, p: Floats) -> Floats:
        up, point, lean = self._geometry(p)
        parts = []
        for view, board_points in zip(self._views, self._points, strict=True):
            begin = FIRST_POSE + 6 * self._stands.index(view.stand)
            at_zero = board_points @ cv2.Rodrigues(p[begin : begin + 3])[0].T + p[begin + 3 : begin + 6]
            turn = radians(view.table_deg)
            c, s = np.cos(2 * turn), np.sin(2 * turn)
            leaning = (c * lean[0] - s * lean[1]) * self._across[0] + (s * lean[0] + c * lean[1]) * self._across[1]
            rotation = cv2.Rodrigues(leaning)[0] @ cv2.Rodrigues(up * turn)[0]
            now = point + (at_zero - point) @ rotation.T
            parts.append((self._seen(now, p) - view.corners_px).ravel())
        parts.append(CORNER_PX * (p[6:FIRST_POSE] - self._known) / self._known_sigma)
        return np.concatenate(parts)


def _pose(board: Board, view: BoardView, matrix: Floats, distortion: Sequence[float]) -> tuple[Floats, Floats]:
    """Return rotation vector and translation (mm) of the board in the camera's frame."""
    _, rotation, translation = cv2.solvePnP(points(board, view), view.corners_px, matrix, np.array(distortion))
    return np.asarray(rotation, dtype=np.float64), np.asarray(translation, dtype=np.float64)


def _first_axis(
    views: Sequence[BoardView], poses: Sequence[tuple[Floats, Floats]], middle: Floats
) -> tuple[Floats, Floats]:
    """Return direction and a point of the axis: from the rotations between poses, and the circles of the middles."""
    direction = np.zeros(3)
    equations, values = [], []
    for (a, (rotation_a, shift_a)), (b, (rotation_b, shift_b)) in (
        (first, second)
        for i, first in enumerate(zip(views, poses, strict=True))
        for second in list(zip(views, poses, strict=True))[i + 1 :]
        if first[0].stand == second[0].stand and abs(second[0].table_deg - first[0].table_deg) > 15.0
    ):
        before, after = cv2.Rodrigues(rotation_a)[0], cv2.Rodrigues(rotation_b)[0]
        between = after @ before.T
        turned = cv2.Rodrigues(between)[0].ravel()
        direction += turned * np.sign(b.table_deg - a.table_deg)
        centre_a, centre_b = before @ middle + shift_a.ravel(), after @ middle + shift_b.ravel()
        equations.append(np.eye(3) - between)
        values.append(centre_b - between @ centre_a)
    direction /= np.linalg.norm(direction)
    # Along the axis nothing is determined: the point nearest to the boards is taken.
    centres = np.array([cv2.Rodrigues(r)[0] @ middle + t.ravel() for r, t in poses])
    equations.append(direction[None])
    values.append(np.array([float(centres.mean(axis=0) @ direction)]))
    point = np.linalg.lstsq(np.concatenate(equations), np.concatenate(values), rcond=None)[0]
    return direction, np.asarray(point, dtype=np.float64)


def _from_lens(estimates: Mapping[str, Estimate]) -> float:
    """Return how far the lens is from the axis at the height of the board's middle, in mm, along the line of sight."""
    return float(np.linalg.norm([estimates[name].value for name in ("x", "y", "z")]))


def _measured(estimates: Mapping[str, Estimate], board: Board, room: Room) -> list[str]:
    """Return why the board's size must be wrong, if the measured distance says so: pictures alone tell no lengths."""
    found = _from_lens(estimates)
    if room.lens_mm is None or abs(found - room.lens_mm) <= MAX_LENS_OFF * room.lens_mm:
        return []
    return [
        f"By the board the lens is {found:.0f} mm from the axis, by --lens-mm {room.lens_mm:.0f}: its squares would be "
        f"{board.square_mm * room.lens_mm / found:.1f} mm wide, not {board.square_mm:g}. Measure a square on the print "
        "and give --square-mm, or print it true to scale."
    ]


def _judge(estimates: Mapping[str, Estimate], rms: float) -> list[str]:
    refusals = []
    if rms > MAX_RMS_PX:
        refusals.append(
            f"The corners are off the circles by {rms:.2f} px (RMS), above {MAX_RMS_PX:g}: the board is loose, the "
            "table moved while it was looked at, or the camera was touched since its calibration. Fix them, run `rig "
            "calibrate camera` where the lens was touched, and calibrate again."
        )
    uncertainty = max(estimates["px"].uncertainty, estimates["py"].uncertainty)
    if uncertainty > MAX_UNCERTAINTY_PX:
        refusals.append(
            f"The axis is uncertain by {uncertainty:.2f} px in the image, more than {MAX_UNCERTAINTY_PX:g}: bring "
            "the board nearer, or light it better."
        )
    wobble = estimates["wobble"]
    if wobble.value - 2 * wobble.uncertainty > MAX_WOBBLE_DEG:
        refusals.append(
            f"The axis wobbles by {wobble.value:.2f}°, more than {MAX_WOBBLE_DEG:g}°: the bearing is out of true, or "
            "the horn loose."
        )
    return refusals
