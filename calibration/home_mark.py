"""Measure where the home mark is: how its card stands in the camera's frame at home, and the table's axis.

The card is a small ChArUco board at a fixed place of the platter. While the table rotates by θ, the card's rotation is
R(u, θ)·R₀; the axis u and the rotation R₀ at home follow from views at several angles. `rig home` uses them.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import radians
from typing import Final

import cv2
import numpy as np

from calibration import camera_model
from calibration.board_views import BoardView, span_deg, take_views
from calibration.camera_model import matrix_of
from calibration.procedure import Evaluation, Measured, Procedure
from calibration.table_axis import first_axis, pose
from rig.bench import Bench
from rig.calibrations import CalibrationResult, Contribution, RejectionCode
from rig.config import MarkConfig
from rig.views.charuco_board import BoardDetection, CharucoBoard, mark_angle_deg

NAME: Final = "table.mark"
STAND: Final = {"home-mark": "at the fixed place of the home mark, facing the camera while the table is at home"}
ANGLES_DEG: Final = tuple(float(angle) for angle in range(-50, 51, 10))
MIN_VIEWS, MIN_SPAN_DEG = 5, 40.0  # less: the axis is uncertain
MAX_RESIDUAL_DEG = 3.0
"""Largest error of the angle in one view: more is a card that moves."""


@dataclass(frozen=True)
class HomeMark(Procedure):
    """A procedure that takes views of the card from eleven sides. Needs the camera's calibration."""

    result_name, devices, valid_days = NAME, ("camera", "servo"), 365
    reference = "encoder of the servo; ChArUco card, {card.columns} × {card.rows} squares of {card.square_mm:g} mm"
    requires = (camera_model.NAME,)
    card: CharucoBoard

    def measure(self, bench: Bench, *required: CalibrationResult) -> Measured:
        found = Evaluation(name=NAME)
        views = yield from take_views(bench, self.card, STAND, ANGLES_DEG, found)
        return evaluate(views, self.card, required[0], found)


def evaluate(
    views: Sequence[BoardView], card: CharucoBoard, intrinsics: CalibrationResult, found: Evaluation
) -> Evaluation:
    """Fit the axis and the card's rotation at home to ``views``."""
    found.residual_unit, found.limit, span = "°", MAX_RESIDUAL_DEG, span_deg(views)
    if len(views) < MIN_VIEWS or span < MIN_SPAN_DEG:
        values = {"found": len(views), "span_deg": span, "needed": MIN_VIEWS, "needed_deg": MIN_SPAN_DEG}
        return found.reject(RejectionCode.TOO_FEW_VIEWS, **values)
    matrix, distortion = matrix_of(intrinsics)
    poses = [pose(card, view, matrix, distortion) for view in views]
    axis, _ = first_axis(views, poses, card.points_mm().mean(axis=0))
    back = [cv2.Rodrigues(-radians(view.table_deg) * axis)[0] for view in views]
    at_home = sum(backwards @ cv2.Rodrigues(rotation)[0] for backwards, (rotation, _) in zip(back, poses, strict=True))
    left, _, right = np.linalg.svd(at_home)  # the rotation nearest to the mean
    mark = MarkConfig(
        card=(card.columns, card.rows, card.square_mm, card.marker_mm),
        camera=(matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *distortion),
        rotation=tuple(cv2.Rodrigues(left @ right)[0].ravel().tolist()),
        axis=tuple(axis.tolist()),
    )
    # The angle of each view as `rig home` would find it.
    nothing = np.empty(0, np.int64)
    angles = [mark_angle_deg(BoardDetection(view.ids, view.corners_px, nothing), mark) for view in views]
    errors = [180.0 if seen is None else seen - view.table_deg for seen, view in zip(angles, views, strict=True)]
    found.residual = residual = max(map(abs, errors))
    scatter = Contribution("scatter of single views", "A", float(np.std(errors)), "°")
    found.estimate("angle", np.mean(errors), "°", scatter)
    found.evidence = {"views": len(views), "errors_deg": np.round(errors, 2).tolist()}
    found.proposed = {f"mark.{key}": list(value) for key, value in mark.model_dump().items()}
    found.reject_if(residual > MAX_RESIDUAL_DEG, RejectionCode.BOARD_LOOSE, difference_deg=residual)
    return found
