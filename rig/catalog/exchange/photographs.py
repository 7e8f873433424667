"""Photographs with known angles, as the source of an import: a folder, or a CSV table with one row per view.

In a folder the names of the files tell object and angle, such as ``obj12__355.png`` in COIL-100.
"""

import csv
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

from hbr.core.angles import wrap360
from rig.catalog.exchange.tables import ANGLES, NAMES, parse_region
from rig.catalog.facts import Enrollment, Session, View
from rig.catalog.records import EnrollmentStatus, Provenance, check_text, clean_name, this_software
from rig.catalog.rejected import Gap, ImportProblem, Reason, RejectedFile
from rig.catalog.state import EnrollmentState
from rig.catalog.transfer import Item
from rig.core.errors import ImportRejected, UsageError
from rig.core.next_steps import Do
from rig.views.image_files import read_file

DEFAULT_PATTERN: Final = "{object}__{angle}"

_SUFFIXES: Final = {".png", ".jpg", ".jpeg"}
_PARTS: Final = {"{object}": r"(?P<object>[^/]+?)", "{angle}": r"(?P<angle>[-+]?[0-9]+(?:\.[0-9]+)?)", "*": r"[^/]*?"}
_NEEDED: Final = ("object", "azimuth_deg", "image")
_MAX_TABLE_BYTES: Final = 1_000_000_000

_Row = Mapping[str, str]


@dataclass(eq=False)
class Photographs:
    """Objects that are imported from image files: a `rig.catalog.transfer.Source`.

    The name of an image is the path of its file. A file is not read before it is transferred. Each object has one
    complete enrollment, with views by ascending azimuth.

    Attributes
    ----------
    origin
        The folder or the table.
    folder
        The folder that contains all files.
    now
        Time of the enrollments.
    rejected
        What cannot be used, and why.
    """

    origin: str
    folder: Path
    now: datetime
    rejected: list[RejectedFile] = field(default_factory=list)
    _software: str = field(default_factory=this_software)
    _found: dict[str, dict[float, tuple[Path, _Row, dict[str, Any]]]] = field(default_factory=dict)
    _inside: dict[Path, bool] = field(default_factory=dict)

    def add(self, path: Path, row: _Row, azimuth_deg: float, **values: Any) -> None:
        """Add a file that shows the object of a row; ``values`` are other fields of `View`.

        It is rejected if the name or a text cannot be stored, or if the object has a view from this azimuth.
        """
        try:
            name = clean_name(row["object"])
            for what in ("label", "note", "bench", "software"):
                check_text(row.get(what, ""), what)
        except UsageError as error:
            self.reject(str(path), ImportProblem.INVALID_VALUE, error=error.what.rstrip("."))
            return
        views = self._found.setdefault(name, {})
        if azimuth_deg in views:
            self.reject(str(path), ImportProblem.SAME_AZIMUTH, name=name, other=views[azimuth_deg][0].name)
            return
        views[azimuth_deg] = path, row, values

    def reject(self, path: str, code: ImportProblem, **values: Any) -> None:
        self.rejected.append(RejectedFile(path, Reason(code, values)))

    def contains(self, path: Path) -> bool:
        """Return whether a file is really within the folder, where links lead."""
        if path.is_symlink():
            return path.resolve().is_relative_to(self.folder)
        if path.parent not in self._inside:
            self._inside[path.parent] = path.parent.resolve().is_relative_to(self.folder)
        return self._inside[path.parent]

    def rejected_words(self) -> list[str]:
        return [f"{file.path} {file.reason}" for file in self.rejected[:5]]

    def items(self) -> Iterator[Item]:
        """Yield the objects in the order of the folder or the table."""
        for name, views in self._found.items():
            yield self._item(name, views)

    @staticmethod
    def content(image: str) -> bytes:
        """Return the bytes of an image file; an `OSError` if it cannot be read."""
        return read_file(Path(image))

    @property
    def gaps(self) -> tuple[Gap, ...]:
        """The missing views of objects that are seen from most sides at even steps; each object has its own step."""
        return tuple(Gap(name, azimuth_deg) for name, views in self._found.items() for azimuth_deg in _gaps(views))

    def _item(self, name: str, found: dict[float, tuple[Path, _Row, dict[str, Any]]]) -> Item:
        azimuths_deg = tuple(sorted(found))
        enrollment = Enrollment(  # the transfer replaces the key by a digest of the images
            key=name, object_id=0, started_utc=self.now, planned_azimuth_deg=azimuths_deg
        )
        sessions: dict[tuple[str, str], Session] = {}
        texts = {"label": "", "note": ""}
        for index, azimuth_deg in enumerate(azimuths_deg):
            path, row, values = found[azimuth_deg]
            by = (row.get("bench", ""), row.get("software") or self._software)
            if by not in sessions:
                provenance = Provenance(by[0], {}, {"imported_from": self.origin}, by[1])
                sessions[by] = Session(number=len(sessions), started_utc=self.now, provenance=provenance)
            view = View(index=index, azimuth_deg=azimuth_deg, image=str(path), **values)
            view.session = sessions[by].number
            enrollment.views.append(view)
            texts = {key: text or row.get(key, "") for key, text in texts.items()}
        enrollment.sessions.extend(sessions.values())
        state = EnrollmentState(enrollment, EnrollmentStatus.COMPLETE, self.now, None)
        return Item(name=name, **texts, created_utc=self.now, enrollments=(state,))


def read_folder(
    folder: Path, *, pattern: str = DEFAULT_PATTERN, table_angles: bool = False, now: datetime
) -> Photographs:
    """Find the photographs of a folder.

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
    photographs = Photographs(str(folder), folder.resolve(), now)
    matches: list[tuple[str, float, Path]] = []
    for path in sorted(folder.glob("/".join("*" * (pattern.count("/") + 1)))):
        if path.suffix.lower() not in _SUFFIXES:
            continue
        shown = path.relative_to(folder)
        if not path.is_file():
            photographs.reject(str(shown), ImportProblem.NOT_A_FILE)
        elif not photographs.contains(path):
            photographs.reject(str(shown), ImportProblem.LINK_OUTSIDE)
        elif (found := named.fullmatch(shown.with_suffix("").as_posix())) is None:
            photographs.reject(str(shown), ImportProblem.NAME_PATTERN, pattern=pattern)
        else:
            matches.append((found["object"], float(found["angle"]), path))
    if not matches:
        raise ImportRejected(
            f"No photograph in {folder} matches the pattern {pattern}.png.",
            next_step=("Give the pattern of their names.", Do.RUN_AGAIN(pattern="{object}/{angle}")),
            evidence={"rejected": photographs.rejected_words()},
        )
    about = _about(folder / NAMES)
    for key, angle_deg, path in sorted(matches, key=lambda match: _natural(match[0])):
        row, region = about.get(key, ({"object": key}, None))
        photographs.add(path, row, wrap360(-angle_deg if table_angles else angle_deg), region=region)
    return photographs


def read_table(path: Path, *, now: datetime) -> Photographs:
    """Read a CSV file with one row per view: ``object``, ``azimuth_deg``, ``image`` (a relative path) and more.

    Unknown columns are ignored. A row that cannot be used is rejected; the others are imported.

    Raises
    ------
    ImportRejected
        The file is not such a table.
    """
    photographs = Photographs(str(path), path.parent.resolve(), now)
    used = 0
    for line, row in _rows(path, _NEEDED, "Save it as CSV in UTF-8."):
        try:
            _add_row(photographs, {key: text.strip() for key, text in row.items()})
            used += 1
        except (ValueError, OverflowError, OSError) as error:
            photographs.reject(f"{path.name}, line {line}", ImportProblem.INVALID_VALUE, error=str(error))
    if not used:
        raise ImportRejected(
            f"{path} has no row that can be used.",
            next_step="Fix the listed rows." if photographs.rejected else "Add one row per view.",
            evidence={"rejected": photographs.rejected_words()},
        )
    return photographs


def _add_row(photographs: Photographs, row: _Row) -> None:
    """Add the photograph of a row. ValueError says why a row cannot be used."""
    if missing := [name for name in _NEEDED if not row.get(name)]:
        raise ValueError(f"{' and '.join(missing)} missing")
    path = photographs.folder / row["image"]
    if not photographs.contains(path):
        raise ValueError(f"the image {row['image']} is not in the folder of the table")
    if not path.is_file():
        raise ValueError(f"there is no image {row['image']}")
    values: dict[str, Any] = {name: _number(row[name], name) for name in ANGLES if row.get(name)}
    if (values.get("imu_deg") is None) != (values.get("imu_sigma_deg") is None):
        raise ValueError("imu_deg and imu_sigma_deg: give both or none")
    if row.get("captured_utc"):
        time = datetime.fromisoformat(row["captured_utc"])
        if time.tzinfo is None:
            raise ValueError(f"captured_utc {row['captured_utc']} has no time zone")
        values["captured_utc"] = time.astimezone(UTC)
    azimuth_deg = wrap360(_number(row["azimuth_deg"], "azimuth_deg"))
    photographs.add(path, row, azimuth_deg, region=parse_region(row.get("region", "")), **values)


def _rows(path: Path, needed: Sequence[str], fix: str) -> Iterator[tuple[int, _Row]]:
    """Yield the rows of a CSV file with their line numbers; ``fix`` is what to do if it cannot be read."""
    try:
        if path.stat().st_size > _MAX_TABLE_BYTES:
            raise ImportRejected(f"{path} is larger than {_MAX_TABLE_BYTES} bytes.", next_step="Split it.")
        with path.open(encoding="utf-8-sig", newline="") as file:
            rows = csv.DictReader(file, strict=True)
            if missing := [name for name in needed if name not in (rows.fieldnames or ())]:
                raise ImportRejected(
                    f"{path} has no column {' or '.join(missing)}.",
                    next_step=f"Write the names of the columns into the first line: {', '.join(needed)}.",
                    evidence={"columns": list(rows.fieldnames or ())},
                )
            for row in rows:
                yield rows.line_num, {key: text for key, text in row.items() if key and text}
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ImportRejected(f"{path} cannot be read: {error}.", next_step=fix) from error


def _about(path: Path) -> dict[str, tuple[_Row, Any]]:
    """Return the row and the region for each of obj1, obj2, ..., from the file of an export."""
    if not path.is_file():
        return {}
    fix = "Fix or remove it; without it, objects get the names of their files."
    try:
        return {
            row["object"]: ({**row, "object": row["name"]}, parse_region(row.get("region", "")))
            for _, row in _rows(path, (), fix)
            if "object" in row and "name" in row
        }
    except ValueError as error:
        raise ImportRejected(f"{path} cannot be read: {error}.", next_step=fix) from error


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


def _natural(name: str) -> list[tuple[int, int, str]]:
    """Sort key that puts obj2 before obj10."""
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in re.split(r"([0-9]+)", name) if part]


def _number(text: str, name: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = float("nan")
    if not abs(number) < 1e9:
        raise ValueError(f"{name} is {text!r}, not an angle in degrees")
    return number


def _gaps(azimuths_deg: Mapping[float, object]) -> list[float]:
    ring = sorted(azimuths_deg)
    if len(ring) < 2:
        return []
    steps = sorted((after - before) % 360 for before, after in zip(ring, [*ring[1:], ring[0]], strict=True))
    step_deg = steps[(len(steps) - 1) // 2]
    slots = round(360 / step_deg) if step_deg else 0
    if slots < 4 or abs(360 / slots - step_deg) > 0.1 * step_deg:
        return []  # no even steps
    step_deg = 360 / slots
    start_deg = ring[0] % step_deg
    seen = {round((azimuth_deg - start_deg) / step_deg) % slots for azimuth_deg in ring}
    if 2 * len(seen) <= slots:
        return []  # seen from one side only, for example within the limits of a table that pans
    return [math.fmod(start_deg + slot * step_deg, 360.0) for slot in range(slots) if slot not in seen]
