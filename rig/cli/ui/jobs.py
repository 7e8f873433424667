"""Long jobs of the catalog on the terminal, and sizes in words."""

import sys
from collections.abc import Callable, Generator, Iterator
from contextlib import closing, contextmanager
from typing import TYPE_CHECKING, TypeVar

import typer

from rig.cli.ui.exit_codes import EXIT_INTERRUPTED

if TYPE_CHECKING:
    from rig.catalog.jobs import JobProgress

_T = TypeVar("_T")


def run_job(title: str, job: "Generator[JobProgress, None, _T]", *, interrupted: str | Callable[[], str]) -> _T:
    """Run a job with a progress bar on stderr and return its result; Ctrl+C prints ``interrupted``."""
    from rig.catalog.jobs import finished
    from rig.cli.ui.present import ProgressBar

    with interruptible(interrupted), closing(job), ProgressBar(title) as progress:
        return finished(job, progress)


@contextmanager
def interruptible(words: str | Callable[[], str]) -> Iterator[None]:
    """Print ``words``, or what it returns, after Ctrl+C, and end the program."""
    try:
        yield
    except KeyboardInterrupt:
        print(words if isinstance(words, str) else words(), file=sys.stderr)
        raise typer.Exit(EXIT_INTERRUPTED) from None


def size_words(size: float) -> str:
    """Return a number of bytes with a unit: "12.3 MB"."""
    for unit in ("bytes", "kB", "MB", "GB"):
        if size < 1000 or unit == "GB":
            return f"{size:.0f} {unit}" if unit == "bytes" else f"{size:.1f} {unit}"
        size /= 1000
    raise AssertionError
