"""Views of the calibration board on the turning table: it is the manipulator, a person only changes the stand."""

from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass
from math import degrees
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration import pictures
from calibration.events import Ask, Progress
from rig.bench import Bench
from rig.calibrations import CalibrationResult
from rig.charts.xy import LIMIT, MEASURED, MODEL, OTHER, Axis, Chart, Series
from rig.events.events import Event
from rig.motion.turntable import Turntable
from rig.plans.capture import capture, moved
from rig.views.capture import Viewer
from rig.views.charuco_board import Board, BoardDetection, detect_board

MIN_CORNERS = 12
"""Corners that a view needs to say where the board is."""
MIN_MARKERS = 6
"""Markers by which the board is known to be there, whether its corners are found or not."""
GRID = (4, 4)
"""Columns and rows of the frame, for the coverage."""
LOOSE_DEG = 1.5
"""The board and the encoder may differ by so much about a move; beyond it the board is loose, or the table moved."""

STANDS = {
    "calibration-board upright": "upright in the middle of the platter, facing the camera",
    "calibration-board back": "leaning back by about 30°, facing the camera",
    "calibration-board left": "upright at the left edge of the platter, facing the camera, turned a little in its "
    "plane",
    "calibration-board right": "leaning back by about 15° at the right edge, turned in its plane the other way",
}
"""How the board is to stand, by the name under which a simulated bench knows it."""

PICTURES = {
    "calibration-board upright": pictures.BOARD_UPRIGHT,
    "calibration-board back": pictures.BOARD_BACK,
    "calibration-board left": pictures.BOARD_LEFT,
    "calibration-board right": pictures.BOARD_RIGHT,
}


@dataclass(frozen=True, slots=True)
class BoardView:
    """The board at one rest: which stand, the table's angle by the encoder (°), and its corners."""

    stand: int
    table_deg: float
    ids: NDArray[np.int64]
    corners_px: NDArray[np.float64]


def look(
    bench: Bench, board: Board, stands: Mapping[str, str], angles_deg: Sequence[float]
) -> Generator[Event | Ask | Progress, None, tuple[list[BoardView], list[str]]]:
    """Have the board put on each of the ``stands``, go to each of the ``angles_deg``, and find its corners.

    The stands come with how the board is to stand, as in `STANDS`. Returns the views, and what was odd about what was
    seen.

    Raises
    ------
    ViewRejected, MotionTimeout, DeviceFault, DeviceSilent
        See `rig.views.capture` and `rig.motion.turntable`.
    """
    views: list[BoardView] = []
    foreign: set[int] = set()
    elsewhere = 0
    index, planned = 0, len(stands) * len(angles_deg)
    known = set(np.asarray(board.layout().getIds()).ravel().tolist())
    viewer = Viewer(bench.camera, bench.config.view)
    for number, (stand, words) in enumerate(stands.items()):
        yield Ask(
            f"Put the calibration board {words}; fix it there, and take your hands off. Its squares are "
            f"{board.square_mm:g} mm wide, as measured on the print (--square-mm).",
            PICTURES[stand],
        )
        bench.operator.place(stand)
        with Turntable(bench) as table:
            for angle_deg in angles_deg:
                move = table.goto(angle_deg)
                yield moved(index, move)
                shot = yield from capture(index, viewer, table, move.settled_ns)
                seen = detect_board(board, shot.image_bgr)
                foreign |= set(seen.marker_ids.tolist()) - known
                elsewhere += seen.marker_ids.size >= MIN_MARKERS and not seen.ids.size
                if seen.ids.size >= MIN_CORNERS:
                    views.append(BoardView(number, table.rest_deg, seen.ids, seen.corners_px))
                index += 1
                yield Progress(index / planned, _words(seen, board, views, bench))
            table.goto(angles_deg[0])
    layout = f"a board of {board.columns} columns and {board.rows} rows"
    remedy = "give the board's own --columns and --rows, or print it anew with --print-board."
    troubles = []
    if foreign:
        troubles.append(f"Markers were seen that are not on {layout} ({sorted(foreign)}): {remedy}")
    if elsewhere > planned // 4:
        troubles.append(f"In {elsewhere} views markers were seen, but not where {layout} has them: {remedy}")
    return views, troubles


def coverage(views: Sequence[BoardView], size: tuple[int, int]) -> NDArray[np.int64]:
    """Return how many corners lie in each cell of the frame, int (rows, columns); ``size`` is (width, height)."""
    columns, rows = GRID
    cells = np.zeros((rows, columns), dtype=np.int64)
    for view in views:
        x = np.clip((view.corners_px[:, 0] * columns / size[0]).astype(int), 0, columns - 1)
        y = np.clip((view.corners_px[:, 1] * rows / size[1]).astype(int), 0, rows - 1)
        np.add.at(cells, (y, x), 1)
    return cells


def turned_otherwise(
    views: Sequence[BoardView], poses: Sequence[tuple[NDArray[np.float64], NDArray[np.float64]]]
) -> tuple[float, str]:
    """Return the largest disagreement of board and encoder about a turn, in degrees, and what it says; "" if small.

    Parameters
    ----------
    views
        In the order in which they were taken.
    poses
        Rotation vector and translation of the board in the camera's frame, for each view.
    """
    worst = 0.0
    for (a, (rotation_a, _)), (b, (rotation_b, _)) in zip(
        zip(views[:-1], poses[:-1], strict=True), zip(views[1:], poses[1:], strict=True), strict=True
    ):
        if a.stand != b.stand:
            continue
        between = cv2.Rodrigues(rotation_b)[0] @ cv2.Rodrigues(rotation_a)[0].T
        seen_deg = degrees(float(np.linalg.norm(cv2.Rodrigues(between)[0])))
        worst = max(worst, abs(seen_deg - abs(b.table_deg - a.table_deg)))
    if worst <= LOOSE_DEG:
        return worst, ""
    return worst, (
        f"Between two views the board turned by {worst:.1f}° more or less than the table: it is loose on its stand, "
        "the table moves while it is looked at, or servo.gear_ratio is wrong. Fix the board, and calibrate again."
    )


def points(board: Board, view: BoardView) -> NDArray[np.float64]:
    """Return the board's points that a view shows, float64 (n, 3), mm."""
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
    """Return the views of each stand, as in the evidence, with its name and colour in every chart."""
    numbers = sorted({view["stand"] for view in views})
    return [
        (f"stand {number + 1}", colour, [view for view in views if view["stand"] == number])
        for number, colour in zip(numbers, (MEASURED, MODEL, OTHER, "#cc79a7"), strict=False)
    ]


def plot_views(fact: CalibrationResult, limit_px: float) -> Chart | None:
    """Return how far the corners of each view are off the fit (RMS); the title names the worst."""
    views, rms = fact.evidence["views"], fact.evidence.get("view_rms_px")
    if not rms:
        return None
    numbered = [{**view, "number": i + 1, "rms": value} for i, (view, value) in enumerate(zip(views, rms, strict=True))]
    worst = sorted(numbered, key=lambda view: -view["rms"])[:2]
    named = ", ".join(
        f"{view['number']} (stand {view['stand'] + 1} at {view['table_deg']:.0f}°) {view['rms']:.2f} px"
        for view in worst
    )
    return Chart(
        f"Worst views: {named}",
        Axis("view", whole=True),
        Axis("corners off the fit, px (RMS)", span=(0.0, limit_px)),
        [
            *(
                Series(name, [view["number"] for view in of_stand], [view["rms"] for view in of_stand], colour)
                for name, colour, of_stand in by_stand(numbered)
            ),
            Series("limit of all", [1, len(views)], [limit_px] * 2, LIMIT, dots=False, curve=True, dashed=True),
        ],
    )


def _words(seen: BoardDetection, board: Board, views: Sequence[BoardView], bench: Bench) -> str:
    identity = bench.camera.identity
    cells = coverage(views, (identity.width, identity.height)) if views else np.zeros(GRID)
    covered = float((cells > 0).mean())
    return f"{seen.ids.size} of {board.corners} corners; {covered:.0%} of the frame covered so far"
