"""Progress of the catalog's long jobs, questions before deletions, and tables."""

import sys
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Any, TypeVar

import typer

from rig.cli.ui.exit_codes import EXIT_DECLINED, EXIT_INTERRUPTED
from rig.cli.ui.settings import Settings

if TYPE_CHECKING:
    from rig.catalog.jobs import JobProgress

_T = TypeVar("_T")


def run_job(title: str, job: "Generator[JobProgress, None, _T]", *, interrupted: str | Callable[[], str]) -> _T:
    """Run a job with a progress bar on stderr and return its result.

    Ctrl+C prints ``interrupted``, or what it returns.
    """
    from rig.catalog.jobs import finished
    from rig.cli.ui.present import Progress

    def show(at: "JobProgress") -> None:
        if not at.done:
            progress.start(at.total)
        progress.at(at.done)

    try:
        with Progress(title) as progress:
            return finished(job, show)
    except KeyboardInterrupt:
        print(interrupted if isinstance(interrupted, str) else interrupted(), file=sys.stderr)
        raise typer.Exit(EXIT_INTERRUPTED) from None
    finally:
        job.close()


@contextmanager
def progress_bar(title: str) -> "Iterator[Callable[[JobProgress], None]]":
    """Yield a function that shows progress; the bar appears at its first call."""
    from rig.cli.ui.present import Progress

    with ExitStack() as shown:
        bar: Progress | None = None

        def show(at: "JobProgress") -> None:
            nonlocal bar
            if bar is None:
                bar = shown.enter_context(Progress(title))
                bar.start(at.total)
            bar.at(at.done)

        yield show


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
    from rig.core.errors import UsageError

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

    from rig.cli.ui.present import console
    from rig.core.control_characters import neutral

    screen = console()
    if screen.is_terminal:
        table: Table = Table(box=None, pad_edge=False)
        for column in columns:
            table.add_column(column, justify="right" if column in right else "left", overflow="fold")
        for row in rows:
            table.add_row(*(_plain(cell) for cell in row))
        screen.print(table)
        return
    # Rich takes milliseconds for each row
    lines = [[neutral(str(cell)) for cell in row] for row in (columns, *rows)]
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


def _plain(cell: Any) -> Any:
    from rich.text import Text

    return Text(str(cell))  # a name can contain what rich would read as markup
