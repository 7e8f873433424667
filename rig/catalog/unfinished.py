"""Results of a long job, stored so that the job can continue after an interruption.

Decision: docs/decisions/0061.
"""

import json
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final, Self, TextIO

from rig.core.files import json_values, no_follow, open_regular, write

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
        All values that the results depend on, besides the version of the program. Results of another job are not used.

    Attributes
    ----------
    found : dict
        The results of the interrupted job, JSON values by their keys.
    """

    def __init__(self, path: Path, job: str) -> None:
        self._path = path
        self._job = f"{job}, by {version('hbr-rig')}"
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
        lines = [json.dumps({"job": self._job}), *map(json.dumps, self.found.items())]
        write(self._path, "".join(f"{line}\n" for line in lines).encode(), mode=0o600)
        self._file = open(self._path, "a", encoding="utf-8", opener=no_follow)  # noqa: SIM115 - as in files.py

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
