"""What the long jobs of a catalog share: how far they are, and the images in portions for processes."""

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final, TypeVar

_T = TypeVar("_T")

PORTION: Final = 32
"""Images that a process is given at a time: enough that handing them over costs nothing, and Ctrl+C does not wait."""


@dataclass(frozen=True, slots=True)
class Progressed:
    """A long job has done so many of its items."""

    done: int
    total: int


def portions(items: Sequence[_T]) -> Iterator[tuple[_T, ...]]:
    """Yield the items in portions."""
    for start in range(0, len(items), PORTION):
        yield tuple(items[start : start + PORTION])


def processes(wanted: int | None, items: int) -> int:
    """Return how many processes are worth their start for so many images."""
    return min(wanted or os.cpu_count() or 1, max(1, items // (4 * PORTION)))
