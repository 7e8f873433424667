"""Progress of the catalog's long jobs, questions before deletions, and tables."""

import sys
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from typing import TYPE_CHECKING, TypeVar

import typer

from rig.cli.ui.exit_codes import EXIT_DECLINED, EXIT_INTERRUPTED
from rig.cli.ui.settings import Settings
from rig.core.control_characters import neutral
from rig.core.errors import UsageError

if TYPE_CHECKING:
    from rig.catalog.jobs import JobProgress

_T = TypeVar("_T")


def run_job(title: str, job: "Generator[JobProgress, None, _T]", *, interrupted: str | Callable[[], str]) -> _T:
    """Run a job with a progress bar on stderr and return its result; Ctrl+C prints ``interrupted``."""
    from rig.catalog.jobs import finished
    from rig.cli.ui.present import Progress

    with interruptible(interrupted), closing(job), Progress(title) as progress:
        return finished(job, progress)


@contextmanager
def interruptible(words: str | Callable[[], str]) -> Iterator[None]:
    """Print ``words``, or what it returns, after Ctrl+C, and end the program."""
    try:
        yield
    except KeyboardInterrupt:
        print(words if isinstance(words, str) else words(), file=sys.stderr)
        raise typer.Exit(EXIT_INTERRUPTED) from None


def is_interactive() -> bool:
    """Return whether an operator can answer questions: standard input is a terminal."""
    return sys.stdin.isatty()


def confirm(question: str, *, yes: bool, settings: Settings) -> None:
    """Ask before a deletion.

    Raises
    ------
    UsageError
        There is no terminal to ask on, and ``yes`` is not set.
    """
    if yes:
        return
    if settings.json or not is_interactive():
        raise UsageError(f"{question} This needs a confirmation.", next_step="Add --yes to confirm.")
    if not typer.confirm(question, err=True):
        print("Nothing was changed.", file=sys.stderr)
        raise typer.Exit(EXIT_DECLINED)


def print_table(columns: Sequence[str], rows: Iterable[Sequence[str]], *, right: Sequence[str] = ()) -> None:
    """Print a table as wide as the terminal; in a pipe print every row in full, as one line."""
    from rich.cells import cell_len
    from rich.table import Table
    from rich.text import Text

    from rig.cli.ui.present import console

    screen = console()
    if screen.is_terminal:
        table: Table = Table(box=None, pad_edge=False)
        for column in columns:
            table.add_column(column, justify="right" if column in right else "left", overflow="fold")
        for row in rows:
            table.add_row(*map(Text, row))  # a name can contain what Rich would read as markup
        screen.print(table)
        return
    # Rich takes milliseconds for each row
    lines = [[neutral(cell) for cell in row] for row in (columns, *rows)]
    widths = [max(map(cell_len, cells)) for cells in zip(*lines, strict=True)]
    for line in lines:
        spaces = [" " * (width - cell_len(cell)) for cell, width in zip(line, widths, strict=True)]
        cells = zip(columns, line, spaces, strict=True)
        print("  ".join(space + cell if name in right else cell + space for name, cell, space in cells).rstrip())
    sys.stdout.flush()


def size_words(size: float) -> str:
    """Return a number of bytes with a unit: "12.3 MB"."""
    for unit in ("bytes", "kB", "MB", "GB"):
        if size < 1000 or unit == "GB":
            return f"{size:.0f} {unit}" if unit == "bytes" else f"{size:.1f} {unit}"
        size /= 1000
    raise AssertionError
