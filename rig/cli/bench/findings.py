"""What `rig doctor`, `rig find` and `rig setup` share: the bench to check, its findings, the progress."""

import sys
from contextlib import contextmanager
from textwrap import wrap
from typing import TYPE_CHECKING

from rig.cli.ui.settings import Settings
from rig.cli.ui.terminal import unguarded
from rig.core.control_characters import neutral

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from rich.console import Console

    from rig.doctor.context import DoctorContext
    from rig.doctor.examination import Check
    from rig.doctor.finding import Finding

_TOPIC_WIDTH = 12
_INDENT = 2 + _TOPIC_WIDTH


@contextmanager
def doctor_context(settings: Settings, *, default: bool = False) -> "Iterator[DoctorContext]":
    """Yield the bench of the common options; with ``default``, ignore the configuration file."""
    from rig.config import RigConfig
    from rig.doctor.context import open_context

    config = RigConfig() if default else settings.load()
    file_options = ("--config", str(settings.config)) if settings.config else ()
    options = (*(("--bench", settings.bench) if settings.bench else ()), *file_options)
    options += tuple(part for override in settings.overrides for part in ("--set", override))
    name = settings.bench or config.default_bench
    with open_context(name, config, seed=settings.seed, options=options, file_options=file_options) as context:
        yield context


def show_findings(screen: "Console | None", context: "DoctorContext", checks: "Iterable[Check]") -> "list[Finding]":
    """Run checks, and print and return their findings; nothing is printed without a screen."""
    from rig.doctor.examination import run_checks

    findings = []
    for finding in run_checks(context, checks, show_progress):
        findings.append(finding)
        if screen is not None:
            print_finding(screen, finding)
    return findings


def print_finding(screen: "Console", finding: "Finding") -> None:
    """Print a finding: its mark, its topic, its text, and below it the fix."""
    from rich.text import Text

    from rig.doctor.finding import MARKS, Severity, finding_words

    style = {Severity.FINE: "green", Severity.WARNING: "yellow", Severity.BAD: "bold red"}[finding.level]
    width = max(screen.width - _INDENT, 24) if screen.is_terminal else 10_000
    first, *more = wrap(finding_words(finding), width, break_on_hyphens=False) or [""]
    screen.print(
        Text.assemble((MARKS[finding.level], style), f" {finding.topic:{_TOPIC_WIDTH}s}{first}"), soft_wrap=True
    )
    for line in more:
        screen.print(Text(" " * _INDENT + line), soft_wrap=True)
    if finding.fix:
        screen.print(Text(f"{' ' * _INDENT}→ {finding.fix}", "bold"), soft_wrap=True)


def show_progress(text: str) -> None:
    """Show progress at a terminal; the next line replaces it."""
    if sys.stderr.isatty():
        print(f"\r\x1b[K{neutral(text[:78])}\r", end="", file=unguarded(sys.stderr), flush=True)
