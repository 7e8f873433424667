"""`rig doctor`."""

from contextlib import contextmanager
from textwrap import wrap
from typing import TYPE_CHECKING, Annotated

import typer

from rig.cli.command import Settings, command
from rig.errors import ConfigError, RigError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rich.console import Console

    from rig.doctor.case import Case
    from rig.doctor.finding import Finding

_TOPIC_WIDTH = 12
_INDENT = 2 + _TOPIC_WIDTH


@command
def doctor(
    settings: Settings,
    udev: Annotated[
        bool, typer.Option("--udev", help="Only print rules for udev: permissions, latency, a lasting name.")
    ] = False,
) -> None:
    """Look at everything the bench needs and say, a line a finding, what is wrong and which command mends it.

    Moves nothing and writes nothing. The exit code is that of the first finding marked ✗, else 0.

    Example: rig doctor --bench sim
    """
    from rig.doctor.computer import udev_rules

    if udev:
        with case_of(settings) as case:
            print(udev_rules(case.host.serial_ports()), end="")
        return
    code = examination(settings)
    if code:
        raise typer.Exit(code)


def examination(settings: Settings) -> int:
    """Examine the bench, print what is found, and return the exit code."""
    from rig.cli.find import say
    from rig.cli.present import console
    from rig.config import RigConfig
    from rig.doctor.checks import CHECKS
    from rig.doctor.examination import examine
    from rig.doctor.finding import Level, bad, fine, of_error

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
        with case_of(settings, default=config is None) as case:
            for finding in examine(case, CHECKS, say):
                tell(finding)
    except RigError as error:  # there is no such bench, or no such part of it
        tell(of_error("bench", error))
    counts = {level: sum(finding.level is level for finding in findings) for level in Level}
    code = next((finding.exit_code for finding in findings if finding.level is Level.BAD), 0)
    if settings.json:
        settings.print_json(
            {
                "bench": settings.bench or (config.default_bench if config else RigConfig().default_bench),
                "bad": counts[Level.BAD],
                "warnings": counts[Level.WARNING],
                "exit_code": code,
                "findings": [finding.as_dict() for finding in findings],
            }
        )
    else:
        problems, warnings = counts[Level.BAD], counts[Level.WARNING]
        screen.print(
            f"{problems or 'No'} problem{'s' if problems != 1 else ''}, {warnings or 'no'} "
            f"warning{'s' if warnings != 1 else ''}, {counts[Level.FINE]} fine.",
            highlight=False,
        )
    return code


@contextmanager
def case_of(settings: Settings, *, default: bool = False) -> "Iterator[Case]":
    """Yield the bench that the common options mean; with ``default`` as if there were no configuration."""
    from rig.config import RigConfig
    from rig.doctor.case import open_case

    config = RigConfig() if default else settings.load()
    file_options = ("--config", str(settings.config)) if settings.config else ()
    options = (*(("--bench", settings.bench) if settings.bench else ()), *file_options)
    options += tuple(part for override in settings.overrides for part in ("--set", override))
    name = settings.bench or config.default_bench
    with open_case(name, config, seed=settings.seed, options=options, file_options=file_options) as case:
        yield case


def print_finding(screen: "Console", finding: "Finding") -> None:
    """Print a finding: its mark, its topic, what was found, and below it the command that mends it."""
    from rich.text import Text

    from rig.doctor.finding import MARKS, Level

    style = {Level.FINE: "green", Level.WARNING: "yellow", Level.BAD: "bold red"}[finding.level]
    width = max(screen.width - _INDENT, 24) if screen.is_terminal else 10_000
    first, *more = wrap(finding.text, width, break_on_hyphens=False) or [""]
    screen.print(
        Text.assemble((MARKS[finding.level], style), f" {finding.topic:{_TOPIC_WIDTH}s}{first}"), soft_wrap=True
    )
    for line in more:
        screen.print(Text(" " * _INDENT + line), soft_wrap=True)
    if finding.mend:
        screen.print(Text(f"{' ' * _INDENT}→ {finding.mend}", "bold"), soft_wrap=True)


def _config_words(settings: Settings) -> str:
    from rig.config_values import default_path

    path = settings.config or default_path()
    return f"{path}: no mistakes" if path else "no rig.toml: the defaults are in force (rig setup writes one)"
