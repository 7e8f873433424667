"""`rig calibrate ...`."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from calibration.outcome import as_json, plain_value, stored_results
from rig.cli.ui.command import command
from rig.cli.ui.exit_codes import EXIT_QUALITY
from rig.cli.ui.settings import Settings
from rig.core.next_steps import Do, in_words

if TYPE_CHECKING:
    from calibration.procedure import Procedure
    from rig.views.charuco_board import Board

MARKER_SHARE = 11 / 15
"""Side of a marker over that of its square, on every printed board."""

Minutes = Annotated[float, typer.Option(min=3.0, help="Minutes of recording the gyro at rest.")]
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

app = typer.Typer(help="Measure the bench's own errors.", no_args_is_help=True)


@app.command("servo")
@command
def servo(
    settings: Settings,
    reversals: Annotated[int, typer.Option(min=6, help="Reversals for the backlash.")] = 24,
    revolutions: Annotated[int, typer.Option(min=1, help="Revolutions for the encoder.")] = 2,
    rounds: Annotated[int, typer.Option(min=2, help="Rounds of timed rotations.")] = 3,
) -> None:
    """Calibrate direction, gear ratio, backlash, encoder and motion of the servo.

    Takes some minutes. Exit code 6 if a calibration does not pass.

    Example: rig calibrate servo --bench sim
    """
    from calibration.procedures import Backlash, Encoder, MotionModel

    run(settings, Backlash(reversals), Encoder(revolutions), MotionModel(rounds))


@app.command("cable")
@command
def cable(settings: Settings) -> None:
    """Measure the cable budget: rotate the table by hand to both ends of the cable. The torque is off.

    Example: rig calibrate cable
    """
    from calibration.procedures import Cable

    run(settings, Cable())


@app.command("imu")
@command
def imu(
    settings: Settings,
    revolutions: Annotated[int, typer.Option(min=4, help="Least number of revolutions, both directions together.")] = 8,
    minutes: Minutes = 20.0,
    repeats: Annotated[int, typer.Option(min=4, help="Repeated rotations at each speed, to verify σ.")] = 10,
) -> None:
    """Calibrate scale, mounting and noise of the gyro, and verify the uncertainty of rotations.

    Takes half an hour. Exit code 6 if a calibration does not pass.

    Example: rig calibrate imu --bench sim --revolutions 12
    """
    from calibration.procedures import GyroNoise, GyroRotation, GyroScale, ImuMounting

    run(settings, GyroScale(revolutions), ImuMounting(), GyroNoise(minutes), GyroRotation(repeats))


@app.command("camera")
@command
def camera(settings: Settings, columns: BoardColumns = 8, rows: BoardRows = 6, square_mm: SquareMm = 15.0) -> None:
    """Calibrate sharpness, noise, flat field, drift and lens of the camera, with a grey card and the printed board.

    Example: rig calibrate camera --bench sim
    """
    from calibration.procedures import CameraCard, CameraModel, CameraNoise

    run(settings, CameraNoise(), CameraCard(), CameraModel(_board(columns, rows, square_mm)))


@app.command("table")
@command
def table(
    settings: Settings,
    columns: BoardColumns = 8,
    rows: BoardRows = 6,
    square_mm: SquareMm = 15.0,
    radius_mm: RadiusMm = 80.0,
    height_mm: HeightMm = 150.0,
    middle_mm: MiddleMm = 75.0,
    lens_mm: LensMm = None,
    print_board: Annotated[
        Path | None,
        typer.Option("--print-board", metavar="FILE", help="Write the board as .pdf or .png to print, and stop."),
    ] = None,
) -> None:
    """Calibrate the position and the wobble of the table's axis in the camera's frame. Calibrate the camera first.

    The result sets the region of interest (view.roi) for objects of the given radius and height.

    Example: rig calibrate table --print-board board.pdf
    """
    from calibration.procedures import TableAxis
    from calibration.table_axis import ObjectSpace

    board = _board(columns, rows, square_mm)
    if print_board is not None:
        from calibration.print_board import write_board

        print(write_board(board, print_board))
        return
    run(settings, TableAxis(board, ObjectSpace(radius_mm, height_mm, middle_mm, lens_mm)))


@app.command("camera-time")
@command
def camera_time(
    settings: Settings,
    thing: Annotated[
        str | None,
        typer.Option(
            "--object", metavar="NAME", help="Object that the simulated bench puts on the table (default: the board)."
        ),
    ] = None,
) -> None:
    """Calibrate when frames are exposed, so that views can be taken while the table rotates.

    Put the board, or an object with texture, on the table. Exit code 6 if the frames' times jitter too much.

    Example: rig calibrate camera-time --bench sim

    Example: rig calibrate camera-time --bench sim --object mug-star
    """
    from calibration.procedures import CameraTime

    run(settings, CameraTime() if thing is None else CameraTime(thing))


@app.command("noise")
@command
def noise(
    settings: Settings,
    name: Annotated[str, typer.Argument(help="Object to put on the table, for example an enrolled one.")],
    placements: Annotated[int, typer.Option(min=2, help="Number of placements at the same mark.")] = 5,
    error_rate: Annotated[
        float, typer.Option(min=0.001, max=0.2, help="Share of known objects that may be taken for unknown.")
    ] = 0.02,
) -> None:
    """Calibrate the similarity of repeated views; it sets margin and threshold of identification.

    Example: rig calibrate noise mug-star --bench sim --placements 5
    """
    from calibration.procedures import Repeatability

    run(settings, Repeatability(name, placements, error_rate))


@app.command("all")
@command
def everything(
    settings: Settings,
    minutes: Minutes = 20.0,
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
) -> None:
    """Calibrate servo and IMU, which need no operator, then camera and table, with card and board.

    Takes about an hour, and stops at the first calibration that does not pass. Calibrate the cable before.

    Example: rig calibrate all --bench sim --object mug-star
    """
    from calibration import procedures as p
    from calibration.table_axis import ObjectSpace

    board = _board(columns, rows, square_mm)
    servo_and_imu = (p.Backlash(), p.Encoder(), p.MotionModel(), p.GyroScale(), p.ImuMounting(), p.GyroNoise(minutes))
    camera_and_table = (
        *(p.CameraNoise(), p.CameraCard(), p.CameraModel(board)),
        p.TableAxis(board, ObjectSpace(radius_mm, height_mm, middle_mm, lens_mm)),
    )
    repeated = () if thing is None else (p.Repeatability(thing),)
    run(settings, *servo_and_imu, p.GyroRotation(), *camera_and_table, *repeated)
    if thing is None:
        print(f"Next: {Do.CALIBRATE(name='noise').command} NAME, with an object.", file=sys.stderr)


@app.command("report")
@command
def report(
    settings: Settings,
    out: Annotated[Path, typer.Option("--out", metavar="FILE.html", help="File to write.")] = Path("calibration.html"),
) -> None:
    """Write a page with all calibrations of the bench and their plots. Nothing moves.

    Example: rig calibrate report --bench sim --out calibration.html
    """
    from calibration.report import write_page

    with settings.open_bench(tell=False) as bench:
        store, calibrations = stored_results(bench)
        notes = [error.what for error in store.unreadable]
        write_page(out, calibrations, store.history(), bench=bench.name, now_utc=bench.clock.utc(), notes=notes)
    settings.say(f"Report: {out}", {"file": str(out), "calibrations": [s.result.name for s in calibrations]})


@app.command("show")
@command
def show(settings: Settings) -> None:
    """Show which calibrations are in force, have expired, or belong to other devices. Nothing moves.

    Example: rig calibrate show --bench sim
    """
    from rig.calibrations import CalibrationStatus
    from rig.core.json_form import plain

    with settings.open_bench(tell=False) as bench:
        store, calibrations = stored_results(bench)
        if settings.json:
            rows = [{"state": s.status, "words": str(s), **as_json(s.result)} for s in calibrations]
            settings.print_json({"folder": str(store.folder), "calibrations": plain(rows)})
            return
        for finding in bench.findings:
            print(f"! {finding}")
        if bench.calibration_steps:
            print(f"  {in_words(bench.calibration_steps)}")
        for calibration in calibrations:
            if calibration.status is CalibrationStatus.IN_FORCE:
                print(f"✓ {calibration}")
                print("\n".join(f"    {name} = {estimate}" for name, estimate in calibration.result.estimates.items()))
                for key, value in calibration.result.settings.items():
                    print(f"    sets {key} = {plain_value(value)}")
        if not calibrations:
            print(f"No calibrations in {store.folder} yet. {in_words(Do.CALIBRATE(name='all'))}")


@app.command("history")
@command
def history(
    settings: Settings,
    name: Annotated[str | None, typer.Argument(help="One kind, for example imu.scale (default: all).")] = None,
) -> None:
    """List all stored calibrations, passed or not, oldest first.

    Example: rig calibrate history servo.backlash --bench sim
    """
    from rig.calibrations import CalibrationStore

    store = CalibrationStore(settings.load().calibration_path(settings.bench_name))
    results = store.history(name)
    for error in store.unreadable:
        print(f"! {error.what}", file=sys.stderr)
    if settings.json:
        settings.print_json({"folder": str(store.folder), "calibrations": [as_json(result) for result in results]})
        return
    for result in results:
        values = ", ".join(f"{key} {estimate}" for key, estimate in result.estimates.items())
        outcome = values if result.passed else f"FAIL: {result.rejections[0]}"
        print(f"{result.when_utc:%Y-%m-%d %H:%M}  {result.name:<16} {outcome}")
    if not results:
        print(f"No calibrations{f' of {name}' if name else ''} in {store.folder}.")


def run(settings: Settings, *procedures: "Procedure") -> None:
    """Run procedures on the bench one after the other, store and report each result, and apply those that passed.

    A result that passed is in force for the next procedure. The first that does not pass ends the series.

    Raises
    ------
    typer.Exit
        With code 6 if a calibration did not pass.
    """
    from calibration.jobs import calibrated
    from rig.cli.ui.desk import CommandDesk

    desk = CommandDesk(settings, with_json=True)  # a person must put the board there
    if not desk.run(calibrated(desk, procedures)):
        raise typer.Exit(EXIT_QUALITY)


def _board(columns: int, rows: int, square_mm: float) -> "Board":
    from rig.views.charuco_board import Board

    return Board(columns, rows, square_mm, square_mm * MARKER_SHARE)
