"""`rig doctor`."""

from typing import TYPE_CHECKING, Annotated

import typer

from rig.cli.bench.examination import doctor_context, print_finding, say
from rig.cli.ui.command import command
from rig.cli.ui.settings import Settings
from rig.core.errors import ConfigError, RigError

if TYPE_CHECKING:
    from rig.doctor.finding import Finding


@command
def doctor(
    settings: Settings,
    udev: Annotated[
        bool, typer.Option("--udev", help="Only print rules for udev: permissions, latency, a lasting name.")
    ] = False,
) -> None:
    """Look at everything the bench needs and say, a line a finding, what is wrong and which command fixes it.

    Moves nothing and writes nothing. The exit code is that of the first finding marked ✗, else 0.

    Example: rig doctor --bench sim
    """
    from rig.doctor.computer import udev_rules

    if udev:
        with doctor_context(settings) as context:
            print(udev_rules(context.computer.serial_ports()), end="")
        return
    code = examination(settings)
    if code:
        raise typer.Exit(code)


def examination(settings: Settings) -> int:
    """Examine the bench, print what is found, and return the exit code."""
    from rig.cli.ui.present import console
    from rig.config import RigConfig
    from rig.doctor.checks import CHECKS
    from rig.doctor.examination import run_checks
    from rig.doctor.finding import Severity, bad, fine, of_error

    screen = console()
    findings: list[Finding] = []

    def tell(finding: "Finding") -> None:
        findings.append(finding)
        if not settings.json:
            print_finding(screen, finding)

    try:
        config: RigConfig | None = settings.load()
        tell(fine("config", _config_words(settings)))
    except ConfigError as error:
        mistakes = error.evidence.get("mistakes") or [f"{key}: {value}" for key, value in error.evidence.items()]
        for mistake in mistakes or [error.what]:
            tell(bad("config", f"{error.what.rstrip('.')}: {mistake}", "rig config check", error.exit_code))
        config = None
    try:
        with doctor_context(settings, default=config is None) as context:
            for finding in run_checks(context, CHECKS, say):
                tell(finding)
    except RigError as error:  # there is no such bench, or no such part of it
        tell(of_error("bench", error))
    counts = {level: sum(finding.level is level for finding in findings) for level in Severity}
    code = next((finding.exit_code for finding in findings if finding.level is Severity.BAD), 0)
    if settings.json:
        settings.print_json(
            {
                "bench": settings.bench or (config.default_bench if config else RigConfig().default_bench),
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


def _config_words(settings: Settings) -> str:
    from rig.config.values import default_path

    path = settings.config or default_path()
    return f"{path}: no mistakes" if path else "no rig.toml: the defaults are in force (rig setup writes one)"
