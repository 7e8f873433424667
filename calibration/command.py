"""`rig calibrate ...`."""

from pathlib import Path
from typing import Annotated

import typer

from rig.cli.command import Settings, command

EXIT_QUALITY = 6

app = typer.Typer(help="Measure the bench's own errors.", no_args_is_help=True)


@app.command("imu")
@command
def imu(
    settings: Settings,
    turns: Annotated[int, typer.Option(min=4, help="Whole turns at least, both ways together.")] = 8,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Where the result is written (JSON) when it passes.")
    ] = None,
) -> None:
    """Calibrate the gyro's scale by whole turns of the table; takes about a minute, exit code 6 if it fails.

    Example: rig calibrate imu --bench sim --turns 12 --out imu-scale.json
    """
    from calibration.fact import Fact
    from calibration.gyro_scale import config_lines, live
    from rig.cli.present import line
    from rig.plans.events import event_dict, plain

    with settings.open_bench() as bench:
        events = live(bench, turns=turns)
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
    if out and fact.passed:
        fact.to_file(out)
    if settings.json:
        settings.print_json({"event": "calibrated", "passed": fact.passed, **plain(fact)})
    elif fact.passed:
        print(f"PASS {fact.name} = {fact.value:.6f} ± {fact.uncertainty:.6f}", end="")
        print(f" (worst residual {fact.residual:.3f}°, limit {fact.limit:.3f}°)")
        print(f"Put these lines into rig.toml:\n{config_lines(fact)}")
    else:
        print("\n".join([f"FAIL {fact.name}", *(f"  {reason}" for reason in fact.refusals)]))
    if not fact.passed:
        raise typer.Exit(EXIT_QUALITY)
