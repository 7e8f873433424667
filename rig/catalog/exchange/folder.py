"""Folders of photographs with object and angle in their names, such as ``obj12__355.png`` in COIL-100."""

import csv
import re
from collections.abc import Iterable
from datetime import datetime
from pathlib import Path
from typing import Any, Final

import numpy as np

from hbr.core.angles import wrap360
from rig.catalog.exchange.batch import (
    ExportedObject,
    ImportBatch,
    ImportProblem,
    Reason,
    RejectedFile,
    parse_region,
    region_of_view,
    region_text,
)
from rig.catalog.exchange.bundle import read_stored
from rig.catalog.exchange.new_folder import new_folder
from rig.catalog.exchange.photographs import Photograph, assemble
from rig.catalog.records import EnrollmentStatus, this_software
from rig.core.errors import ExportFailed, ImportRejected, UsageError
from rig.core.next_steps import Do

DEFAULT_PATTERN: Final = "{object}__{angle}"
NAMES: Final = "objects.csv"
"""File with the names of obj1, obj2, ..., beside the photographs of an export."""

SUFFIXES: Final = {".png", ".jpg", ".jpeg"}
_PARTS: Final = {"{object}": r"(?P<object>[^/]+?)", "{angle}": r"(?P<angle>[-+]?[0-9]+(?:\.[0-9]+)?)", "*": r"[^/]*?"}
_MAX_NAMES_BYTES: Final = 100_000_000


def read_folder(
    folder: Path, *, pattern: str = DEFAULT_PATTERN, table_angles: bool = False, now: datetime
) -> ImportBatch:
    """Find the photographs of a folder. `import_objects` reads them.

    Parameters
    ----------
    folder
        Folder of the photographs. A pattern with slashes also looks into its subfolders.
    pattern
        A path without suffix: ``{object}`` and ``{angle}`` (in degrees) once each, ``*`` for any other text.
    table_angles
        The angles are table angles under a fixed camera: azimuths run in the opposite direction.
    now
        Time of the enrollments.

    Raises
    ------
    UsageError
        The pattern does not contain ``{object}`` and ``{angle}`` once each.
    ImportRejected
        There is no such folder, or no photograph in it.
    """
    named = _regex(pattern)
    if not folder.is_dir():
        raise ImportRejected(f"There is no folder {folder}.", next_step="Check the path.")
    real = folder.resolve()
    inside: dict[Path, bool] = {}
    names = _names(folder / NAMES)
    photographs: list[tuple[str, Photograph]] = []
    rejected = []
    for path in sorted(folder.glob("/".join("*" * (pattern.count("/") + 1)))):
        if path.suffix.lower() not in SUFFIXES:
            continue
        shown = path.relative_to(folder)
        if not path.is_file():
            rejected.append(RejectedFile(str(shown), Reason(ImportProblem.NOT_A_FILE)))
        elif not _stays(path, real, inside):
            rejected.append(RejectedFile(str(shown), Reason(ImportProblem.LINK_OUTSIDE)))
        elif (found := named.fullmatch(shown.with_suffix("").as_posix())) is None:
            rejected.append(RejectedFile(str(shown), Reason(ImportProblem.NAME_PATTERN, {"pattern": pattern})))
        else:
            angle_deg = float(found["angle"])
            azimuth_deg = float(wrap360(-angle_deg if table_angles else angle_deg))
            texts = names.get(found["object"], {"name": found["object"]})
            photographs.append((found["object"], Photograph(path=path, azimuth_deg=azimuth_deg, values={}, **texts)))
    if not photographs:
        raise ImportRejected(
            f"No photograph in {folder} matches the pattern {pattern}.png.",
            next_step=("Give the pattern of their names.", Do.RUN_AGAIN(pattern="{object}/{angle}")),
            evidence={"rejected": [f"{file.path} {file.reason}" for file in rejected[:5]]},
        )
    in_order = [photograph for _, photograph in sorted(photographs, key=lambda pair: _natural(pair[0]))]
    return assemble(str(folder), in_order, rejected, now, this_software())


def write_folder(folder: Path, objects: Iterable[ExportedObject]) -> int:
    """Write the views that searches use as ``obj{N}__{azimuth}.png``, and the names of the objects in ``objects.csv``.

    The files are copies of the stored ones, and the azimuths are exact.

    Raises
    ------
    ExportFailed
        The folder is not empty or cannot be written, or an image is not the stored one.
    """
    count = 0
    with new_folder(folder) as made, (made / NAMES).open("w", encoding="utf-8", newline="") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(["object", "name", "label", "note", "region"])
        for item, files in objects:
            complete = [e for e in item.enrollments if e.status == EnrollmentStatus.COMPLETE]
            if not complete:
                continue
            count += 1
            region = region_text(region_of_view(complete[0].views[0]))
            rows.writerow([f"obj{count}", item.name, item.label, item.note, region])
            for view in complete[0].views:
                angle = np.format_float_positional(view.azimuth_deg, trim="-")
                target = made / f"obj{count}__{angle}{Path(view.image).suffix}"
                if target.exists():
                    raise ExportFailed(
                        f"{item.name!r} has two views from {angle}°.", next_step="Export a bundle instead."
                    )
                target.write_bytes(read_stored(files[view.image], view.image_sha256))
    return count


def _stays(path: Path, real: Path, inside: dict[Path, bool]) -> bool:
    """Return whether a file is really within a folder; ``inside`` caches the answer for its folder."""
    if path.is_symlink():
        return path.resolve().is_relative_to(real)
    if path.parent not in inside:
        inside[path.parent] = path.parent.resolve().is_relative_to(real)
    return inside[path.parent]


def _regex(pattern: str) -> re.Pattern[str]:
    if pattern.count("{object}") != 1 or pattern.count("{angle}") != 1:
        raise UsageError(
            f"The pattern {pattern!r} does not contain {{object}} and {{angle}} once each.",
            next_step="Give a pattern such as '{object}/view-{angle}'.",
        )
    stem = re.sub(r"\.(png|jpe?g)$", "", pattern, flags=re.IGNORECASE)
    return re.compile(
        "".join(_PARTS.get(part) or re.escape(part) for part in re.split(r"(\{object\}|\{angle\}|\*)", stem))
    )


def _names(path: Path) -> dict[str, dict[str, Any]]:
    """Fields of `Photograph` for obj1, obj2, ..., from the file of an export."""
    if not path.is_file() or path.stat().st_size > _MAX_NAMES_BYTES:
        return {}
    try:
        with path.open(encoding="utf-8", newline="") as file:
            return {
                row["object"]: {
                    **{key: row.get(key) or "" for key in ("name", "label", "note")},
                    "region": parse_region(row.get("region") or ""),
                }
                for row in csv.DictReader(file)
                if row.get("object") and row.get("name")
            }
    except (OSError, ValueError, csv.Error) as error:
        raise ImportRejected(
            f"{path} cannot be read: {error}.",
            next_step="Fix or remove it; without it, objects get the names of their files.",
        ) from error


def _natural(name: str) -> list[tuple[int, int, str]]:
    """Sort key that puts obj2 before obj10."""
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in re.split(r"([0-9]+)", name) if part]
