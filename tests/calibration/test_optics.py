"""The camera and the table's axis from a board on the turning table: found, or refused with the reason."""

from dataclasses import replace
from datetime import UTC, datetime
from functools import cache

import cv2
import numpy as np
import pytest

from calibration import camera_model, table_axis
from calibration.board_views import STANDS, BoardView
from calibration.table_axis import Room
from rig.calibrations import CalibrationResult
from rig.views.charuco_board import Board
from sim.calibration_board import boards
from tests.calibration.board_bench import blurred, optics, seen

WHEN = datetime(2026, 3, 1, tzinfo=UTC)
ALL = list(STANDS)


def camera(views: list[BoardView], board: Board | None = None) -> CalibrationResult:
    return camera_model.from_data(views, board or Board(), (640, 480), when_utc=WHEN, device={})


def axis(views: list[BoardView], intrinsics: CalibrationResult) -> CalibrationResult:
    return table_axis.from_data(views, Board(), intrinsics, when_utc=WHEN, device={})


@cache
def calibrated(seed: int, wobble_deg: float = 0.0) -> CalibrationResult:
    return camera(seen(optics(seed, wobble_deg), ALL, camera_model.ANGLES_DEG))


@pytest.mark.parametrize("seed", [0, 4])
def test_the_true_camera_lies_within_the_stated_uncertainty(seed):
    fact, true = calibrated(seed), optics(seed)
    assert fact.passed, fact.refusals
    truth = [*true.focal_px, *true.centre_px, *true.distortion[:4]]
    z = [
        (fact.estimates[name].value - value) / fact.estimates[name].uncertainty
        for (name, _), value in zip(camera_model.PARAMETERS, truth, strict=True)
    ]
    assert np.abs(z).max() < 3.0
    assert fact.estimates["fx"].value == pytest.approx(true.focal_px[0], rel=0.003)


@pytest.mark.parametrize(("seed", "wobble_deg"), [(0, 0.0), (4, 0.15)])
def test_the_true_axis_lies_within_the_stated_uncertainty(seed, wobble_deg):
    true = optics(seed, wobble_deg)
    fact = axis(seen(true, table_axis.STANDS, table_axis.ANGLES_DEG[::2]), calibrated(seed, wobble_deg))
    assert fact.passed, fact.refusals
    up, origin = np.array(true.rotation).reshape(3, 3)[:, 2], np.array(true.translation_mm)
    rotation, translation = boards(true)[table_axis.STANDS[0]].pose(0.0)
    middle = rotation @ Board().points_mm().mean(axis=0) + translation
    beside = origin + up * ((middle - origin) @ up)
    px, py = cv2.projectPoints(beside[None], np.zeros(3), np.zeros(3), true.matrix, np.array(true.distortion))[
        0
    ].ravel()
    truth = dict(zip(("x", "y", "z", "ux", "uy", "uz"), [*beside, *up], strict=True)) | {"px": px, "py": py}
    for name, value in truth.items():
        estimate = fact.estimates[name]
        assert abs(estimate.value - value) < 3.5 * estimate.uncertainty, name
    assert fact.estimates["px"].value == pytest.approx(px, abs=0.3)
    assert fact.estimates["py"].value == pytest.approx(py, abs=0.3)
    assert fact.estimates["wobble"].value == pytest.approx(wobble_deg, abs=0.05)


def test_the_region_of_interest_holds_the_turning_object():
    true, room = optics(0), Room(radius_mm=40.0, height_mm=100.0)
    views = seen(true, table_axis.STANDS[:1], table_axis.ANGLES_DEG)
    fact = table_axis.from_data(views, Board(), calibrated(0), room=room, when_utc=WHEN, device={})
    x, y, width, height = fact.settings["view.roi"]
    rotation, translation = true.to_camera(0.0)
    around = np.linspace(0, 2 * np.pi, 100)
    side = np.array([[40 * np.cos(a), 40 * np.sin(a), h] for a in around for h in np.linspace(0, 100, 5)])
    drawn = cv2.projectPoints(side, cv2.Rodrigues(rotation)[0], translation, true.matrix, np.array(true.distortion))[
        0
    ].reshape(-1, 2)
    assert np.allclose([x, y], drawn.min(axis=0), atol=4)
    assert np.allclose([x + width, y + height], drawn.max(axis=0), atol=4)


def test_objects_that_the_frame_cuts_off_are_refused():
    views = seen(optics(0), table_axis.STANDS, ANGLES)
    room = Room(height_mm=260.0)
    fact = table_axis.from_data(views, Board(), calibrated(0), room=room, when_utc=WHEN, device={})
    (refusal,) = fact.refusals
    assert "cut off by the frame: " in refusal
    assert "px at the top" in refusal
    assert "--height-mm" in refusal
    assert not fact.settings


def test_a_board_of_another_size_is_noticed_by_the_measured_distance():
    views = seen(optics(0), table_axis.STANDS, table_axis.ANGLES_DEG[::3])

    def measured(square_mm: float) -> CalibrationResult:
        room, board = Room(lens_mm=480.0), Board(square_mm=square_mm, marker_mm=square_mm * 11 / 15)
        return table_axis.from_data(views, board, calibrated(0), room=room, when_utc=WHEN, device={})

    assert measured(15.0).passed
    larger = measured(18.0)
    assert any("its squares would be 15." in refusal for refusal in larger.refusals), larger.refusals
    assert not larger.settings


ANGLES = camera_model.ANGLES_DEG[::2]


def test_too_few_views_are_refused():
    fact = camera(seen(optics(1), ALL[:2], ANGLES))
    assert "found in 10 views, 12 are needed" in fact.refusals[0]
    assert not fact.estimates


def test_blurred_frames_are_refused():
    fact = camera(seen(optics(1), ALL, ANGLES, spoil=blurred))
    assert any("corners are off" in r or "views, 12 are needed" in r for r in fact.refusals), fact.refusals


def test_a_loose_board_is_refused():
    views = seen(optics(1), ALL, ANGLES, change=lambda board: replace(board, loose_deg=4.0))
    assert any("it is loose on its stand" in refusal for refusal in camera(views).refusals)
    views = seen(optics(0), table_axis.STANDS, ANGLES, change=lambda board: replace(board, loose_deg=1.0))
    assert any("off the circles" in refusal for refusal in axis(views, calibrated(0)).refusals)


def test_a_swapped_gear_ratio_is_refused():
    views = seen(optics(1), ALL, ANGLES, ratio=1.5)
    assert any("servo.gear_ratio is wrong" in refusal for refusal in camera(views).refusals)


def test_the_wrong_board_is_refused():
    views = seen(optics(1), ALL, ANGLES, board=Board(columns=6, rows=8))
    fact = camera(views, Board(columns=6, rows=8))
    assert not fact.passed
    assert not fact.settings


def test_a_board_that_covers_little_of_the_frame_is_refused():
    views = seen(optics(1), ["calibration-board upright"] * 3, camera_model.ANGLES_DEG[::2])
    assert any("of the frame" in refusal for refusal in camera(views).refusals)


def test_an_axis_needs_views_from_both_sides():
    views = seen(optics(0), table_axis.STANDS, (-20.0, -10.0, 0.0, 10.0, 20.0))
    assert any("over 40°" in refusal for refusal in axis(views, calibrated(0)).refusals)
