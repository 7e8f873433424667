"""`rig doctor`."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rig.cli.bench.findings import doctor_context, print_finding, show_findings
from rig.cli.bench.snapshot import check_new
from rig.cli.ui.command import command
from rig.cli.ui.settings import Settings
from rig.core.errors import ConfigError, RigError, UsageError
from rig.core.next_steps import Do

if TYPE_CHECKING:
    from rig.doctor.finding import Finding


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
    findings: list[Finding] = []
    code = print_findings(settings, findings)
    if bundle is not None:
        from rig.cli.bench.bundle import write_bundle

        write_bundle(settings, bundle, findings, picture=picture)
        print(f"Support bundle: {bundle}. Look through it before you send it.", file=sys.stderr)
    if code:
        raise typer.Exit(code)


def print_findings(settings: Settings, findings: "list[Finding] | None" = None) -> int:
    """Check the bench, print the findings, add them to ``findings``, and return the exit code."""
    from rig.cli.ui.present import console
    from rig.config import RigConfig
    from rig.config.values import default_path
    from rig.doctor.checks import CHECKS
    from rig.doctor.finding import FindingCode, Severity, bad, fine, of_error

    screen = console()
    findings = [] if findings is None else findings

    def add(finding: "Finding") -> None:
        findings.append(finding)
        if not settings.json:
            print_finding(screen, finding)

    try:
        config: RigConfig | None = settings.load()
        path = settings.config or default_path()
        add(fine("config", FindingCode.CONFIG_VALID if path else FindingCode.CONFIG_MISSING, path=path))
    except ConfigError as error:
        mistakes = error.evidence.get("mistakes") or [f"{key}: {value}" for key, value in error.evidence.items()]
        for mistake in mistakes or [error.what]:
            found = {"what": error.what.rstrip("."), "mistake": mistake}
            add(bad("config", FindingCode.CONFIG_MISTAKE, Do.CHECK_CONFIGURATION(), error.exit_code, **found))
        config = None
    try:
        with doctor_context(settings, default=config is None) as context:
            findings += show_findings(None if settings.json else screen, context, CHECKS)
    except RigError as error:  # there is no such bench, or no such part of it
        add(of_error("bench", error))
    counts = {level: sum(finding.level is level for finding in findings) for level in Severity}
    code = next((finding.exit_code for finding in findings if finding.level is Severity.BAD), 0)
    if settings.json:
        settings.print_json(
            {
                "bench": settings.bench or (config or RigConfig()).default_bench,
                "bad": counts[Severity.BAD],
                "warnings": counts[Severity.WARNING],
                "exit_code": code,
                "findings": [finding.as_dict() for finding in findings],
            }
        )
    else:
        problems, warnings = counts[Severity.BAD], counts[Severity.WARNING]
        screen.print(
            f"{problems or 'No'} problem{'s' if problems != 1 else ''}, {warnings or 'no'} "
            f"warning{'s' if warnings != 1 else ''}, {counts[Severity.FINE]} fine.",
            highlight=False,
        )
    return code
