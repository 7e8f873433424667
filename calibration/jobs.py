"""The calibrations as jobs of `rig serve`: entry points of the group ``rig.calibrations``."""

from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from dataclasses import dataclass

from calibration.outcome import in_force, outcome_text
from calibration.procedure import Ask, Procedure, Progress
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
from rig.views.charuco_board import Board
from rig.web.work import CalibrationStep

BOARD = Board(8, 6, 15.0, 11.0)
"""The board that `rig calibrate table --print-board` writes; other boards need the command line."""


@dataclass(frozen=True, slots=True)
class CalibrationJob:
    """Procedures that run one after the other; the first that does not pass ends the job."""

    title: str
    procedures: Callable[[str | None], Sequence[Procedure]]

    def __call__(self, bench: Bench, thing: str | None) -> Generator[CalibrationStep, None, None]:
        """Calibrate; each result that passed is in force at once. ``thing`` is the object, if one is needed."""
        store = CalibrationStore(bench.config.calibration_path(bench.name))
        for procedure in self.procedures(thing):
            required = [in_force(bench, name) for name in procedure.requires]
            passed = True
            with closing(procedure.live(bench, *required)) as events:
                for event in events:
                    if isinstance(event, CalibrationResult):
                        store.add(event)
                        passed = passed and event.passed
                        yield CalibrationStep(outcome_text(event), result=event)
                    elif isinstance(event, Ask):
                        yield CalibrationStep(event.words, confirm=True)
                    elif isinstance(event, Progress):
                        yield CalibrationStep(event.words)
                    else:
                        yield CalibrationStep("", event=event)
            if not passed:
                return
            calibrate(bench, store)


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
