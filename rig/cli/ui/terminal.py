r"""Guarded output of a command: text from files and devices cannot control the terminal.

Labels, notes, file names and answers of devices can hold terminal escapes. Standard output and standard error replace
such characters by ``\u001b``. JSON stays JSON, because that is its own notation. Colors come from Rich, which writes to
the unguarded stream; `rig.cli.ui.present.console` guards its text.

This module imports none of numpy, cv2, scipy and sqlalchemy: `rig --help` must start at once.
"""

import io
import os
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, TextIO, cast

from rig.core.control_characters import neutral
from rig.core.errors import OutputFailed


class _Output:
    """A text stream; a write that fails is a `RigError`, except if the reader of a pipe has ended."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        if text == "":  # Typer tries a stream so, and would drop the error of a full disk
            return 0
        with self._failures():
            return self._stream.write(text)

    def writelines(self, lines: Iterable[str]) -> None:
        for line in lines:
            self.write(line)

    def flush(self) -> None:
        with self._failures():
            self._stream.flush()

    @contextmanager
    def _failures(self) -> Iterator[None]:
        try:
            yield
        except BrokenPipeError:
            raise
        except OSError as error:
            discard(self._stream)
            raise OutputFailed(
                "The output cannot be written.",
                next_step="Make space on the disk, or redirect the output to another file.",
                evidence={"reason": error.strerror or str(error)},
            ) from error


class _GuardedOutput(_Output):
    """A text stream that neutralises its input; ``unguarded`` is the same stream without that."""

    def __init__(self, stream: TextIO) -> None:
        super().__init__(stream)
        self.unguarded = cast(TextIO, _Output(stream))

    def write(self, text: str) -> int:
        super().write(neutral(text))
        return len(text)


@contextmanager
def checked_output() -> Iterator[None]:
    """Report failures of standard output and standard error as `OutputFailed` in a ``with`` block."""
    with _replaced(_Output):
        yield


@contextmanager
def guarded_output() -> Iterator[None]:
    """Guard standard output and standard error in a ``with`` block."""
    with _replaced(_GuardedOutput):
        yield


@contextmanager
def _replaced(kind: type[_Output]) -> Iterator[None]:
    before = sys.stdout, sys.stderr
    # A stream is None if the program was started with it closed.
    sys.stdout, sys.stderr = (cast(TextIO, kind(stream or io.StringIO())) for stream in before)
    try:
        yield
    finally:
        sys.stdout, sys.stderr = before


def unguarded(stream: TextIO) -> TextIO:
    """Return the stream that Rich and the bell write to."""
    inner: TextIO = getattr(stream, "unguarded", stream)
    return inner


def discard(stream: TextIO) -> None:
    """Discard what is written to a stream from now on: its disk is full, or its reader has ended."""
    with suppress(OSError, ValueError):  # a stream of a test has no file
        null = os.open(os.devnull, os.O_WRONLY)
        try:
            os.dup2(null, stream.fileno())
        finally:
            os.close(null)
