"""Parts that the long jobs of a catalog share: progress, and portions of images or rows."""

import os
from collections.abc import Callable, Generator, Iterable, Iterator
from dataclasses import dataclass
from itertools import islice
from typing import Final, TypeVar

_T = TypeVar("_T")

PORTION: Final = 32
"""Images per call of a process: enough to make the time of the call small, but few, so that Ctrl+C works at once."""


@dataclass(frozen=True, slots=True)
class JobProgress:
    """Number of items that a long job has done."""

    done: int
    total: int


def finished(job: Generator[JobProgress, None, _T], progress: Callable[[JobProgress], None] = lambda _: None) -> _T:
    """Run a job to its end and return its result."""
    while True:
        try:
            at = next(job)
        except StopIteration as end:
            result: _T = end.value
            return result
        progress(at)


def portions(items: Iterable[_T], size: int = PORTION) -> Iterator[tuple[_T, ...]]:
    """Yield the items in portions."""
    waiting = iter(items)
    while portion := tuple(islice(waiting, size)):
        yield portion


def processes(wanted: int | None, items: int) -> int:
    """Return the useful number of processes for a number of images."""
    return min(wanted or os.cpu_count() or 1, max(1, items // (4 * PORTION)))
