"""Runs on disk, a file an object, so that an interrupted evaluation goes on where it was."""

import io
import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from hbr.evaluation.protocol import Runs
from rig.core import files
from rig.core.errors import UsageError

_MAX_SETTINGS = 10_000_000


class Store:
    """The folder ``runs`` of an evaluation: its settings, and the runs of each object that is done.

    Parameters
    ----------
    folder
        Made where it is missing.
    settings
        What determines the results.
    resume
        Keep what is there; otherwise it must be empty.

    Raises
    ------
    UsageError
        There are runs and they were not to be resumed, or they are of other settings, or the folder cannot be written.
    """

    def __init__(self, folder: Path, settings: Mapping[str, Any], *, resume: bool) -> None:
        self._folder = folder
        recorded = folder / "settings.json"
        wanted: dict[str, Any] = json.loads(json.dumps(settings))
        try:
            folder.mkdir(parents=True, exist_ok=True)
            if recorded.exists():
                self._check(json.loads(files.read(recorded, max_bytes=_MAX_SETTINGS)), wanted, resume)
            else:
                files.write(recorded, json.dumps(wanted, indent=1).encode())
        except (OSError, json.JSONDecodeError) as error:
            raise UsageError(
                f"The runs cannot be kept in {folder}.",
                next_step="Name another folder with --out.",
                evidence={"reason": str(error)},
            ) from error

    def _check(self, found: dict[str, Any], wanted: dict[str, Any], resume: bool) -> None:
        different = sorted(key for key in found.keys() | wanted.keys() if found.get(key) != wanted.get(key))
        if different:
            raise UsageError(
                f"{self._folder} holds runs with other settings.",
                next_step="Name another folder with --out, or give the same options again.",
                evidence={f"{key} there": found.get(key) for key in different if key not in ("dataset", "methods")}
                | {"different": different},
            )
        if not resume:
            raise UsageError(
                f"{self._folder} holds runs already.",
                next_step="Go on with them by --resume, or name another folder with --out.",
            )

    def load(self, name: str) -> Runs | None:
        """Return the runs of an object; None where there are none, or the file was damaged."""
        try:
            with self._path(name).open("rb") as file, np.load(file) as arrays:
                return Runs(**arrays)
        except (OSError, ValueError, TypeError, BadZipFile, EOFError):
            return None

    def save(self, name: str, runs: Runs) -> None:
        """Keep the runs of an object, whole or not at all."""
        content = io.BytesIO()
        np.savez_compressed(content, **asdict(runs))
        files.write(self._path(name), content.getvalue())

    def _path(self, name: str) -> Path:
        # names of a catalog may hold what a file's name may not
        return self._folder / f"{name.encode().hex() if not name.isalnum() else name}.npz"
