"""The camera and the table's axis from a board on the table: found, or rejected."""

from dataclasses import replace
from datetime import UTC, datetime
from functools import cache

import cv2
import numpy as np
import pytest

from calibration import camera_model, table_axis
from calibration.board_views import STANDS, BoardView
from calibration.procedure import Evaluation
from calibration.table_axis import ObjectSpace
from rig.calibrations import CalibrationResult, RejectionCode
from rig.views.charuco_board import CharucoBoard
from sim.calibration_board import boards
from tests.calibration.board_bench import blurred, optics, seen
from tests.calibration.drawn import codes, in_sigmas

WHEN = datetime(2026, 3, 1, tzinfo=UTC)
ALL = tuple(STANDS)


def camera(views: list[BoardView], board: CharucoBoard | None = None) -> CalibrationResult:
    return camera_model.evaluate(views, board or CharucoBoard(), (640, 480)).result(when_utc=WHEN)


def axis(views: list[BoardView], space: ObjectSpace | None = None, square_mm: float = 15.0) -> Evaluation:
    board = CharucoBoard(square_mm=square_mm, marker_mm=square_mm * 11 / 15)
    return table_axis.evaluate(views, board, calibrated(0), space or ObjectSpace())


@cache
def calibrated(seed: int) -> CalibrationResult:
    return camera(seen(optics(seed), ALL, camera_model.ANGLES_DEG))


@pytest.mark.parametrize("seed", [0, pytest.param(4, marks=pytest.mark.nightly)])
def test_true_camera_lies_within_the_stated_uncertainty(seed):
    result, true = calibrated(seed), optics(seed)
    assert result.passed, result.rejections
    truth = [*true.focal_px, *true.centre_px, *true.distortion[:4]]
    names = [name for name, _ in camera_model.PARAMETERS]
    assert np.abs(in_sigmas(result, **dict(zip(names, truth, strict=True)))).max() < 3.0
    assert result.estimates["fx"].value == pytest.approx(true.focal_px[0], rel=0.003)


@pytest.mark.parametrize(
    ("seed", "wobble_deg"),
    [(0, 0.15), *(pytest.param(*one, marks=pytest.mark.nightly) for one in ((0, 0.0), (4, 0.15)))],
)
def test_true_axis_lies_within_the_stated_uncertainty(seed, wobble_deg):
    true = optics(seed, wobble_deg)
    views = seen(true, table_axis.STANDS, table_axis.ANGLES_DEG[::2])
    result = table_axis.evaluate(views, CharucoBoard(), calibrated(seed))
    assert result.passed, result.rejections
    up, origin = np.array(true.rotation).reshape(3, 3)[:, 2], np.array(true.translation_mm)
    rotation, translation = boards(true)[table_axis.STANDS[0]].pose(0.0)
    middle = rotation @ CharucoBoard().points_mm().mean(axis=0) + translation
    beside = origin + up * ((middle - origin) @ up)
    px, py = cv2.projectPoints(beside[None], np.zeros(3), np.zeros(3), true.matrix, np.array(true.distortion))[
        0
    ].ravel()
    truth = dict(zip(("x", "y", "z", "ux", "uy", "uz"), [*beside, *up], strict=True)) | {"px": px, "py": py}
    assert np.abs(in_sigmas(result, **truth)).max() < 3.5
    assert result.estimates["px"].value == pytest.approx(px, abs=0.3)
    assert result.estimates["py"].value == pytest.approx(py, abs=0.3)
    assert result.estimates["wobble"].value == pytest.approx(wobble_deg, abs=0.05)


def test_cameras_that_differ_along_the_covariance_show_nearly_the_same_corners():
    """With independent parameters, as uncertain each, they do not: the axis must use what the views know together."""
    result = calibrated(0)
    covariance = camera_model.covariance(result)
    stated = [result.estimates[name].uncertainty for name, _ in camera_model.PARAMETERS]
    assert np.sqrt(np.diag(covariance)) == pytest.approx(stated)
    values = np.array([result.estimates[name].value for name, _ in camera_model.PARAMETERS])
    points, (matrix, distortion) = CharucoBoard().points_mm(), camera_model.matrix_of(result)

    def changed_px(change: np.ndarray) -> float:
        fx, fy, cx, cy, *other = values + change
        camera = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        squares = []
        for view in result.evidence["views"]:
            ids, corners = view["ids"], np.array(view["corners_px"])
            _, *pose = cv2.solvePnP(points[ids], corners, matrix, np.array(distortion))
            before = cv2.projectPoints(points[ids], *pose, matrix, np.array(distortion))[0]
            _, *pose = cv2.solvePnP(points[ids], before, camera, np.array(other))
            after = cv2.projectPoints(points[ids], *pose, camera, np.array(other))[0]
            squares.append(((after - before) ** 2).mean())
        return float(np.sqrt(np.mean(squares)))

    rng = np.random.default_rng(0)
    together = [changed_px(change) for change in rng.multivariate_normal(np.zeros(8), covariance, 4)]
    alone = [changed_px(rng.normal(0, stated)) for _ in range(4)]
    assert np.mean(together) < 0.02
    assert np.mean(together) < 0.3 * np.mean(alone)


def test_region_of_interest_holds_the_rotating_object():
    true = optics(0)
    views = seen(true, table_axis.STANDS[:1], table_axis.ANGLES_DEG)
    x, y, width, height = axis(views, ObjectSpace(radius_mm=40.0, height_mm=100.0)).settings["view.roi"]
    rotation, translation = true.to_camera(0.0)
    around = np.linspace(0, 2 * np.pi, 100)
    side = np.array([[40 * np.cos(a), 40 * np.sin(a), h] for a in around for h in np.linspace(0, 100, 5)])
    drawn = cv2.projectPoints(side, cv2.Rodrigues(rotation)[0], translation, true.matrix, np.array(true.distortion))[
        0
    ].reshape(-1, 2)
    assert np.allclose([x, y], drawn.min(axis=0), atol=4)
    assert np.allclose([x + width, y + height], drawn.max(axis=0), atol=4)


def test_objects_cut_off_by_the_frame_are_rejected():
    views = seen(optics(0), table_axis.STANDS, table_axis.ANGLES_DEG[::3])
    result = axis(views, ObjectSpace(height_mm=260.0))
    (rejection,) = result.rejections
    assert rejection.code is RejectionCode.OBJECTS_CUT_OFF
    assert rejection.values["top_px"] > 0
    assert not result.settings


@pytest.mark.nightly
def test_wrong_board_size_is_found_by_the_measured_distance():
    views = seen(optics(0), table_axis.STANDS, table_axis.ANGLES_DEG[::3])
    assert axis(views, ObjectSpace(lens_mm=480.0)).passed
    larger = axis(views, ObjectSpace(lens_mm=480.0), square_mm=18.0)
    assert [round(r.values["true_square_mm"]) for r in larger.rejections] == [15]
    assert not larger.settings


ANGLES = camera_model.ANGLES_DEG[::4]


@pytest.mark.parametrize(
    ("stands", "angles_deg", "changed", "code"),
    [
        (ALL[:2], ANGLES, {}, RejectionCode.TOO_FEW_VIEWS),
        (ALL, ANGLES, {"spoil": blurred}, RejectionCode.TOO_FEW_VIEWS),
        (ALL, ANGLES, {"change": lambda board: replace(board, loose_deg=4.0)}, RejectionCode.BOARD_LOOSE),
        pytest.param(ALL, ANGLES, {"ratio": 1.5}, RejectionCode.BOARD_LOOSE, marks=pytest.mark.nightly),
        (ALL, ANGLES, {"board": CharucoBoard(columns=6, rows=8)}, RejectionCode.TOO_FEW_VIEWS),
        (ALL[:1] * 3, camera_model.ANGLES_DEG[::2], {}, RejectionCode.COVERAGE_TOO_SMALL),
    ],
)
def test_poor_views_of_the_board_are_rejected(stands, angles_deg, changed, code):
    result = camera(seen(optics(1), stands, angles_deg, **changed), changed.get("board"))
    assert code in codes(result)
    assert not result.settings


def test_axis_of_a_loose_board_or_from_one_side_is_rejected():
    loose = seen(
        optics(0), table_axis.STANDS, table_axis.ANGLES_DEG[::3], change=lambda board: replace(board, loose_deg=1.0)
    )
    assert RejectionCode.CIRCLES_OFF in codes(axis(loose))
    one_side = seen(optics(0), table_axis.STANDS, (-20.0, -10.0, 0.0, 10.0, 20.0))
    assert RejectionCode.TOO_FEW_VIEWS in codes(axis(one_side))
