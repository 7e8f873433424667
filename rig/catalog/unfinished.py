"""Results of a long job, stored so that the job can continue after an interruption.

Decision: docs/decisions/0065.
"""

import json
from contextlib import suppress
from io import TextIOWrapper
from pathlib import Path
from typing import Any, Final, Self, TextIO

from rig.core.files import json_values, open_new, open_regular

_LONGEST_LINE: Final = 1_000_000


class UnfinishedJob:
    """The results of a job so far, as a context manager: a file with a line for the job, and one for each result.

    A file that was not written to its end counts up to its last complete line. If the file cannot be written, the job
    cannot be continued; nothing else changes.

    Parameters
    ----------
    path
        The file.
    job
        What the results depend on: those of another job are not used.

    Attributes
    ----------
    found : dict
        The results of the interrupted job, JSON values by their keys.
    """

    def __init__(self, path: Path, job: str) -> None:
        self._path = path
        self._job = job
        self._file: TextIO | None = None
        self._begun = False
        self.found: dict[str, Any] = {}

    def load(self) -> None:
        """Read the results of the interrupted job, if there are any."""
        with suppress(OSError, ValueError, TypeError), open_regular(self._path) as file:
            if json_values(file.readline(_LONGEST_LINE)) != {"job": self._job}:
                return
            while (line := file.readline(_LONGEST_LINE)).endswith(b"\n"):
                key, value = json_values(line)
                self.found[str(key)] = value

    @property
    def is_stored(self) -> bool:
        """Whether there are results to continue from."""
        return self._file is not None or bool(self.found)

    def store(self, results: dict[str, Any]) -> None:
        """Store further results, JSON values by their keys."""
        try:
            if not self._begun:
                self._begin()
            if self._file is not None:
                self._file.writelines(f"{json.dumps(pair)}\n" for pair in results.items())
                self._file.flush()
        except OSError:
            self._close()
            self.found.clear()

    def _begin(self) -> None:
        """Write what was found before to a new file, which takes the place of the old one."""
        self._begun = True
        new = self._path.with_name(f"{self._path.name}.part")
        file = TextIOWrapper(open_new(new, mode=0o600), encoding="utf-8")
        try:
            file.write(f"{json.dumps({'job': self._job})}\n")
            file.writelines(f"{json.dumps(pair)}\n" for pair in self.found.items())
            file.flush()
            new.replace(self._path)
        except BaseException:
            file.close()
            with suppress(OSError):
                new.unlink()
            raise
        self._file = file

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Stop storing; the file stays."""
        self._close()

    def _close(self) -> None:
        if self._file is not None:
            with suppress(OSError):  # a full disk
                self._file.close()
            self._file = None

    def remove(self) -> None:
        """Remove the file: the job is done, or starts from the beginning."""
        self._close()
        with suppress(OSError):
            self._path.unlink()
