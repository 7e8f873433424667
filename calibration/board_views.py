"""Views of the calibration board on the table, which rotates the board; the operator only changes its position."""

from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import degrees
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.procedure import Ask, Evaluation
from rig.bench import Bench
from rig.calibrations import CalibrationResult, RejectionCode
from rig.charts.xy import FOURTH, LIMIT, MEASURED, MODEL, OTHER, Axis, Chart, Series
from rig.core.phrases import angle_words, percent
from rig.events.events import Event
from rig.jobs.desk import Progress
from rig.motion.turntable import Turntable
from rig.plans.steps import capture, moved
from rig.views.capture import Viewer
from rig.views.charuco_board import BoardDetection, CharucoBoard, detect_board

MIN_CORNERS = 12  # a pose has six numbers; of twelve corners a wrong one is noticed
"""Corners that a view needs to determine the board's pose."""
MIN_MARKERS = 6
"""Markers that show that a board is there, even if its corners are not found."""
GRID = (4, 4)
"""Columns and rows of the frame, for the coverage."""
LOOSE_DEG = 1.5
"""Largest difference of a rotation between board and encoder; beyond it the board is loose, or the table moved."""

STANDS = {
    "calibration-board upright": "upright in the middle of the platter, across the axis, facing the camera",
    "calibration-board back": "in the middle, leaning back by about 30°, facing the camera",
    "calibration-board left": "upright at the left edge of the platter, facing the camera, rotated a little in its "
    "plane",
    "calibration-board right": "leaning back by about 15° at the right edge, rotated in its plane the other way",
}
"""The positions of the board, by the names that a simulated bench knows."""


@dataclass(frozen=True, slots=True)
class BoardView:
    """The board at one rest: the number of its position, the table's angle by the encoder (°), and its corners."""

    stand: int
    table_deg: float
    ids: NDArray[np.int64]
    corners_px: NDArray[np.float64]


def take_views(
    bench: Bench, board: CharucoBoard, stands: Mapping[str, str], angles_deg: Sequence[float], found: Evaluation
) -> Generator[Event | Ask | Progress, None, list[BoardView]]:
    """Ask for the board in each of the positions ``stands``, rotate to each of the ``angles_deg``, return the views.

    ``stands`` maps names to descriptions, as in `STANDS`. A wrong board becomes a rejection of ``found``.

    Raises ViewRejected, MotionTimeout, DeviceFault, DeviceSilent: see `rig.views.capture` and `rig.motion.turntable`.
    """
    views: list[BoardView] = []
    foreign: set[int] = set()
    elsewhere = 0
    index, planned = 0, len(stands) * len(angles_deg)
    known = set(np.asarray(board.layout().getIds()).ravel().tolist())
    viewer = Viewer(bench.camera, bench.config)
    for number, (stand, words) in enumerate(stands.items()):
        yield Ask(
            f"Put the calibration board {words}. Fix it there, and take your hands off. Its squares are "
            f"{board.square_mm:g} mm wide, as measured on the print (--square-mm).",
        )
        bench.place(stand)
        with Turntable(bench) as table:
            for angle_deg in angles_deg:
                move = table.goto(angle_deg)
                yield moved(index, move)
                captured = yield from capture(index, viewer, table, move.settled_ns)
                # Remember markers of another board, and frames in which the layout does not fit.
                seen = detect_board(board, captured.image_bgr)
                foreign |= set(seen.marker_ids.tolist()) - known
                elsewhere += seen.marker_ids.size >= MIN_MARKERS and not seen.ids.size
                if seen.ids.size >= min(MIN_CORNERS, board.corners):
                    views.append(BoardView(number, table.rest_deg, seen.ids, seen.corners_px))
                index += 1
                yield Progress(index / planned, _words(seen, board, views, bench))
            table.goto(angles_deg[0])
    layout = {"columns": board.columns, "rows": board.rows}
    found.reject_if(foreign, RejectionCode.FOREIGN_MARKERS, markers=sorted(foreign), **layout)
    found.reject_if(elsewhere > planned // 4, RejectionCode.WRONG_BOARD_LAYOUT, views=elsewhere, **layout)
    return views


def coverage(views: Sequence[BoardView], size: tuple[int, int]) -> NDArray[np.int64]:
    """Return the number of corners in each cell of the frame, int (rows, columns); ``size`` is (width, height)."""
    x, y = np.concatenate([np.empty((0, 2)), *(view.corners_px for view in views)]).T
    cells, _, _ = np.histogram2d(y, x, bins=GRID[::-1], range=((0, size[1]), (0, size[0])))
    return np.asarray(cells, np.int64)


def reject_loose_board(
    found: Evaluation, views: Sequence[BoardView], poses: Sequence[tuple[NDArray[np.float64], NDArray[np.float64]]]
) -> None:
    """Reject views between which board and encoder rotated by different angles.

    ``views`` are in the order in which they were taken; ``poses`` are rotation vector and translation of the board in
    the camera's frame, for each view.
    """
    worst = 0.0
    for (a, (rotation_a, _)), (b, (rotation_b, _)) in pairwise(zip(views, poses, strict=True)):
        if a.stand != b.stand:
            continue
        between = cv2.Rodrigues(rotation_b)[0] @ cv2.Rodrigues(rotation_a)[0].T
        seen_deg = degrees(float(np.linalg.norm(cv2.Rodrigues(between)[0])))
        worst = max(worst, abs(seen_deg - abs(b.table_deg - a.table_deg)))
    found.reject_if(worst > LOOSE_DEG, RejectionCode.BOARD_LOOSE, difference_deg=worst)


def span_deg(views: Sequence[BoardView]) -> float:
    """Return the range of the table's angles in ``views``."""
    return max((v.table_deg for v in views), default=0.0) - min((v.table_deg for v in views), default=0.0)


def points(board: CharucoBoard, view: BoardView) -> NDArray[np.float64]:
    """Return the points of the board in a view, float64 (n, 3), mm."""
    return board.points_mm()[view.ids]


def as_json(views: Sequence[BoardView]) -> list[dict[str, Any]]:
    """Return views as evidence, enough to fit again."""
    return [
        {
            "stand": view.stand,
            "table_deg": round(view.table_deg, 3),
            "ids": view.ids.tolist(),
            "corners_px": view.corners_px.round(3).tolist(),
        }
        for view in views
    ]


def by_stand(views: Sequence[Mapping[str, Any]]) -> list[tuple[str, str, list[Mapping[str, Any]]]]:
    """Return the views of each position of the board, as in the evidence, with its name and colour in charts."""
    numbers = sorted({view["stand"] for view in views})
    return [
        (f"stand {number + 1}", colour, [view for view in views if view["stand"] == number])
        for number, colour in zip(numbers, (MEASURED, MODEL, OTHER, FOURTH), strict=False)
    ]


def plot_views(result: CalibrationResult, limit_px: float) -> Chart | None:
    """Return a chart of the deviation of each view's corners from the fit (RMS); the title names the worst views."""
    views, rms = result.evidence["views"], result.evidence.get("view_rms_px")
    if not rms:
        return None
    numbered = [{**view, "number": i + 1, "rms": value} for i, (view, value) in enumerate(zip(views, rms, strict=True))]
    worst = sorted(numbered, key=lambda view: -view["rms"])[:2]
    named = ", ".join(
        f"{view['number']} (stand {view['stand'] + 1} at {angle_words(view['table_deg'], 0)}) {view['rms']:.2f} px"
        for view in worst
    )
    return Chart(
        f"Worst views: {named}",
        Axis("view", whole=True),
        Axis("deviation of the corners, px (RMS)", span=(0.0, limit_px)),
        [
            *(
                Series(name, [view["number"] for view in of_stand], [view["rms"] for view in of_stand], colour)
                for name, colour, of_stand in by_stand(numbered)
            ),
            Series("limit of all", [1, len(views)], [limit_px] * 2, LIMIT, dots=False, curve=True, dashed=True),
        ],
    )


def _words(seen: BoardDetection, board: CharucoBoard, views: Sequence[BoardView], bench: Bench) -> str:
    identity = bench.camera.identity
    covered = float((coverage(views, (identity.width, identity.height)) > 0).mean())
    return f"{seen.ids.size} of {board.corners} corners; {percent(covered, 0)} of the frame covered so far"
