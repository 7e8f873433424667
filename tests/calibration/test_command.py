"""`rig calibrate` on the command line."""

import json
from dataclasses import replace
from datetime import timedelta
from html import escape, unescape
from shutil import copytree

import numpy as np
import pytest
from typer.testing import CliRunner

from calibration import camera_model, encoder, gyro_rotation, imu_mounting, table_axis
from calibration.procedures import Backlash, Encoder, GyroRotation, GyroScale, ImuMounting
from calibration.report import plots
from rig.calibrations import CalibrationResult, CalibrationStore
from rig.catalog import log
from rig.cli.main import app
from rig.core.clock import SystemClock
from rig.views.charuco_board import CharucoBoard
from tests.calibration.drawn import measured, moves
from tests.rig.calibrations.test_calibrations import FEW, RESULT

CONFIG = 'default_bench = "sim"\ncalibration_dir = "calibrations"\n[catalog]\npath = "catalog"\n'

SERVO = ("calibrate", "servo", "--reversals", "8", "--revolutions", "1")


def calibrated(folder, *arguments: str):
    """Calibrate devices; return the folder of the results, and the output."""
    (folder / "rig.toml").write_text(CONFIG, encoding="utf-8")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        done = CliRunner().invoke(app, arguments)
    assert done.exit_code == 0, done.output
    return folder / "calibrations", done.stdout


@pytest.fixture(scope="module")
def imu_calibration(tmp_path_factory):
    words = ("calibrate", "imu", "--revolutions", "4", "--repeats", "4")
    with pytest.MonkeyPatch.context() as patch:
        # Measured by the tests of these procedures; here their data are drawn, because the table moves for long.
        mounting = imu_mounting.evaluate(*measured(), column=2, sign=1)
        rotation = gyro_rotation.evaluate(moves(0), resolution_deg=1e-6)
        for procedure, found in ((ImuMounting, mounting), (GyroRotation, rotation)):
            who = {"reference": procedure.reference, "operator": log.operator()}
            result = found.result(when_utc=SystemClock().utc(), **who)
            patch.setattr(procedure, "live", lambda *_, result=result: (one for one in [result]))
        return calibrated(tmp_path_factory.mktemp("imu"), *words)


@pytest.fixture(scope="module")
def servo_calibration(tmp_path_factory):
    return calibrated(tmp_path_factory.mktemp("servo"), *SERVO)


def store(tmp_path, days: float, **changed) -> None:
    when_utc = SystemClock().utc() - timedelta(days=days)
    result = replace(RESULT, when_utc=when_utc, valid_days=30.0, **changed)
    CalibrationStore(tmp_path / "calibrations" / "sim").add(result)


def results_in(folder) -> list[CalibrationResult]:
    return [CalibrationResult.from_file(path) for path in sorted((folder / "sim").iterdir())]


def test_passed_results_are_stored_and_in_force(rig, tmp_path, imu_calibration):
    folder, output = imu_calibration
    paths = sorted((folder / "sim").iterdir())
    results = [CalibrationResult.from_file(path) for path in paths]
    assert [result.name for result in results] == ["imu.scale", "imu.mounting", "imu.rotation"]
    for path, result in zip(paths, results, strict=True):
        assert f"PASS {result.name}" in output
        assert path.name in "".join(output.split())
    assert results[0].device["imu"]["range_dps"] == 250
    copytree(folder, tmp_path / "calibrations")
    reported = json.loads(rig("goto", "90", "--json").stdout)
    assert reported["agrees"] is True
    assert reported["bound_deg"] < 1.5
    other = json.loads(rig("goto", "180", "--seed", "7", "--json").stdout)
    assert other["bound_deg"] > 1.5, "another world has another gyro"


def test_rejected_calibration_exits_with_6_and_changes_nothing(rig, tmp_path, imu_calibration):
    copytree(imu_calibration[0], tmp_path / "calibrations")
    done = rig("calibrate", "imu", "--revolutions", "4", "--set", "imu.axis=x")
    assert done.exit_code == 6
    assert "FAIL imu.scale" in done.stdout
    assert "imu.axis" in done.stdout
    passed = [result.passed for result in results_in(tmp_path / "calibrations")]
    assert passed == [True, True, True, False]
    assert json.loads(rig("goto", "90", "--json").stdout)["bound_deg"] < 1.5


@pytest.mark.nightly
def test_servo_results_replace_earlier_ones(rig, tmp_path, monkeypatch, servo_calibration):
    copytree(servo_calibration[0], tmp_path / "calibrations")
    names = [result.name for result in results_in(tmp_path / "calibrations")]
    assert names == ["servo.backlash", "servo.encoder"]
    monkeypatch.setattr(Encoder, "live", lambda *_: (one for one in ()))
    again = rig(*SERVO)
    assert again.exit_code == 0, "a newer result takes the place of an older one"
    assert "of the configuration takes precedence" not in again.output


def test_show_and_history_list_results(rig, tmp_path, imu_calibration):
    assert "No calibrations in" in rig("calibrate", "show").output
    assert "No calibrations of imu.scale in" in rig("calibrate", "history", "imu.scale").output
    assert rig("calibrate", "report", "--out", "no/where.html").exit_code == 2
    store(tmp_path, 0.0, name="imu.scale", rejections=(FEW,))
    assert "imu.scale never passed" in rig("calibrate", "show").output
    for path in sorted((imu_calibration[0] / "sim").iterdir()):
        CalibrationStore(tmp_path / "calibrations" / "sim").add(CalibrationResult.from_file(path))
    assert "✓ imu.scale was calibrated today" in rig("calibrate", "show").output
    assert "conditions.seed was 0, is 9" in rig("calibrate", "show", "--seed", "9").output
    failed, passed = rig("calibrate", "history", "imu.scale").output.splitlines()
    assert "FAIL" in failed
    assert "scale " in passed
    reported = json.loads(rig("calibrate", "history", "--json").stdout)
    assert [result["name"] for result in reported["calibrations"]] == [
        "imu.scale",
        "imu.scale",
        "imu.mounting",
        "imu.rotation",
    ]
    store(tmp_path, 0.0, name="imu.scale", rejections=(FEW,))
    assert rig("calibrate", "report", "--out", "page.html").exit_code == 0
    assert f"UTC: {FEW}" in (tmp_path / "page.html").read_text(encoding="utf-8"), "a newer attempt was rejected"


@pytest.mark.nightly
def test_all_calibrates_the_bench_and_report_shows_it(rig, tmp_path, monkeypatch, imu_calibration, servo_calibration):
    # Results of other tests, fewer frames and sides: other tests show what the procedures find.
    known = {result.name: result for folder, _ in (imu_calibration, servo_calibration) for result in results_in(folder)}
    for procedure in (Backlash, Encoder, GyroScale, ImuMounting, GyroRotation):
        monkeypatch.setattr(procedure, "live", lambda self, *_: (one for one in [known[self.result_name]]))
    monkeypatch.setattr(camera_model, "ANGLES_DEG", camera_model.ANGLES_DEG[::3])
    monkeypatch.setattr(table_axis, "ANGLES_DEG", table_axis.ANGLES_DEG[::4])
    done = rig("calibrate", "all")
    assert done.exit_code == 0, done.output
    assert "Put the calibration board upright in the middle of the platter" in done.stderr
    assert "rig calibrate noise NAME" in done.stderr
    results = results_in(tmp_path / "calibrations")
    assert [result.name for result in results] == [
        "servo.backlash",
        "servo.encoder",
        "imu.scale",
        "imu.mounting",
        "imu.rotation",
        "table.ringing",
        "camera.intrinsics",
        "table.axis",
    ]
    assert results[-1].evidence["intrinsics"] == results[-2].id
    pictures = [plots(result) for result in results]
    assert [len(drawn) for drawn in pictures] == [1] * 6 + [2, 2]
    assert rig("calibrate", "report", "--out", "page.html").exit_code == 0
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert page.count("valid until") == len(results)
    words = unescape(page)
    for result, drawn in zip(results, pictures, strict=True):
        assert result.reference in words
        assert result.operator == log.author()["user"]
        for estimate in result.estimates.values():
            assert f"U (k = 2) = {estimate.expanded}" in page
            assert all(f"<td>{one.source}</td><td>{one.kind}</td>" in words for one in estimate.budget)
        assert f'id="{result.name}"' in page
        assert all(f'aria-label="{escape(picture.label)}"' in page for picture in drawn)
    assert page.count('<th scope="rowgroup"') == sum(len(result.estimates) for result in results)
    assert f"<td>{log.author()['user']}</td>" in page
    assert "ChArUco board, 8 × 6 squares of 15 mm" in page
    assert page.count("<svg") == sum(map(len, pictures))
    for result in results[-2:]:
        worst = int(np.argmax(result.evidence["view_rms_px"]))
        assert f"Worst views: {worst + 1} (stand {result.evidence['views'][worst]['stand'] + 1} at" in page
    assert "src=" not in page, "one self-contained file"


def test_person_at_a_terminal_is_asked_also_with_json(rig, monkeypatch):
    found = camera_model.evaluate([], CharucoBoard(), (640, 480))
    nothing = found.result(when_utc=SystemClock().utc())
    monkeypatch.setattr("calibration.procedure.in_force", lambda *_: nothing)
    monkeypatch.setattr("rig.cli.ui.prompts.is_interactive", lambda: True)
    done = rig("calibrate", "table", "--json", input="q\n")
    assert done.exit_code == 6
    assert "Enter: continue, q: stop" in done.stderr
    assert done.stdout == ""


def test_table_needs_the_camera_and_its_board_is_printed_without_a_bench(rig, tmp_path):
    rejected = rig("calibrate", "table")
    assert rejected.exit_code == 2
    assert "camera.intrinsics is not calibrated" in rejected.stderr
    assert "rig calibrate camera" in " ".join(rejected.stderr.split())
    done = rig("calibrate", "table", "--print-board", "board.pdf", "--bench", "hardware")
    assert done.exit_code == 0, done.output
    assert (tmp_path / "board.pdf").read_bytes().startswith(b"%PDF")


@pytest.mark.parametrize(
    ("days", "device", "words"),
    [
        (100.0, {}, "servo.encoder was calibrated 100 days ago; it is valid for 30 days"),
        pytest.param(
            1.0,
            {"bench": "another"},
            "servo.encoder was calibrated on another device: bench was another, is sim",
            marks=pytest.mark.nightly,
        ),
    ],
)
def test_enrollment_reports_expired_results_and_results_of_other_devices(rig, tmp_path, days, device, words):
    store(tmp_path, days, name=encoder.NAME, device=device)
    done = rig("enroll", "mug-star", "--views", "4")
    assert done.exit_code == 0, done.output
    reported = " ".join(done.stderr.split())
    assert f"Note: {words}" in reported
    assert "`rig calibrate servo`" in reported
    stored = json.loads(rig("catalog", "show", "mug-star", "--json").stdout)
    assert words in json.dumps(stored, ensure_ascii=False)
