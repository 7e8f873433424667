"""`rig calibrate ...`."""

import sys
from collections.abc import Callable, Generator, Iterator
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rig.cli.ui.command import command
from rig.cli.ui.settings import Settings

if TYPE_CHECKING:
    from calibration.events import Ask
    from rig.bench import Bench
    from rig.calibrations import CalibrationResult

EXIT_QUALITY = 6

MARKER_SHARE = 11 / 15
"""Side of a marker over that of its square, on every board that is printed."""

BoardColumns = Annotated[int, typer.Option(min=3, max=20, help="Squares across the board.")]
BoardRows = Annotated[int, typer.Option(min=3, max=20, help="Squares down the board.")]
SquareMm = Annotated[float, typer.Option(min=2, max=100, help="Side of a square, as measured on the print, in mm.")]

RadiusMm = Annotated[float, typer.Option(min=5, max=1000, help="Radius of the largest object about the axis, in mm.")]
HeightMm = Annotated[float, typer.Option(min=5, max=2000, help="Height of the tallest object, in mm.")]
MiddleMm = Annotated[
    float, typer.Option(min=0, max=1000, help="Height of the board's middle above the platter, upright, in mm.")
]
LensMm = Annotated[
    float | None,
    typer.Option(min=20, max=10_000, help="Distance from lens to axis, if measured: a board of wrong size is noticed."),
]

app = typer.Typer(help="Measure the bench's own errors.", no_args_is_help=True)


@app.command("servo")
@command
def servo(
    settings: Settings,
    reversals: Annotated[int, typer.Option(min=6, help="Reversals by which the play is measured.")] = 24,
    turns: Annotated[int, typer.Option(min=1, help="Turns over which the encoder is compared.")] = 2,
    rounds: Annotated[int, typer.Option(min=2, help="Rounds of timed moves.")] = 3,
) -> None:
    """Calibrate sense and ratio, play, encoder and motion of the servo; some minutes, exit code 6 if one fails.

    Example: rig calibrate servo --bench sim
    """
    from calibration import backlash, encoder, motion_model

    run(
        settings,
        lambda bench: backlash.live(bench, reversals=reversals),
        lambda bench: encoder.live(bench, turns=turns),
        lambda bench: motion_model.live(bench, rounds=rounds),
    )


@app.command("cable")
@command
def cable(settings: Settings) -> None:
    """Teach the table's limits by hand, torque off: turn it to either end of the cable's reach.

    Example: rig calibrate cable
    """
    from calibration.cable import live

    run(settings, live)


@app.command("imu")
@command
def imu(
    settings: Settings,
    turns: Annotated[int, typer.Option(min=4, help="Whole turns at least, both ways together.")] = 8,
    minutes: Annotated[float, typer.Option(min=3.0, help="How long the gyro is listened to at rest.")] = 20.0,
    repeats: Annotated[int, typer.Option(min=4, help="Repeated moves at each speed, by which σ is verified.")] = 10,
) -> None:
    """Calibrate the gyro's scale, mounting and noise, and verify its σ; half an hour, exit code 6 if one fails.

    Example: rig calibrate imu --bench sim --turns 12
    """
    from calibration import gyro_noise, gyro_rotation, gyro_scale, imu_mounting

    run(
        settings,
        lambda bench: gyro_scale.live(bench, turns=turns),
        imu_mounting.live,
        lambda bench: gyro_noise.live(bench, minutes=minutes),
        lambda bench: gyro_rotation.live(bench, repeats=repeats),
    )


@app.command("camera")
@command
def camera(
    settings: Settings,
    columns: BoardColumns = 8,
    rows: BoardRows = 6,
    square_mm: SquareMm = 15.0,
) -> None:
    """Calibrate the camera: lens with the board on the turning table, sharpness, noise, flat field and drift.

    Example: rig calibrate camera --bench sim
    """
    from calibration import camera_light, camera_model
    from rig.views.charuco_board import Board

    board = Board(columns, rows, square_mm, square_mm * MARKER_SHARE)
    run(settings, camera_light.live_scene, camera_light.live_card, lambda bench: camera_model.live(bench, board))


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
        typer.Option(
            "--print-board", metavar="FILE", help="Only write the board to print, .pdf or .png, true to scale."
        ),
    ] = None,
) -> None:
    """Calibrate where the table's axis is in the camera's frame, and how truly it turns; the camera comes first.

    From then on the region of interest (view.roi) is where objects of that radius and height are seen.

    Example: rig calibrate table --print-board board.pdf
    """
    from calibration import table_axis
    from calibration.table_axis import Room
    from rig.views.charuco_board import Board

    board = Board(columns, rows, square_mm, square_mm * MARKER_SHARE)
    if print_board is not None:
        from calibration.print_board import write_board

        print(write_board(board, print_board))
        return
    room = Room(radius_mm, height_mm, middle_mm, lens_mm)
    run(settings, lambda bench: table_axis.live(bench, _in_force(bench, "camera.intrinsics"), board, room))


@app.command("noise")
@command
def noise(
    settings: Settings,
    name: Annotated[str, typer.Argument(help="What is put on the table, e.g. the name of an enrolled object.")],
    placements: Annotated[int, typer.Option(min=2, help="How often it is placed anew, at the same mark.")] = 5,
    error_rate: Annotated[
        float, typer.Option(min=0.001, max=0.2, help="Share of known objects that may be taken for unknown.")
    ] = 0.02,
) -> None:
    """Calibrate how alike repeated views are, and from it margin and threshold of identification.

    Example: rig calibrate noise mug-star --bench sim --placements 5
    """
    from calibration import repeatability

    run(settings, lambda bench: repeatability.live(bench, name, placements=placements, error_rate=error_rate))


@app.command("all")
@command
def everything(
    settings: Settings,
    minutes: Annotated[float, typer.Option(min=3.0, help="How long the gyro is listened to at rest.")] = 20.0,
    columns: BoardColumns = 8,
    rows: BoardRows = 6,
    square_mm: SquareMm = 15.0,
    radius_mm: RadiusMm = 80.0,
    height_mm: HeightMm = 150.0,
    middle_mm: MiddleMm = 75.0,
    lens_mm: LensMm = None,
    thing: Annotated[
        str | None,
        typer.Option("--object", metavar="NAME", help="An object by which repeated views are compared last."),
    ] = None,
) -> None:
    """Calibrate all: servo and IMU, which need no hands, then camera and table, with card and board; about an hour.

    The first that does not pass ends it. The cable is taught before, with `rig calibrate cable`.

    Example: rig calibrate all --bench sim --object mug-star
    """
    from calibration import (
        backlash,
        camera_light,
        camera_model,
        encoder,
        gyro_noise,
        gyro_rotation,
        gyro_scale,
        imu_mounting,
        motion_model,
        repeatability,
        table_axis,
    )
    from calibration.table_axis import Room
    from rig.views.charuco_board import Board

    board = Board(columns, rows, square_mm, square_mm * MARKER_SHARE)
    room = Room(radius_mm, height_mm, middle_mm, lens_mm)
    last = [] if thing is None else [lambda bench: repeatability.live(bench, thing)]
    run(
        settings,
        backlash.live,
        encoder.live,
        motion_model.live,
        gyro_scale.live,
        imu_mounting.live,
        lambda bench: gyro_noise.live(bench, minutes=minutes),
        gyro_rotation.live,
        camera_light.live_scene,
        camera_light.live_card,
        lambda bench: camera_model.live(bench, board),
        lambda bench: table_axis.live(bench, _in_force(bench, camera_model.NAME), board, room),
        *last,
    )
    if thing is None:
        print("Still to do: `rig calibrate noise NAME`, with an object at hand.", file=sys.stderr)


@app.command("report")
@command
def report(
    settings: Settings,
    out: Annotated[Path, typer.Option("--out", metavar="FILE.html", help="Where the page is written.")] = Path(
        "calibration.html"
    ),
) -> None:
    """Write one page with all calibrations of the bench and their plots; nothing moves.

    Example: rig calibrate report --bench sim --out calibration.html
    """
    from calibration.report import write_page
    from rig.calibrations import CalibrationStore

    with settings.open_bench(tell=False) as bench:
        store = CalibrationStore(bench.config.calibration_path(bench.name))
        now_utc = bench.clock.utc()
        standings = store.standings(bench.apparatus(), now_utc)
        unreadable = [error.what for error in store.unreadable]
        write_page(out, standings, store.history(), bench=bench.name, now_utc=now_utc, findings=unreadable)
    if settings.json:
        settings.print_json({"file": str(out), "calibrations": [s.fact.name for s in standings]})
    else:
        print(out)


@app.command("show")
@command
def show(settings: Settings) -> None:
    """Show what is in force on the bench, what has expired, and what belongs to other devices; nothing moves.

    Example: rig calibrate show --bench sim
    """
    from rig.calibrations import CalibrationStore, State
    from rig.events.events import plain

    with settings.open_bench(tell=False) as bench:
        store = CalibrationStore(bench.config.calibration_path(bench.name))
        standings = store.standings(bench.apparatus(), bench.clock.utc())
        if settings.json:
            settings.print_json(
                {
                    "folder": str(store.folder),
                    "calibrations": [{"state": s.state, "words": s.words, **plain(s.fact)} for s in standings],
                }
            )
            return
        for finding in bench.findings:
            print(f"! {finding}")
        for standing in standings:
            if standing.state is State.IN_FORCE:
                print(f"✓ {standing.words}")
                print("\n".join(f"    {name} = {estimate}" for name, estimate in standing.fact.estimates.items()))
                for key, value in standing.fact.settings.items():
                    print(f"    sets {key} = {_plain(value)}")
        if not standings:
            print(f"Nothing is calibrated yet in {store.folder}: run `rig calibrate all`.")


@app.command("history")
@command
def history(
    settings: Settings,
    name: Annotated[str | None, typer.Argument(help="One kind, e.g. imu.scale; all where none is given.")] = None,
) -> None:
    """List every calibration that was kept, oldest first, passed or not.

    Example: rig calibrate history servo.backlash --bench sim
    """
    from rig.calibrations import CalibrationStore
    from rig.events.events import plain

    store = CalibrationStore(settings.load().calibration_path(settings.bench_name))
    facts = store.history(name)
    for error in store.unreadable:
        print(f"! {error.what}", file=sys.stderr)
    if settings.json:
        settings.print_json({"folder": str(store.folder), "calibrations": [plain(fact) for fact in facts]})
        return
    for fact in facts:
        values = ", ".join(f"{key} {estimate}" for key, estimate in fact.estimates.items())
        told = values if fact.passed else f"FAIL: {fact.refusals[0]}"
        print(f"{fact.when_utc:%Y-%m-%d %H:%M}  {fact.name:<16} {told}")
    if not facts:
        print(f"No calibration{f' of {name}' if name else ''} was kept in {store.folder}.")


def run(settings: Settings, *procedures: "Callable[[Bench], Generator[Any, None, CalibrationResult]]") -> None:
    """Run calibrations on the bench one after the other, keep each fact, passed or not, and say how it went.

    What passed is in force for the next one. The first that does not pass ends the row.

    Raises
    ------
    typer.Exit
        With code 6 when a calibration did not pass.
    """
    from rig.bench import calibrate
    from rig.calibrations import CalibrationStore
    from rig.cli.catalog.catalog import tell_other_regions

    with settings.open_bench() as bench:
        store = CalibrationStore(bench.config.calibration_path(bench.name))
        for procedure in procedures:
            for fact in _told(settings, procedure(bench)):
                path = store.keep(fact)
                if settings.json:
                    _print_json(settings, fact, path)
                else:
                    then = ", in force from now on." if fact.passed else "; what was in force stays so."
                    print(f"{outcome_text(fact)}\nKept in {path}{then}")
                if not fact.passed:
                    raise typer.Exit(EXIT_QUALITY)
            told, region = bench.calibration_findings, bench.config.view.roi
            calibrate(bench, store)
            for finding in bench.calibration_findings:
                if finding not in told:  # what a person wrote into the configuration wins
                    print(f"Note: {finding}.", file=sys.stderr)
            if bench.config.view.roi != region and (catalog := settings.catalog_there()):
                with catalog:
                    tell_other_regions(settings, catalog, bench)


def _in_force(bench: "Bench", name: str) -> "CalibrationResult":
    """Return the calibration of that name in force on the bench, which another one needs.

    Raises
    ------
    UsageError
        There is none.
    """
    from rig.calibrations import CalibrationStore, State
    from rig.core.errors import UsageError

    store = CalibrationStore(bench.config.calibration_path(bench.name))
    for standing in store.standings(bench.apparatus(), bench.clock.utc()):
        if standing.fact.name == name and standing.state is State.IN_FORCE:
            return standing.fact
    raise UsageError(
        f"{name} is not calibrated on this bench.", next_step=f"Run `rig calibrate {name.partition('.')[0]}` first."
    )


def _told(settings: Settings, events: "Generator[Any, None, CalibrationResult]") -> "Iterator[CalibrationResult]":
    """Tell the events of a procedure as they come, and yield its facts."""
    from calibration.events import Ask, Progress
    from rig.calibrations import CalibrationResult
    from rig.cli.ui.present import line
    from rig.events.events import event_dict

    with closing(events):
        for event in events:
            if isinstance(event, CalibrationResult):
                yield event
            elif isinstance(event, Ask):
                _ask(event, with_picture=not settings.json)
            elif settings.json:
                settings.print_json(event_dict(event))
            else:
                print(event.words if isinstance(event, Progress) else line(event), flush=True)


def _ask(what: "Ask", *, with_picture: bool) -> None:
    """Say what a person is to do, and wait until it is done; where nobody sits before it, go on."""
    print(f"{what.words}{what.picture if with_picture else ''}", file=sys.stderr)
    if sys.stdin.isatty():
        typer.prompt("Then press Enter", default="", show_default=False, err=True)


def _print_json(settings: Settings, fact: "CalibrationResult", path: "Path") -> None:
    from rig.events.events import plain

    settings.print_json({"event": "calibrated", "passed": fact.passed, "id": fact.id, "file": str(path), **plain(fact)})


def outcome_text(fact: "CalibrationResult") -> str:
    """Return in words what a calibration found, or why it was refused and what to do."""
    judged = ""
    if fact.residual is not None and fact.limit is not None:
        unit = fact.residual_unit
        judged = f" (worst residual {fact.residual:.3g} {unit}, limit {fact.limit:.3g} {unit})"
    lines = [f"{'PASS' if fact.passed else 'FAIL'} {fact.name}{judged}"]
    lines += [f"  {name} = {estimate}" for name, estimate in fact.estimates.items()]
    lines += [f"  sets {key} = {_plain(value)}" for key, value in fact.settings.items()]
    return "\n".join([*lines, *(f"  {reason}" for reason in fact.refusals)])


def _plain(value: Any) -> str:
    """Return a value of the configuration in a few digits."""
    return f"{value:.6g}" if isinstance(value, float) else str(value)
