"""The calibrations as jobs; those of `rig serve` are entry points of the group ``rig.calibrations``."""

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass

from calibration.outcome import as_json, in_force, outcome_text
from calibration.procedure import Ask, Procedure
from calibration.procedures import (
    Backlash,
    CameraCard,
    CameraModel,
    CameraNoise,
    CameraTime,
    Encoder,
    GyroNoise,
    GyroRotation,
    GyroScale,
    ImuMounting,
    MotionModel,
    Repeatability,
    TableAxis,
)
from calibration.table_axis import ObjectSpace
from rig.bench import Bench, calibrate
from rig.calibrations import CalibrationResult, CalibrationStore
from rig.core.errors import UsageError
from rig.jobs.desk import Desk, Remark, Result, Steps
from rig.jobs.regions import warn_of_other_regions
from rig.plans.operator import Choice, Question, Subject
from rig.views.charuco_board import Board

BOARD = Board(8, 6, 15.0, 11.0)
"""The board that `rig calibrate table --print-board` writes; other boards need the command line."""


def calibrated(desk: Desk, procedures: Sequence[Procedure]) -> Steps[bool]:
    """Run procedures one after the other, and store each result; return whether all of them passed.

    A result that passed is in force for the next procedure. The first that does not pass ends the job.
    """
    with desk.open_bench() as bench:
        store = CalibrationStore(bench.config.calibration_path(bench.name))
        for procedure in procedures:
            passed = yield from _measured(desk, bench, store, procedure)
            if not passed:
                return False
            reported, region = bench.calibration_findings, bench.config.view.roi
            calibrate(bench, store)
            for finding in bench.calibration_findings:
                if finding not in reported:  # a setting in the configuration takes precedence
                    yield Remark(f"{finding}.")
            if bench.config.view.roi != region and desk.place.may_exist():
                with desk.open_to_read() as catalog:
                    yield from warn_of_other_regions(bench, catalog)
    return True


def _measured(desk: Desk, bench: Bench, store: CalibrationStore, procedure: Procedure) -> Steps[bool]:
    """Run one procedure, and store its results up to the first that does not pass; return whether all passed."""
    required = [in_force(bench, name) for name in procedure.requires]
    with closing(procedure.live(bench, *required)) as steps:
        for step in steps:
            if isinstance(step, CalibrationResult):
                path = store.add(step)
                then = ", in force from now on." if step.passed else "; earlier results stay in force."
                outcome = {"event": "calibrated", "passed": step.passed, "id": step.id, "file": str(path)}
                yield Result({**outcome, **as_json(step)}, f"{outcome_text(step)}\nStored in {path}{then}")
                if not step.passed:
                    return False
            elif isinstance(step, Ask):
                question = Question(Subject.CALIBRATION, step.words, picture=step.picture)
                if not desk.operator.is_there:
                    yield Remark(step.words, is_warning=False, picture=step.picture)
                elif desk.operator.choose(question) is Choice.STOP:
                    return False
            else:
                yield step
    return True


@dataclass(frozen=True, slots=True)
class CalibrationJob:
    """A calibration that `rig serve` offers; ``thing`` is the object, if one is needed."""

    title: str
    procedures: Callable[[str | None], Sequence[Procedure]]

    def __call__(self, desk: Desk, thing: str | None) -> Steps[bool]:
        return (yield from calibrated(desk, self.procedures(thing)))


def _repeatability(thing: str | None) -> Sequence[Procedure]:
    if not thing:
        raise UsageError("No object is given.", next_step="Give the name of an enrolled object.")
    return [Repeatability(thing)]


servo = CalibrationJob("Servo (minutes)", lambda _: [Backlash(), Encoder(), MotionModel()])
imu = CalibrationJob("IMU (half an hour)", lambda _: [GyroScale(), ImuMounting(), GyroNoise(20.0), GyroRotation()])
camera = CalibrationJob("Camera (card and board)", lambda _: [CameraNoise(), CameraCard(), CameraModel(BOARD)])
table = CalibrationJob("Table axis (board)", lambda _: [TableAxis(BOARD, ObjectSpace(80.0, 150.0, 75.0, None))])
noise = CalibrationJob("Repeated views (an object)", _repeatability)
camera_time = CalibrationJob("Time of the frames (board, or an object with texture)", lambda _: [CameraTime()])
