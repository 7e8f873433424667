"""The calibrations that a person starts: each is a command of `rig calibrate`, and a job of `rig serve`.

A calibration says here once what it is called, what it needs and what it runs; command, job and page derive from it.
The entry points of the group ``rig.calibrations`` name them for the server. This module imports none of numpy, cv2 and
scipy: `rig --help` must start at once.
"""

import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rig.core.errors import UsageError

if TYPE_CHECKING:
    from calibration.procedure import Procedure
    from rig.jobs.desk import Desk, Steps
    from rig.views.charuco_board import CharucoBoard

MARKER_SHARE = 11 / 15
"""Side of a marker over that of its square, on every printed board."""

BoardColumns = Annotated[int, typer.Option(min=3, max=20, help="Squares across the board.")]
BoardRows = Annotated[int, typer.Option(min=3, max=20, help="Squares down the board.")]
SquareMm = Annotated[float, typer.Option(min=2, max=100, help="Side of a square in mm, measured on the print.")]
RadiusMm = Annotated[float, typer.Option(min=5, max=1000, help="Radius of the largest object about the axis, in mm.")]
HeightMm = Annotated[float, typer.Option(min=5, max=2000, help="Height of the tallest object, in mm.")]
MiddleMm = Annotated[
    float, typer.Option(min=0, max=1000, help="Height of the upright board's middle above the platter, in mm.")
]
LensMm = Annotated[
    float | None,
    typer.Option(min=20, max=10_000, help="Distance from lens to axis in mm, if measured: checks the board's size."),
]


@dataclass(frozen=True, slots=True)
class Calibration:
    """Procedures that run one after the other.

    ``title`` is its name on a page, with what it needs; empty if only a terminal offers it. ``procedures`` returns the
    procedures: its parameters are the options of the command, its docstring is the command's help. A parameter without
    a default is the name of an object.
    """

    title: str
    procedures: "Callable[..., Sequence[Procedure]]"

    def __call__(self, desk: "Desk", thing: str | None) -> "Steps[bool]":
        """Run the procedures with their usual options, as a job of the server."""
        from calibration.procedure import calibrated

        objects = [one for one in inspect.signature(self.procedures).parameters.values() if one.default is one.empty]
        if objects and not thing:
            raise UsageError("No object is given.", next_step="Give the name of an enrolled object.")
        return (yield from calibrated(desk, self.procedures(*[thing for _ in objects])))


def _titled(title: str = "") -> "Callable[[Callable[..., Sequence[Procedure]]], Calibration]":
    return lambda procedures: Calibration(title, procedures)


# The least numbers of moves in the options below: fewer do not show a scatter, in each direction where it matters.


@_titled("Servo (minutes)")
def servo(
    reversals: Annotated[int, typer.Option(min=6, help="Reversals for the backlash.")] = 24,
    revolutions: Annotated[int, typer.Option(min=1, help="Revolutions for the encoder.")] = 2,
) -> "Sequence[Procedure]":
    """Calibrate direction, gear ratio, backlash and encoder of the servo.

    Takes some minutes. Exit code 6 if a calibration does not pass.

    Example: rig calibrate servo --bench sim
    """
    from calibration.procedures import Backlash, Encoder

    return Backlash(reversals), Encoder(revolutions)


@_titled()
def cable() -> "Sequence[Procedure]":
    """Measure the cable budget: rotate the table by hand to both ends of the cable. The torque is off.

    Example: rig calibrate cable
    """
    from calibration.procedures import Cable

    return (Cable(),)


@_titled("IMU (minutes)")
def imu(
    revolutions: Annotated[int, typer.Option(min=4, help="Least number of revolutions, both directions together.")] = 8,
    repeats: Annotated[int, typer.Option(min=4, help="Repeated rotations at each speed, to verify σ.")] = 10,
) -> "Sequence[Procedure]":
    """Calibrate scale and mounting of the gyro, and verify the uncertainty of rotations.

    Takes some minutes. Exit code 6 if a calibration does not pass.

    Example: rig calibrate imu --bench sim --revolutions 12
    """
    from calibration.procedures import GyroRotation, GyroScale, ImuMounting

    return GyroScale(revolutions), ImuMounting(), GyroRotation(repeats)


@_titled("Ringing of the platter")
def shaper(
    stops: Annotated[int, typer.Option(min=4, help="Stops after which the platter is listened to.")] = 10,
) -> "Sequence[Procedure]":
    """Calibrate how the platter rings after a stop; from then on, moves do not excite it. Put a usual object on it.

    Example: rig calibrate shaper --bench sim
    """
    from calibration.procedures import Ringing

    return (Ringing(stops),)


@_titled("Camera (board)")
def camera(columns: BoardColumns = 8, rows: BoardRows = 6, square_mm: SquareMm = 15.0) -> "Sequence[Procedure]":
    """Calibrate the lens of the camera with the printed board.

    Example: rig calibrate camera --bench sim
    """
    from calibration.procedures import CameraModel

    return (CameraModel(_board(columns, rows, square_mm)),)


@_titled("Table axis (board)")
def table(
    columns: BoardColumns = 8,
    rows: BoardRows = 6,
    square_mm: SquareMm = 15.0,
    radius_mm: RadiusMm = 80.0,
    height_mm: HeightMm = 150.0,
    middle_mm: MiddleMm = 75.0,
    lens_mm: LensMm = None,
    print_board: Annotated[
        Path | None,
        typer.Option("--print-board", metavar="FILE", help="Write the board as .pdf to print, and stop."),
    ] = None,
) -> "Sequence[Procedure]":
    """Calibrate the position and the wobble of the table's axis in the camera's frame. Calibrate the camera first.

    The result sets the region of interest (view.roi) for objects of the given radius and height.

    Example: rig calibrate table --print-board board.pdf
    """
    board = _board(columns, rows, square_mm)
    if print_board is not None:
        from calibration.print_board import write_board

        print(write_board(board, print_board))
        return ()
    from calibration.procedures import TableAxis
    from calibration.table_axis import ObjectSpace

    return (TableAxis(board, ObjectSpace(radius_mm, height_mm, middle_mm, lens_mm)),)


@_titled("Time of the frames (board, or an object with texture)")
def camera_time(
    thing: Annotated[
        str | None,
        typer.Option(
            "--object", metavar="NAME", help="Object that the simulated bench puts on the table (default: the board)."
        ),
    ] = None,
) -> "Sequence[Procedure]":
    """Calibrate when frames are exposed, so that views can be taken while the table rotates.

    Put the board, or an object with texture, on the table. Exit code 6 if the frames' times jitter too much.

    Example: rig calibrate camera-time --bench sim

    Example: rig calibrate camera-time --bench sim --object mug-star
    """
    from calibration.procedures import CameraTime

    return (CameraTime() if thing is None else CameraTime(thing),)


@_titled("Repeated views (an object)")
def noise(
    name: Annotated[str, typer.Argument(help="Object to put on the table, for example an enrolled one.")],
    placements: Annotated[int, typer.Option(help="Number of placements at the same mark.")] = 5,
    error_rate: Annotated[
        float, typer.Option(min=0.001, max=0.2, help="Share of known objects that may be taken for unknown.")
    ] = 0.02,
) -> "Sequence[Procedure]":
    """Calibrate the similarity of repeated views; it sets margin and threshold of identification.

    Example: rig calibrate noise mug-star --bench sim --placements 5
    """
    from calibration.procedures import Repeatability

    return (Repeatability(name, placements, error_rate),)


@_titled()
def everything(
    columns: BoardColumns = 8,
    rows: BoardRows = 6,
    square_mm: SquareMm = 15.0,
    radius_mm: RadiusMm = 80.0,
    height_mm: HeightMm = 150.0,
    middle_mm: MiddleMm = 75.0,
    lens_mm: LensMm = None,
    thing: Annotated[
        str | None,
        typer.Option("--object", metavar="NAME", help="Object for the similarity of repeated views, measured last."),
    ] = None,
) -> "Sequence[Procedure]":
    """Calibrate servo and IMU, which need no operator, then camera and table, with the board.

    Takes about half an hour, and stops at the first calibration that does not pass. Calibrate the cable before, and
    repeated views afterwards if no object is given.

    Example: rig calibrate all --bench sim --object mug-star
    """
    return (
        *servo.procedures(),
        *imu.procedures(),
        *shaper.procedures(),
        *camera.procedures(columns, rows, square_mm),
        *table.procedures(columns, rows, square_mm, radius_mm, height_mm, middle_mm, lens_mm),
        *(noise.procedures(thing) if thing is not None else ()),
    )


@_titled("Home mark (card)")
def mark(columns: BoardColumns = 4, rows: BoardRows = 3, square_mm: SquareMm = 15.0) -> "Sequence[Procedure]":
    """Calibrate the home mark: a small card at a fixed place of the platter, by which rig home finds the angle.

    Print the card with rig calibrate table --print-board and the same options. Calibrate the camera first.

    Example: rig calibrate mark --bench sim
    """
    from calibration.procedures import HomeMark

    return (HomeMark(_board(columns, rows, square_mm)),)


CALIBRATIONS = {
    "servo": servo,
    "cable": cable,
    "imu": imu,
    "shaper": shaper,
    "camera": camera,
    "table": table,
    "mark": mark,
    "camera-time": camera_time,
    "noise": noise,
    "all": everything,
}
"""The calibrations by the names of their commands, in the order of the help."""


def _board(columns: int, rows: int, square_mm: float) -> "CharucoBoard":
    from rig.views.charuco_board import CharucoBoard

    return CharucoBoard(columns, rows, square_mm, square_mm * MARKER_SHARE)
