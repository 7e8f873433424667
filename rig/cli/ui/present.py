"""Tables, sizes and progress on a terminal."""

import os
import sys
from collections.abc import Generator, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager, closing
from datetime import datetime
from typing import Any, Final, TypeVar

import typer
from rich.cells import cell_len
from rich.console import Console, ConsoleOptions, RenderableType
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as RichProgress
from rich.segment import Segment

from rig.catalog.jobs import JobProgress, finished
from rig.cli.ui.exit_codes import EXIT_INTERRUPTED
from rig.cli.ui.terminal import unguarded
from rig.core.control_characters import neutral
from rig.core.phrases import number

_T = TypeVar("_T")
_PIPE_COLUMNS: Final = 240  # no row of a table is cut for a program that reads it


class _Screen(Console):
    def on_broken_pipe(self) -> None:
        raise BrokenPipeError  # `rig.cli.ui.command` handles it

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        for segment in super().render(renderable, options):
            yield segment if segment.control else Segment(neutral(segment.text), segment.style)


def console(*, stderr: bool = False, plain: bool = False) -> Console:
    """Return a console for stdout or stderr; colors and width follow the terminal, NO_COLOR and COLUMNS.

    Tables in a pipe or file are as wide as their content. ``plain`` prints as into a pipe, on a terminal too.
    """
    stream = unguarded(sys.stderr if stderr else sys.stdout)
    screen = _Screen(file=stream, stderr=stderr, force_terminal=False if plain else None)
    if not screen.is_terminal and "COLUMNS" not in os.environ:
        screen.width = _PIPE_COLUMNS
    return screen


def print_table(columns: Sequence[str], rows: Sequence[Mapping[str, Any]]) -> None:
    """Print these columns of the rows: every row in full, as one line; numbers end below each other."""
    lines = [list(columns), *([neutral(_cell(row[name])) for name in columns] for row in rows)]
    widths = [max(map(cell_len, cells)) for cells in zip(*lines, strict=True)]
    right = [all(isinstance(row[name], int | float | None) for row in rows) for name in columns]
    for line in lines:
        spaces = [" " * (width - cell_len(cell)) for cell, width in zip(line, widths, strict=True)]
        cells = zip(right, line, spaces, strict=True)
        print("  ".join(space + cell if to_right else cell + space for to_right, cell, space in cells).rstrip())
    sys.stdout.flush()


def _cell(value: Any) -> str:
    """Return a value as the text of a cell."""
    match value:
        case None | "":
            return "–"
        case datetime():
            return f"{value:%Y-%m-%d %H:%M:%S}"
        case float():
            return number(value, ".2f")
        case dict():
            given = ((key, item) for key, item in value.items() if item is not None and item is not False)
            return ", ".join(f"{key} {_cell(item)}" for key, item in given)
        case list() | tuple():
            return ", ".join(map(str, value))
        case _:
            return str(value)


def first(items: Sequence[str], count: int) -> list[str]:
    """Return the first items of a long list, and how many more ``--json`` prints."""
    more = len(items) - count
    return [*items[:count], *([f"and {more} more: --json"] if more > 0 else [])]


class ProgressBar(AbstractContextManager["ProgressBar"]):
    """A progress bar on stderr, shown from its first call on; only its notes if stderr is not a terminal."""

    def __init__(self, title: str) -> None:
        self._bar = RichProgress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
            console=console(stderr=True),
            disable=not sys.stderr.isatty(),
            redirect_stdout=False,  # Rich would interpret terminal escapes in what is printed meanwhile
            redirect_stderr=False,
        )
        self._task = self._bar.add_task(title, total=None, start=False)

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def __call__(self, at: JobProgress) -> None:
        """Show how much is done."""
        self._bar.start()
        self._bar.start_task(self._task)
        self._bar.update(self._task, total=at.total, completed=at.done)

    def note(self, text: str) -> None:
        """Print a line above the bar."""
        self._bar.console.print(text, markup=False, highlight=False, soft_wrap=not self._bar.console.is_terminal)


def run_job(title: str, job: Generator[JobProgress, None, _T], *, interrupted: str) -> _T:
    """Run a job of the catalog with a progress bar on stderr and return its result; Ctrl+C prints ``interrupted``."""
    try:
        with closing(job), ProgressBar(title) as progress:
            return finished(job, progress)
    except KeyboardInterrupt:
        print(interrupted, file=sys.stderr)
        raise typer.Exit(EXIT_INTERRUPTED) from None


def size_words(size: float) -> str:
    """Return a number of bytes with a unit: "12.3 MB"."""
    for unit in ("bytes", "kB", "MB", "GB"):
        if size < 1000 or unit == "GB":
            return f"{size:.0f} {unit}" if unit == "bytes" else f"{size:.1f} {unit}"
        size /= 1000
    raise AssertionError


def show_progress(text: str) -> None:
    """Show progress at a terminal; the next line replaces it."""
    if sys.stderr.isatty():
        print(f"\r\x1b[K{neutral(text[:78])}\r", end="", file=unguarded(sys.stderr), flush=True)
