"""`rig find`."""

from typing import TYPE_CHECKING, Annotated, Any

import typer

from rig.cli.bench.findings import doctor_context, print_finding, show_progress
from rig.cli.ui.command import command
from rig.cli.ui.settings import Settings

if TYPE_CHECKING:
    from rig.config.toml_file import Key
    from rig.doctor.device_scan import DeviceScan
    from rig.doctor.finding import Finding


@command
def find(
    settings: Settings,
    both_protocols: Annotated[
        bool,
        typer.Option("--all", help="Also search for AX-12A (protocol 1.0) if other servos answered. Takes a minute."),
    ] = False,
) -> None:
    """List the connected servos (at all baud rates), IMUs and cameras, and their settings for rig.toml.

    Writes nothing and moves nothing. Exit code 4 if no device was found.

    Example: rig find --bench sim
    """
    from rig.cli.ui.present import console
    from rig.config.toml_file import with_values
    from rig.doctor.device_scan import DeviceScan
    from rig.doctor.examination import run_checks

    screen = console()
    findings: list[Finding] = []
    scan = DeviceScan(both_protocols)
    with doctor_context(settings) as context:
        context.require_free()
        for finding in run_checks(context, scan.checks, show_progress):
            findings.append(finding)
            if not settings.json:
                print_finding(screen, finding)
    wanted = proposed_settings(scan)
    if settings.json:
        settings.print_json(
            {
                "findings": [finding.as_dict() for finding in findings],
                "settings": {".".join(key): value for key, value in wanted.items()},
            }
        )
    elif wanted:
        print(f"\nFor rig.toml (`rig setup` writes it):\n\n{with_values('', wanted)}", end="")
    if not wanted:
        raise typer.Exit(4)


def proposed_settings(scan: "DeviceScan") -> "dict[Key, Any]":
    """Return the settings of the unambiguous devices: those of which exactly one was found."""
    from rig.doctor.device_scan import camera_settings, head_settings, imu_settings, ribbon_settings, servo_settings

    wanted: dict[Key, Any] = {}
    if len(scan.servos) == 1 and not scan.duplicate_ids:
        wanted |= servo_settings(*scan.servos[0])
    if len(scan.heads) == 1 and not scan.imus:
        wanted |= head_settings(scan.heads[0])
    if len(scan.imus) == 1 and not scan.heads:
        wanted |= imu_settings(scan.imus[0])
    if len(scan.cameras) == 1:
        wanted |= camera_settings(scan.cameras[0])
    elif len(scan.ribbons) == 1 and not scan.cameras:
        wanted |= ribbon_settings(scan.ribbons[0])
    return wanted
