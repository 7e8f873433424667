"""Photographs with known angles, as the source of an import: a folder, or a CSV table with one row per view.

In a folder the names of the files tell object and angle, such as ``obj12__355.png`` in COIL-100.
"""

import csv
import math
import re
import secrets
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final, NamedTuple

from hbr.core.angles import wrap360
from rig.catalog.exchange.tables import ANGLES, NAMES, parse_region
from rig.catalog.facts import Enrollment, Session, View
from rig.catalog.records import EnrollmentStatus, Provenance, check_azimuth, clean_name, this_software
from rig.catalog.state import EnrollmentState
from rig.catalog.transfer import Gap, ImportProblem, Item, Reason, RejectedFile
from rig.core.errors import ImportRejected, UsageError
from rig.core.next_steps import Do
from rig.views.image_files import read_file

DEFAULT_PATTERN: Final = "{object}__{angle}"
_SUFFIXES: Final = {".png", ".jpg", ".jpeg"}
_PARTS: Final = {"{object}": r"(?P<object>[^/]+?)", "{angle}": r"(?P<angle>[-+]?[0-9]+(?:\.[0-9]+)?)", "*": r"[^/]*?"}
_NEEDED: Final = ("object", "azimuth_deg", "image")
_MAX_TABLE_BYTES: Final = 1_000_000_000


class Photograph(NamedTuple):
    """An image file of an object at an azimuth. ``values`` are other fields of `View`."""

    path: Path
    name: str
    azimuth_deg: float
    values: Mapping[str, Any] = {}
    label: str = ""
    note: str = ""
    bench: str = ""
    software: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Photographs:
    """Objects that are imported from image files: a `rig.catalog.transfer.Source`.

    The name of an image is the path of its file. A file is not read before it is transferred.

    Attributes
    ----------
    origin
        The folder or the table.
    rejected
        What cannot be used, and why.
    """

    origin: str
    objects: tuple[Item, ...]
    rejected: tuple[RejectedFile, ...]

    def items(self) -> Iterator[Item]:
        """Yield the objects in the order of the folder or the table."""
        yield from self.objects

    def content(self, image: str) -> bytes:
        """Return the bytes of an image file; an `OSError` if it cannot be read."""
        return read_file(Path(image))

    @property
    def gaps(self) -> tuple[Gap, ...]:
        """The missing views of objects that are seen from most sides at even steps; each object has its own step."""
        return tuple(Gap(item.name, azimuth_deg) for item in self.objects for azimuth_deg in _gaps(item))


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
    real = folder.resolve()
    inside: dict[Path, bool] = {}
    names = _names(folder / NAMES)
    photographs: list[tuple[str, Photograph]] = []
    rejected = []
    for path in sorted(folder.glob("/".join("*" * (pattern.count("/") + 1)))):
        if path.suffix.lower() not in _SUFFIXES:
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
            about = names.get(found["object"], {"name": found["object"]})
            photographs.append((found["object"], Photograph(path=path, azimuth_deg=azimuth_deg, **about)))
    if not photographs:
        raise ImportRejected(
            f"No photograph in {folder} matches the pattern {pattern}.png.",
            next_step=("Give the pattern of their names.", Do.RUN_AGAIN(pattern="{object}/{angle}")),
            evidence={"rejected": [f"{file.path} {file.reason}" for file in rejected[:5]]},
        )
    in_order = [photograph for _, photograph in sorted(photographs, key=lambda pair: _natural(pair[0]))]
    return _assembled(str(folder), in_order, rejected, now)


def read_table(path: Path, *, now: datetime) -> Photographs:
    """Read a CSV file with one row per view: ``object``, ``azimuth_deg``, ``image`` (a relative path) and more.

    Unknown columns are ignored. A row that cannot be used is rejected; the others are imported.

    Raises
    ------
    ImportRejected
        The file is not such a table.
    """
    folder = path.parent.resolve()
    photographs, rejected = [], []
    for line, row in _rows(path, _NEEDED, "Save it as CSV in UTF-8."):
        try:
            photographs.append(_photograph({key: text.strip() for key, text in row.items()}, folder))
        except ValueError as error:
            reason = Reason(ImportProblem.INVALID_VALUE, {"error": str(error)})
            rejected.append(RejectedFile(f"{path.name}, line {line}", reason))
    if not photographs:
        raise ImportRejected(
            f"{path} has no row that can be used.",
            next_step="Fix the listed rows." if rejected else "Add one row per view.",
            evidence={"rejected": [f"{file.path}: {file.reason}" for file in rejected[:5]]},
        )
    return _assembled(str(path), photographs, rejected, now)


# Folders


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
    if not path.is_file():
        return {}
    fix = "Fix or remove it; without it, objects get the names of their files."
    try:
        return {
            row["object"]: {
                **{key: row.get(key, "") for key in ("name", "label", "note")},
                "values": {"region": parse_region(row.get("region", ""))},
            }
            for _, row in _rows(path, (), fix)
            if row.get("object") and row.get("name")
        }
    except ValueError as error:
        raise ImportRejected(f"{path} cannot be read: {error}.", next_step=fix) from error


def _natural(name: str) -> list[tuple[int, int, str]]:
    """Sort key that puts obj2 before obj10."""
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in re.split(r"([0-9]+)", name) if part]


# Tables


def _rows(path: Path, needed: Sequence[str], fix: str) -> Iterator[tuple[int, dict[str, str]]]:
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


def _photograph(row: Mapping[str, str], folder: Path) -> Photograph:
    """Return the photograph of a row. ValueError says why a row cannot be used."""
    if missing := [name for name in _NEEDED if not row.get(name)]:
        raise ValueError(f"{' and '.join(missing)} missing")
    path = folder / row["image"]
    if not path.resolve().is_relative_to(folder):
        raise ValueError(f"the image {row['image']} is not in the folder of the table")
    if not path.is_file():
        raise ValueError(f"there is no image {row['image']}")
    values: dict[str, Any] = {name: _number(row[name], name) for name in ANGLES if row.get(name)}
    if (values.get("imu_deg") is None) != (values.get("imu_sigma_deg") is None):
        raise ValueError("imu_deg and imu_sigma_deg: give both or none")
    if row.get("captured_utc"):
        values["captured_utc"] = _time(row["captured_utc"])
    azimuth_deg = _number(row["azimuth_deg"], "azimuth_deg")
    return Photograph(
        path,
        row["object"],
        float(wrap360(azimuth_deg)),
        {**values, "region": parse_region(row.get("region", ""))},
        **{key: row.get(key, "") for key in ("label", "note", "bench", "software")},
    )


def _number(text: str, name: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = float("nan")
    if not abs(number) < 1e9:
        raise ValueError(f"{name} is {text!r}, not an angle in degrees")
    return number


def _time(text: str) -> datetime:
    time = datetime.fromisoformat(text)
    if time.tzinfo is None:
        raise ValueError(f"captured_utc {text} has no time zone")
    try:
        return time.astimezone(UTC)
    except OverflowError as error:
        raise ValueError("a time beyond the calendar") from error


# Both


def _assembled(
    origin: str, photographs: Iterable[Photograph], rejected: Sequence[RejectedFile], now: datetime
) -> Photographs:
    """Return the source of photographs. Each object becomes one complete enrollment with views by ascending azimuth.

    If two photographs show an object from the same azimuth, the second one is rejected.
    """
    by_name: dict[str, dict[float, Photograph]] = {}
    all_rejected = list(rejected)
    for photograph in photographs:
        try:
            name = clean_name(photograph.name)
            check_azimuth(photograph.azimuth_deg)
        except UsageError as error:
            reason = Reason(ImportProblem.INVALID_VALUE, {"error": error.what.rstrip(".")})
            all_rejected.append(RejectedFile(str(photograph.path), reason))
            continue
        taken = by_name.setdefault(name, {})
        if photograph.azimuth_deg in taken:
            other = taken[photograph.azimuth_deg].path.name
            reason = Reason(ImportProblem.SAME_AZIMUTH, {"name": name, "other": other})
            all_rejected.append(RejectedFile(str(photograph.path), reason))
            continue
        taken[photograph.azimuth_deg] = photograph
    objects = [
        _item(name, [taken[azimuth_deg] for azimuth_deg in sorted(taken)], origin, now)
        for name, taken in by_name.items()
    ]
    return Photographs(origin, tuple(objects), tuple(all_rejected))


def _item(name: str, photographs: Sequence[Photograph], origin: str, now: datetime) -> Item:
    taken_with = list(dict.fromkeys((photograph.bench, photograph.software) for photograph in photographs))
    enrollment = Enrollment(
        key=secrets.token_hex(32),
        object_id=0,
        started_utc=now,
        planned_azimuth_deg=tuple(photograph.azimuth_deg for photograph in photographs),
    )
    conditions = {"imported_from": origin}
    for number, (bench, by) in enumerate(taken_with):
        provenance = Provenance(bench, {}, conditions, by or this_software())
        enrollment.sessions.append(Session(number=number, started_utc=now, provenance=provenance))
    for index, photograph in enumerate(photographs):
        view = View(index=index, azimuth_deg=photograph.azimuth_deg, image=str(photograph.path), **photograph.values)
        view.session = taken_with.index((photograph.bench, photograph.software))
        enrollment.views.append(view)
    label, note = (next((text for one in photographs if (text := getattr(one, key))), "") for key in ("label", "note"))
    state = EnrollmentState(enrollment, EnrollmentStatus.COMPLETE, now, None)
    return Item(name=name, label=label, note=note, created_utc=now, enrollments=(state,))


def _gaps(item: Item) -> list[float]:
    ring = sorted(item.enrollments[-1].enrollment.planned_azimuth_deg)
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
