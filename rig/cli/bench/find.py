"""`rig find`."""

from typing import TYPE_CHECKING, Annotated, Any

import typer

from rig.cli.bench.findings import doctor_context, show_findings
from rig.cli.ui.command import command
from rig.cli.ui.exit_codes import EXIT_DEVICE
from rig.cli.ui.settings import Settings

if TYPE_CHECKING:
    from rig.config.toml_file import Key
    from rig.doctor.device_scan import DeviceScan


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

    scan = DeviceScan(both_protocols)
    with doctor_context(settings) as context:
        context.require_free()
        findings = show_findings(None if settings.json else console(), context, scan.checks)
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
        raise typer.Exit(EXIT_DEVICE)


def proposed_settings(scan: "DeviceScan") -> "dict[Key, Any]":
    """Return the settings of the unambiguous devices: those of which exactly one was found."""
    wanted: dict[Key, Any] = {}
    for what, found in scan.candidates.items():
        if len(found) == 1 and not (what == "servo" and scan.duplicate_ids):
            wanted |= found[0].settings
    return wanted
