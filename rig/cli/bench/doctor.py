"""`rig doctor`, `rig find` and `rig setup`: the bench to check, its devices, its findings."""

import sys
from collections import deque
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from textwrap import wrap
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rig.cli.ui.command import command
from rig.cli.ui.exit_codes import EXIT_DEVICE
from rig.cli.ui.settings import Settings
from rig.cli.ui.terminal import unguarded
from rig.core.control_characters import neutral
from rig.core.errors import RigError, UsageError, os_errors_as

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rich.console import Console

    from rig.doctor.context import DoctorContext
    from rig.doctor.finding import Finding
    from rig.jobs.desk import Steps
    from rig.jobs.doctor import Examined


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
            help="Also write a support bundle: findings, log, configuration and versions.",
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
    from rig.config.values import default_path
    from rig.doctor.computer import udev_rules
    from rig.jobs.doctor import support_bundle

    if udev:
        with doctor_context(settings) as context:
            print(udev_rules(context.computer.serial_ports()), end="")
        return
    if bundle is not None:
        check_new(bundle, ".zip")
    elif trace:
        raise UsageError("--trace needs a bundle.", next_step="Add --bundle FILE.zip.")
    found = print_findings(settings)
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
    from rig.cli.ui.desk import CommandDesk
    from rig.jobs.trace import record

    with TemporaryDirectory() as folder:
        file = Path(folder) / "trace.jsonl"
        try:
            deque(record(CommandDesk(settings.tracing(file)), still=True), maxlen=0)
        except RigError:
            if not file.exists():
                raise
        return file.read_bytes()


def print_findings(settings: Settings) -> "Examined":
    """Check the bench, print the findings, and return the result."""
    from rig.config import RigConfig
    from rig.config.values import default_path
    from rig.jobs.doctor import check_configuration, examine

    config, known = check_configuration(settings.load, settings.config or default_path())
    bench = settings.bench or (config or RigConfig()).default_bench
    opened = doctor_context(settings, default=config is None)
    found: Examined = _shown(settings, examine(bench, opened, known=known, progress=show_progress))
    return found


def _shown(settings: Settings, steps: "Steps[None]") -> Any:
    """Print what a job yields, with --json only its result; return the result."""
    from rig.cli.ui.present import console
    from rig.doctor.finding import Finding
    from rig.jobs.desk import JobResult, Remark

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
    from rig.jobs.setup import find as find_devices

    if not _shown(settings, find_devices(doctor_context(settings), show_progress))["settings"]:
        raise typer.Exit(EXIT_DEVICE)


@command
def setup(settings: Settings) -> None:
    """Find servo, IMU and camera, write them into a commented rig.toml, and run `rig doctor`.

    A device is written if no other one could take its place. An existing file keeps its comments and all other
    settings. Nothing moves.

    Example: rig setup --bench sim
    """
    from rig.config.values import FILE_NAME, default_path
    from rig.jobs.setup import set_up

    path = settings.config or default_path() or Path(FILE_NAME)
    # A new file has no settings of the file in force: that may belong to another bench.
    now = settings if path.exists() else replace(settings, config=None, search=False)
    _shown(settings, set_up(path, doctor_context(now), show_progress))
    if code := print_findings(replace(settings)).exit_code:  # a copy reads the file again
        raise typer.Exit(code)


_TOPIC_WIDTH = 12
_INDENT = 2 + _TOPIC_WIDTH


@contextmanager
def doctor_context(settings: Settings, *, default: bool = False) -> "Iterator[DoctorContext]":
    """Yield the bench of the common options; with ``default``, ignore the configuration file."""
    from rig.config import RigConfig
    from rig.doctor.context import open_context

    config = RigConfig() if default else settings.load()
    file_options = ("--config", str(settings.config)) if settings.config else ()
    options = tuple(settings.selection())
    options += tuple(part for override in settings.overrides for part in ("--set", override))
    name = settings.bench or config.default_bench
    with open_context(name, config, seed=settings.seed, options=options, file_options=file_options) as context:
        yield context


def print_finding(screen: "Console", finding: "Finding") -> None:
    """Print a finding: its mark, its topic, its text, and below it the fix."""
    from rich.text import Text

    from rig.doctor.finding import Severity, finding_words

    marks = {Severity.FINE: ("✓", "green"), Severity.WARNING: ("!", "yellow"), Severity.BAD: ("✗", "bold red")}
    width = max(screen.width - _INDENT, 24) if screen.is_terminal else 10_000
    first, *more = wrap(finding_words(finding), width, break_on_hyphens=False) or [""]
    screen.print(Text.assemble(marks[finding.level], f" {finding.topic:{_TOPIC_WIDTH}s}{first}"), soft_wrap=True)
    for line in more:
        screen.print(Text(" " * _INDENT + line), soft_wrap=True)
    if finding.fix:
        screen.print(Text(f"{' ' * _INDENT}→ {finding.fix}", "bold"), soft_wrap=True)


def show_progress(text: str) -> None:
    """Show progress at a terminal; the next line replaces it."""
    if sys.stderr.isatty():
        print(f"\r\x1b[K{neutral(text[:78])}\r", end="", file=unguarded(sys.stderr), flush=True)


def check_new(file: Path, suffix: str) -> None:
    """Raise `UsageError` if a file has another suffix, or exists."""
    if file.suffix.lower() != suffix:
        raise UsageError(f"{file} does not end with {suffix}.", next_step=f"Give a name that ends with {suffix}.")
    if file.exists():
        raise UsageError(f"{file} exists.", next_step="Give another name.")


def write_new(file: Path, content: bytes) -> None:
    """Write a file that does not exist yet. Raises `UsageError` if that is not possible."""
    what, step = f"{file} cannot be written.", "Choose another folder."
    with os_errors_as(UsageError, what, next_step=step), file.open("xb") as output:
        output.write(content)
