"""`rig calibrate ...`."""

from collections.abc import Callable, Generator
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rig.cli.command import Settings, command

if TYPE_CHECKING:
    from rig.bench import Bench
    from rig.facts import Fact

EXIT_QUALITY = 6

app = typer.Typer(help="Measure the bench's own errors.", no_args_is_help=True)


@app.command("imu")
@command
def imu(
    settings: Settings,
    turns: Annotated[int, typer.Option(min=4, help="Whole turns at least, both ways together.")] = 8,
) -> None:
    """Calibrate the gyro's scale by whole turns of the table; takes about a minute, exit code 6 if it fails.

    Example: rig calibrate imu --bench sim --turns 12
    """
    from calibration.gyro_scale import live

    run(settings, lambda bench: live(bench, turns=turns))


def run(settings: Settings, procedure: "Callable[[Bench], Generator[Any, None, Fact]]") -> None:
    """Run one calibration on the bench, keep its fact, passed or not, and say how it went.

    Raises
    ------
    typer.Exit
        With code 6 when the calibration did not pass.
    """
    from rig.cli.present import line
    from rig.facts import Fact, FactStore
    from rig.plans.events import event_dict, plain

    with settings.open_bench() as bench:
        store = FactStore(bench.config.calibration_path(bench.name))
        events = procedure(bench)
        try:
            for event in events:
                if isinstance(event, Fact):
                    fact = event
                elif settings.json:
                    settings.print_json(event_dict(event))
                else:
                    print(line(event), flush=True)
        finally:
            events.close()
    path = store.keep(fact)
    if settings.json:
        settings.print_json({"event": "calibrated", "passed": fact.passed, "file": str(path), **plain(fact)})
    else:
        print(verdict(fact))
        print(f"Kept in {path}" + (", in force from now on." if fact.passed else "; what was in force stays so."))
    if not fact.passed:
        raise typer.Exit(EXIT_QUALITY)


def verdict(fact: "Fact") -> str:
    """Return in words what a calibration found, or why it was refused and what to do."""
    judged = ""
    if fact.residual is not None and fact.limit is not None:
        unit = fact.residual_unit
        judged = f" (worst residual {fact.residual:.3g} {unit}, limit {fact.limit:.3g} {unit})"
    lines = [f"{'PASS' if fact.passed else 'FAIL'} {fact.name}{judged}"]
    lines += [f"  {name} = {estimate}" for name, estimate in fact.estimates.items()]
    return "\n".join([*lines, *(f"  {reason}" for reason in fact.refusals)])
