"""Folders of photographs whose names tell object and angle, as COIL-100 has them: ``obj12__355.png``."""

import csv
import re
from collections.abc import Iterable
from datetime import datetime
from pathlib import Path
from typing import Any, Final

import numpy as np

from hbr.core.angles import wrap360
from rig.catalog.exchange.bundle import checked
from rig.catalog.exchange.new_folder import new_folder
from rig.catalog.exchange.package import (
    Object,
    Package,
    Photograph,
    Refused,
    assemble,
    parse_region,
    region_of_view,
    region_words,
)
from rig.catalog.records import EnrollmentStatus, this_software
from rig.core.errors import ExportFailed, ImportRejected, UsageError

DEFAULT_PATTERN: Final = "{object}__{angle}"
NAMES: Final = "objects.csv"
"""Beside the photographs of an export: what obj1, obj2, ... are called."""

SUFFIXES: Final = {".png", ".jpg", ".jpeg"}
_PARTS: Final = {
    "{object}": r"(?P<object>[^/]+?)",
    "{angle}": r"(?P<angle>[-+]?[0-9]+(?:\.[0-9]+)?)",
    "*": r"[^/]*?",
}
_MAX_NAMES_BYTES: Final = 100_000_000


def read_folder(folder: Path, *, pattern: str = DEFAULT_PATTERN, table_angles: bool = False, now: datetime) -> Package:
    """Find the photographs of a folder; they are read when they are brought in.

    Parameters
    ----------
    folder
        Where they are; a pattern with slashes looks into folders within.
    pattern
        A path without suffix, ``{object}`` and ``{angle}`` (in degrees) once each, ``*`` for anything else.
    table_angles
        The angles are of the table, turning under a fixed camera: azimuths run the other way.
    now
        Dates the enrollments.

    Raises
    ------
    UsageError
        The pattern does not name object and angle.
    ImportRejected
        There is no such folder, or no photograph in it.
    """
    named = _regex(pattern)
    if not folder.is_dir():
        raise ImportRejected(f"there is no folder {folder}", next_step="check the path")
    real = folder.resolve()
    inside: dict[Path, bool] = {}
    names = _names(folder / NAMES)
    photographs: list[tuple[str, Photograph]] = []
    refused = []
    for path in sorted(folder.glob("/".join("*" * (pattern.count("/") + 1)))):
        if path.suffix.lower() not in SUFFIXES:
            continue
        shown = path.relative_to(folder)
        if not path.is_file():
            refused.append(Refused(str(shown), "is no file"))
        elif not _stays(path, real, inside):
            refused.append(Refused(str(shown), "is a link that leaves the folder"))
        elif (found := named.fullmatch(shown.with_suffix("").as_posix())) is None:
            refused.append(Refused(str(shown), f"is not named like {pattern}"))
        else:
            angle_deg = float(found["angle"])
            azimuth_deg = float(wrap360(-angle_deg if table_angles else angle_deg))
            told = names.get(found["object"], {"name": found["object"]})
            photographs.append((found["object"], Photograph(path=path, azimuth_deg=azimuth_deg, values={}, **told)))
    if not photographs:
        raise ImportRejected(
            f"no photograph in {folder} is named like {pattern}.png",
            next_step="say how they are named, e.g. --pattern '{object}/{angle}'",
            evidence={"refused": [f"{file.path} {file.reason}" for file in refused[:5]]},
        )
    in_order = [photograph for _, photograph in sorted(photographs, key=lambda pair: _natural(pair[0]))]
    return assemble(str(folder), in_order, refused, now, this_software())


def write_folder(folder: Path, objects: Iterable[tuple[Object, dict[str, Path]]]) -> int:
    """Write the views that objects are retrieved by as ``obj{N}__{azimuth}.png``, with ``objects.csv`` for the names.

    The files are the stored ones, to the byte, and the azimuths exact.

    Raises
    ------
    ExportFailed
        The folder is not empty or cannot be written, or an image is not the one that was stored.
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
            region = region_words(region_of_view(complete[0].views[0]))
            rows.writerow([f"obj{count}", item.name, item.label, item.note, region])
            for view in complete[0].views:
                angle = np.format_float_positional(view.azimuth_deg, trim="-")
                target = made / f"obj{count}__{angle}{Path(view.image).suffix}"
                if target.exists():
                    raise ExportFailed(
                        f"{item.name!r} has two views from {angle}°", next_step="export a bundle, which holds both"
                    )
                target.write_bytes(checked(files[view.image], view.image_sha256))
    return count


def _stays(path: Path, real: Path, inside: dict[Path, bool]) -> bool:
    """Tell whether a file is really within a folder; what is known of folders is kept, there may be many files."""
    if path.is_symlink():
        return path.resolve().is_relative_to(real)
    if path.parent not in inside:
        inside[path.parent] = path.parent.resolve().is_relative_to(real)
    return inside[path.parent]


def _regex(pattern: str) -> re.Pattern[str]:
    if pattern.count("{object}") != 1 or pattern.count("{angle}") != 1:
        raise UsageError(
            f"the pattern {pattern!r} does not tell where object and angle are",
            next_step="write {object} and {angle} once each, e.g. '{object}/view-{angle}'",
        )
    stem = re.sub(r"\.(png|jpe?g)$", "", pattern, flags=re.IGNORECASE)
    return re.compile(
        "".join(_PARTS.get(part) or re.escape(part) for part in re.split(r"(\{object\}|\{angle\}|\*)", stem))
    )


def _names(path: Path) -> dict[str, dict[str, Any]]:
    """What an export says of obj1, obj2, ...: fields of `Photograph`."""
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
            f"{path} cannot be read: {error}",
            next_step="mend or remove it; without it objects are called as their files are",
        ) from error


def _natural(name: str) -> list[tuple[int, int, str]]:
    """Sort obj2 before obj10."""
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in re.split(r"([0-9]+)", name) if part]
