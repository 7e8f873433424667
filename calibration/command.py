"""Measure the bench's own errors."""

import inspect
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from calibration.jobs import CALIBRATIONS, Calibration
from calibration.outcome import as_json, plain_value, stored_results
from rig.cli.ui.command import command
from rig.cli.ui.exit_codes import EXIT_QUALITY
from rig.cli.ui.options import show_parameters
from rig.cli.ui.settings import Settings
from rig.core.next_steps import Do, in_words

if TYPE_CHECKING:
    from calibration.procedure import Procedure

app = typer.Typer(help=__doc__, no_args_is_help=True)


def run(settings: Settings, *procedures: "Procedure") -> None:
    """Run procedures on the bench one after the other, store and report each result, and apply those that passed.

    A result that passed is in force for the next procedure. The first that does not pass ends the series.

    Raises `typer.Exit`: with code 6 if a calibration did not pass.
    """
    from calibration.procedure import calibrated
    from rig.cli.ui.desk import CommandDesk

    desk = CommandDesk(settings, with_json=True)  # a person must put the board there
    if not desk.run("calibrate", calibrated(desk, procedures)):
        raise typer.Exit(EXIT_QUALITY)


def _command_of(calibration: Calibration) -> Callable[..., None]:
    """Return the command that runs a calibration; it has the parameters and the docstring of its procedures."""

    def start(settings: Settings, **options: Any) -> None:
        if procedures := calibration.procedures(**options):  # none if the board is only printed
            run(settings, *procedures)
        if calibration is CALIBRATIONS["all"] and options["thing"] is None:
            print(f"Next: {Do.CALIBRATE(name='noise').command} NAME, with an object.", file=sys.stderr)

    own = inspect.signature(calibration.procedures).parameters.values()
    show_parameters(start, [next(iter(inspect.signature(start).parameters.values())), *own])
    start.__doc__ = calibration.procedures.__doc__
    return command(start)


for _name, _calibration in CALIBRATIONS.items():
    app.command(_name)(_command_of(_calibration))


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
