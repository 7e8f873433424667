"""`rig doctor`, `rig find` and `rig setup`: the bench to check, its devices, its findings."""

import sys
from collections import deque
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from textwrap import wrap
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.text import Text

from rig.cli.ui.command import command
from rig.cli.ui.desk import CommandDesk
from rig.cli.ui.exit_codes import EXIT_DEVICE
from rig.cli.ui.options import check_new, write_new
from rig.cli.ui.present import console, show_progress
from rig.cli.ui.settings import Settings
from rig.config import RigConfig
from rig.config.values import FILE_NAME, default_path
from rig.core.errors import RigError, UsageError
from rig.doctor.computer import udev_rules
from rig.doctor.finding import Finding, Severity
from rig.jobs import setup as setup_jobs
from rig.jobs.desk import JobResult, Remark, Steps
from rig.jobs.doctor import Examined, check_configuration, examine, support_bundle
from rig.jobs.trace import record


@command
def doctor(
    settings: Settings,
    udev: Annotated[
        bool, typer.Option("--udev", help="Only print udev rules for permissions, latency and a permanent device name.")
    ] = False,
    bundle: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.zip", help="Also write a support bundle: findings, log, configuration and versions."
        ),
    ] = None,
    trace: Annotated[
        bool,
        typer.Option("--trace", help="Add what the devices send when they are opened, as rig servo record --still."),
    ] = False,
) -> None:
    """Check everything that the bench needs. Print one finding per line, and a fix for each problem.

    Moves nothing, and writes only the bundle. The exit code is 0, or that of the first finding marked ✗.

    Example: rig doctor --bench sim
    """
    if udev:  # alone, because the output is written into a file of the system
        with settings.open_parts() as context:
            print(udev_rules(context.computer.serial_ports()), end="")
        return
    if bundle is not None:
        check_new(bundle, ".zip")
    elif trace:
        raise UsageError("--trace needs a bundle.", next_step="Add --bundle FILE.zip.")
    found = print_findings(settings)
    # The bundle comes last: a problem that was found must not prevent it.
    if bundle is not None:
        packed = support_bundle(
            found.findings,
            settings.load,
            settings.config or default_path(),
            settings.bench,
            partial(settings.open_catalog, read_only=True),
            partial(still_trace, settings) if trace else None,
        )
        write_new(bundle, packed)
        print(f"Support bundle: {bundle}. Look through it before you send it.", file=sys.stderr)
    if found.exit_code:
        raise typer.Exit(found.exit_code)


def still_trace(settings: Settings) -> bytes:
    """Return a trace for which nothing moves; if a device fails, it ends there."""
    with TemporaryDirectory() as folder:
        file = Path(folder) / "trace.jsonl"
        try:
            deque(record(CommandDesk(settings.tracing(file)), still=True), maxlen=0)
        except RigError:
            if not file.exists():
                raise
        return file.read_bytes()


def print_findings(settings: Settings) -> Examined:
    """Check the bench, print the findings, and return the result."""
    config, known = check_configuration(settings.load, settings.config or default_path())
    bench = settings.bench or (config or RigConfig()).default_bench
    opened = settings.open_parts(default=config is None)
    found: Examined = _shown(settings, examine(bench, opened, known=known, progress=show_progress))
    return found


def _shown(settings: Settings, steps: Steps[None]) -> Any:
    """Print what a job yields, with --json only its result; return the result."""
    screen, result = console(), None
    for step in steps:
        if isinstance(step, JobResult):
            result = step.values
            settings.say(step.text, result)
        elif isinstance(step, Finding) and not settings.json:
            print_finding(screen, step)
        elif isinstance(step, Remark) and not settings.json:
            print(f"! {step.text}")
    return result


@command
def find(settings: Settings) -> None:
    """List the connected servos (at all baud rates), IMUs and cameras, and their settings for rig.toml.

    Writes nothing and moves nothing. Exit code 4 if no device was found.

    Example: rig find --bench sim
    """
    if not _shown(settings, setup_jobs.find(settings.open_parts(), show_progress))["settings"]:
        raise typer.Exit(EXIT_DEVICE)


@command
def setup(settings: Settings) -> None:
    """Find servo, IMU and camera, write them into a commented rig.toml, and run `rig doctor`.

    A device is written if no other one could take its place. An existing file keeps its comments and all other
    settings. Nothing moves.

    Example: rig setup --bench sim
    """
    path = settings.config or default_path() or Path(FILE_NAME)
    # A new file has no settings of the file in force: that may belong to another bench.
    now = settings if path.exists() else replace(settings, config=None, search=False)
    _shown(settings, setup_jobs.set_up(path, now.open_parts(), show_progress))
    if code := print_findings(replace(settings)).exit_code:  # a copy reads the file again
        raise typer.Exit(code)


_TOPIC_WIDTH = 12
_INDENT = 2 + _TOPIC_WIDTH


def print_finding(screen: Console, finding: Finding) -> None:
    """Print a finding: its mark, its topic, its text, and below it the fix."""
    marks = {Severity.FINE: ("✓", "green"), Severity.WARNING: ("!", "yellow"), Severity.BAD: ("✗", "bold red")}
    width = max(screen.width - _INDENT, 24) if screen.is_terminal else 10_000
    first, *more = wrap(finding.words, width, break_on_hyphens=False) or [""]
    screen.print(Text.assemble(marks[finding.level], f" {finding.topic:{_TOPIC_WIDTH}s}{first}"), soft_wrap=True)
    for line in more:
        screen.print(Text(" " * _INDENT + line), soft_wrap=True)
    if finding.fix:
        screen.print(Text(f"{' ' * _INDENT}→ {finding.fix}", "bold"), soft_wrap=True)
