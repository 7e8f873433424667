"""`rig doctor`."""

import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from rig.cli.bench.findings import doctor_context, print_finding, show_progress
from rig.cli.bench.snapshot import check_new
from rig.cli.ui.command import command
from rig.cli.ui.settings import Settings
from rig.core.errors import UsageError


@command
def doctor(
    settings: Settings,
    udev: Annotated[
        bool, typer.Option("--udev", help="Only print udev rules for permissions, latency and a permanent device name.")
    ] = False,
    bundle: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.zip",
            help="Also write a support bundle: findings, log, configuration and versions. It has no pictures.",
        ),
    ] = None,
    picture: Annotated[bool, typer.Option("--picture", help="Add one image of the camera to the bundle.")] = False,
) -> None:
    """Check everything that the bench needs. Print one finding per line, and a fix for each problem.

    Moves nothing, and writes only the bundle. The exit code is 0, or that of the first finding marked ✗.

    Example: rig doctor --bench sim
    """
    from rig.doctor.computer import udev_rules

    if udev:
        with doctor_context(settings) as context:
            print(udev_rules(context.computer.serial_ports()), end="")
        return
    if bundle is not None:
        check_new(bundle, ".zip")
    elif picture:
        raise UsageError("--picture needs a bundle.", next_step="Add --bundle FILE.zip.")
    found = print_findings(settings)
    if bundle is not None:
        from rig.cli.bench.bundle import write_bundle

        write_bundle(settings, bundle, found["findings"], picture=picture)
        print(f"Support bundle: {bundle}. Look through it before you send it.", file=sys.stderr)
    if found["exit_code"]:
        raise typer.Exit(found["exit_code"])


def print_findings(settings: Settings) -> dict[str, Any]:
    """Check the bench, print the findings, and return the result as `--json` prints it."""
    from rig.cli.ui.present import console
    from rig.config import RigConfig
    from rig.config.values import default_path
    from rig.doctor.finding import Finding
    from rig.jobs.desk import Result
    from rig.jobs.doctor import check_configuration, examine

    screen = console()
    config, known = check_configuration(settings.load, settings.config or default_path())
    bench = settings.bench or (config or RigConfig()).default_bench
    found: dict[str, Any] = {}
    for step in examine(bench, doctor_context(settings, default=config is None), known=known, progress=show_progress):
        if isinstance(step, Finding) and not settings.json:
            print_finding(screen, step)
        elif isinstance(step, Result):
            found = step.values
            settings.say(step.text, found)
    return found
