"""Runs on disk, one file for each object, so that an interrupted evaluation can continue."""

import io
import json
import re
from collections.abc import Mapping
from dataclasses import asdict
from hashlib import sha256
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from hbr.evaluation.protocol import Runs
from rig.core import files
from rig.core.errors import UsageError
from rig.core.next_steps import Do

FOLDER = Path("rig-eval")
"""The folder of all evaluations without a folder of their own choice."""
_MAX_SETTINGS = 10_000_000
_MAX_NAME = 60


def own_folder(name: str, settings: Mapping[str, Any]) -> Path:
    """Return the folder of the evaluation with these settings, JSON values; ``name`` is for readers.

    Evaluations with other settings have other folders. The same settings have the same one, so that the evaluation can
    continue there.
    """
    digest = sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:8]
    words = re.sub(r"[^\w.+-]+", "-", name).strip("-.")[-_MAX_NAME:]
    return FOLDER / f"{words}-{digest}"


class Store:
    """The folder ``runs`` of an evaluation: its settings, and the runs of each completed object.

    Parameters
    ----------
    folder
        Created if it is missing.
    settings
        The values that determine the results.
    resume
        Whether the folder may contain runs with these settings.

    Raises
    ------
    UsageError
        The folder contains runs with other settings, or any runs without `resume`; or it cannot be written.
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
                f"The runs cannot be stored in {folder}.",
                next_step=Do.RUN_AGAIN(out="FOLDER"),
                evidence={"reason": str(error)},
            ) from error

    def _check(self, found: dict[str, Any], wanted: dict[str, Any], resume: bool) -> None:
        different = sorted(key for key in found.keys() | wanted.keys() if found.get(key) != wanted.get(key))
        if different:
            raise UsageError(
                f"{self._folder} contains runs with other settings.",
                next_step=("Give the same options again, or", Do.RUN_AGAIN(out="FOLDER")),
                evidence={f"{key} there": found.get(key) for key in different if key not in ("dataset", "methods")}
                | {"different": different},
            )
        if not resume:
            raise UsageError(
                f"{self._folder} already contains runs.",
                next_step=(Do.RUN_AGAIN(resume=True), "Or", Do.RUN_AGAIN(out="FOLDER")),
            )

    def load(self, name: str) -> Runs | None:
        """Return the runs of an object; None if there are none, or if the file is damaged."""
        try:
            with self._path(name).open("rb") as file, np.load(file) as arrays:
                return Runs(**arrays)
        except (OSError, ValueError, TypeError, BadZipFile, EOFError):
            return None

    def save(self, name: str, runs: Runs) -> None:
        """Store the runs of an object, completely or not at all."""
        content = io.BytesIO()
        np.savez_compressed(content, **asdict(runs))
        files.write(self._path(name), content.getvalue())

    def _path(self, name: str) -> Path:
        # a name in a catalog may contain characters that a file name must not contain
        return self._folder / f"{name.encode().hex() if not name.isalnum() else name}.npz"
