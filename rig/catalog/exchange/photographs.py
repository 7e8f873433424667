"""Photographs with known angles, as the source of an import: a folder, or a CSV table with one row per view.

In a folder the names of the files tell object and angle, such as ``obj12__355.png`` in COIL-100.
"""

import csv
import re
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime
from operator import itemgetter
from pathlib import Path
from typing import Final
from unicodedata import normalize

from hbr.core.angles import wrap360
from rig.catalog.exchange.tables import TABLE, parse_region
from rig.catalog.facts import Enrollment, Session, View
from rig.catalog.incoming import ImportProblem, RejectedFile
from rig.catalog.records import Provenance, check_text, clean_name
from rig.catalog.transfer import TransferItem
from rig.core.errors import ImportRejected, UsageError
from rig.core.next_steps import Do, NextStep
from rig.core.phrases import counted
from rig.views.image_files import BadImage, Header, decode, header, read_file

DEFAULT_PATTERN: Final = "{object}__{angle}"

_SUFFIXES: Final = {".png", ".jpg", ".jpeg"}
_PARTS: Final = {"{object}": r"(?P<object>[^/]+?)", "{angle}": r"(?P<angle>[-+]?[0-9]+(?:\.[0-9]+)?)", "*": r"[^/]*?"}
_NEEDED: Final = ("object", "azimuth_deg", "image")

_Row = Mapping[str, str]


@dataclass(eq=False)
class Photographs:
    """Objects that are imported from image files: a `rig.catalog.transfer.TransferSource`.

    The name of an image is the path of its file. A file is not read before it is transferred. Each object has one
    complete enrollment, with views by ascending azimuth.
    """

    origin: str
    """The folder or the table."""
    folder: Path
    """The folder that contains all files."""
    now: datetime
    """Time of the enrollments."""
    rejected: list[RejectedFile] = field(default_factory=list)
    """What cannot be used, and why."""
    _found: dict[str, dict[float, tuple[View, _Row]]] = field(default_factory=dict)
    _empty_tables: dict[tuple[str, float], str] = field(default_factory=dict)

    def add(self, row: _Row, view: View) -> None:
        """Add a view of the object of a row, if its name and texts can be stored, and no view has its azimuth."""
        try:
            name = clean_name(row["object"])
            for what in ("label", "note"):
                check_text(row.get(what, ""), what)
        except UsageError as error:
            self.reject(view.image, ImportProblem.INVALID_VALUE, error.what.rstrip("."))
            return
        views = self._found.setdefault(name, {})
        if view.azimuth_deg in views:
            other = Path(views[view.azimuth_deg][0].image).name
            self.reject(view.image, ImportProblem.SAME_AZIMUTH, f"shows {name!r} from the same azimuth as {other}")
            return
        views[view.azimuth_deg] = view, row

    def reject(self, path: str, code: ImportProblem, reason: str) -> None:
        self.rejected.append(RejectedFile(path, code, reason))

    def contains(self, path: Path) -> bool:
        """Return whether a file is really within the folder, where links lead."""
        return path.resolve().is_relative_to(self.folder)

    def nothing(self, what: str, *fix: str | NextStep) -> ImportRejected:
        """Return the error that nothing can be used."""
        shown = [str(file) for file in self.rejected[:5]]
        return ImportRejected(what, next_step=fix, evidence={"rejected": shown})

    @property
    def are_whole(self) -> bool:
        """Whether a whole photograph is described, and not only its region in a table."""
        return any(view.region is None for _, _, view in self.views())

    def use_empty_tables(self, path: Path, *, table_angles: bool = False) -> None:
        """Import the photographs with an image of the empty table, or with the images in a folder.

        In a folder the name of an image tells which photographs it is for: the name of an object, or an angle in
        degrees. The angles are those of `read_folder`.

        Raises `ImportRejected`: a photograph has no such image, or the image cannot be used with it.
        """
        if path.is_dir():
            named = [one for one in sorted(path.iterdir()) if one.suffix.lower() in _SUFFIXES]
            by_stem = {normalize("NFC", one.stem): str(one) for one in named}
            by_azimuth = {
                wrap360(-float(stem) if table_angles else float(stem)): image
                for stem, image in by_stem.items()
                if re.fullmatch(_PARTS["{angle}"], stem)
            }
            for name, azimuth_deg, _ in self.views():
                if image := by_stem.get(name) or by_azimuth.get(azimuth_deg):
                    self._empty_tables[name, azimuth_deg] = image
        else:
            self._empty_tables = {(name, azimuth_deg): str(path) for name, azimuth_deg, _ in self.views()}
        if missing := [view.image for *place, view in self.views() if tuple(place) not in self._empty_tables]:
            raise ImportRejected(
                f"{path} has no empty-table image for {counted(len(missing), 'photograph')}; nothing was imported.",
                next_step="Name each image by its object (mug.png) or by its angle (90.png), or give one image for all "
                "photographs.",
                evidence={"photographs": missing[:5]},
            )
        self._check_empty_tables()

    def _check_empty_tables(self) -> None:
        tables = {image: self._table_header(image) for image in dict.fromkeys(self._empty_tables.values())}
        for name, azimuth_deg, view in self.views():
            image = self._empty_tables[name, azimuth_deg]
            with suppress(OSError):  # it is rejected later, like one that is damaged
                shown, table = header(self.content(view.image)), tables[image]
                if shown is not None and shown[:2] != table[:2]:
                    raise ImportRejected(
                        f"The empty-table image {image} has {table.width} x {table.height} pixels, but {view.image} "
                        f"has {shown.width} x {shown.height}; nothing was imported.",
                        next_step="Take it with the same camera and settings as the photographs, and do not crop it.",
                    )
                if shown is not None and shown.is_coloured and not table.is_coloured:
                    raise ImportRejected(
                        f"The empty-table image {image} is grey, but {view.image} has colours; nothing was imported.",
                        next_step="Take it in colour, with the same camera and settings as the photographs.",
                    )

    @staticmethod
    def _table_header(image: str) -> Header:
        try:
            content = read_file(Path(image))
            decode(content)
        except (OSError, BadImage) as error:
            raise ImportRejected(
                f"The empty-table image {image} cannot be used: {error}; nothing was imported.",
                next_step="Check the path. Save the image as PNG or JPEG.",
            ) from error
        found = header(content)
        assert found is not None  # it was decoded
        return found

    def views(self) -> Iterator[tuple[str, float, View]]:
        """Yield the name of the object, the azimuth and the view of each photograph, object by object."""
        for name, found in self._found.items():
            for azimuth_deg, (view, _) in found.items():
                yield name, azimuth_deg, view

    def empty_table(self, name: str, azimuth_deg: float) -> str | None:
        """Return the path of the empty-table image for a photograph, if there is one."""
        return self._empty_tables.get((name, azimuth_deg))

    @staticmethod
    def content(image: str) -> bytes:
        """Return the bytes of an image file; an `OSError` if it cannot be read."""
        return read_file(Path(image))

    def items(self) -> Iterator[TransferItem]:
        """Yield the objects in the order of the folder or the table."""
        for name, found in self._found.items():
            enrollment = Enrollment(  # the transfer replaces the key by a digest of the images
                key=name, object_id=0, started_utc=self.now, planned_azimuth_deg=tuple(sorted(found))
            )
            sessions: dict[str | None, Session] = {}
            texts = {"label": "", "note": ""}
            for index, (azimuth_deg, (view, row)) in enumerate(sorted(found.items(), key=itemgetter(0))):
                table = self.empty_table(name, azimuth_deg)
                if table not in sessions:
                    sessions[table] = Session(
                        number=len(sessions),
                        started_utc=self.now,
                        provenance=Provenance("", {}, {"imported_from": self.origin}),
                        empty_table=table,
                    )
                view.index, view.session = index, sessions[table].number
                enrollment.views.append(view)
                texts = {key: text or row.get(key, "") for key, text in texts.items()}
            enrollment.sessions.extend(sessions.values())
            yield TransferItem(name, **texts, created_utc=self.now, enrollment=enrollment, finished_utc=self.now)


def read_photographs(
    source: Path, *, pattern: str | None = None, table_angles: bool = False, now: datetime
) -> Photographs:
    """Find the photographs of a table (.csv), of the folder of an export with its table, or of another folder.

    Raises `UsageError`, `ImportRejected` as `read_folder`, whose parameters these are, and `read_table`.
    """
    if pattern is None and not table_angles and (source / TABLE).is_file():
        source = source / TABLE
    if source.suffix.lower() == ".csv" and not source.is_dir():
        return read_table(source, now=now)
    return read_folder(source, pattern=pattern or DEFAULT_PATTERN, table_angles=table_angles, now=now)


def read_folder(
    folder: Path, *, pattern: str = DEFAULT_PATTERN, table_angles: bool = False, now: datetime
) -> Photographs:
    """Find the photographs of a folder.

    The pattern is a path without suffix: ``{object}`` and ``{angle}`` (in degrees) once each, ``*`` for any other text.
    One with slashes also looks into the subfolders. ``table_angles`` are those of the table under a fixed camera:
    azimuths run in the opposite direction. ``now`` is the time of the enrollments.

    Raises `UsageError`: the pattern does not contain ``{object}`` and ``{angle}`` once each. `ImportRejected`: there is
    no such folder, or no photograph in it.
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
            photographs.reject(str(shown), ImportProblem.NOT_A_FILE, "is not a file")
        elif not photographs.contains(path):
            photographs.reject(str(shown), ImportProblem.LINK_OUTSIDE, "is a link to a file outside the folder")
        elif (found := named.fullmatch(shown.with_suffix("").as_posix())) is None:
            photographs.reject(str(shown), ImportProblem.NAME_PATTERN, f"does not match the pattern {pattern}")
        else:
            matches.append((found["object"], float(found["angle"]), path))
    if not matches:
        raise photographs.nothing(
            f"No photograph in {folder} matches the pattern {pattern}.png.",
            *("Give the pattern of their names.", Do.RUN_AGAIN(pattern="{object}/{angle}")),
        )
    for key, angle_deg, path in sorted(matches, key=lambda match: _natural(match[0])):
        azimuth_deg = wrap360(-angle_deg if table_angles else angle_deg)
        photographs.add({"object": key}, View(index=0, azimuth_deg=azimuth_deg, image=str(path)))
    return photographs


def read_table(path: Path, *, now: datetime) -> Photographs:
    """Read a CSV file with one row per view: ``object``, ``azimuth_deg``, ``image`` (a relative path).

    ``label``, ``note`` and ``region`` are used if they are there, and other columns are ignored. A row that cannot be
    used is rejected; the others are imported.

    Raises `ImportRejected`: the file is not such a table.
    """
    photographs = Photographs(str(path), path.parent.resolve(), now)
    used = 0
    for line, row in _rows(path):
        try:
            photographs.add(row, _view(photographs, row))
            used += 1
        except (ValueError, OverflowError, OSError) as error:
            photographs.reject(f"{path.name}, line {line}", ImportProblem.INVALID_VALUE, str(error))
    if not used:
        raise photographs.nothing(f"{path} has no row that can be used.", "Fix the listed rows, or add one per view.")
    return photographs


def _rows(path: Path) -> Iterator[tuple[int, _Row]]:
    """Yield the rows of a CSV file with their line numbers, without empty cells."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            rows = csv.DictReader(file, strict=True)
            if missing := [name for name in _NEEDED if name not in (rows.fieldnames or ())]:
                raise ImportRejected(
                    f"{path} has no column {' or '.join(missing)}.",
                    next_step=f"Write the names of the columns into the first line: {', '.join(_NEEDED)}.",
                    evidence={"columns": list(rows.fieldnames or ())},
                )
            for row in rows:
                yield rows.line_num, {key: text.strip() for key, text in row.items() if key and text}
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ImportRejected(f"{path} cannot be read: {error}.", next_step="Save it as CSV in UTF-8.") from error


def _view(photographs: Photographs, row: _Row) -> View:
    """Return the view of a row. ValueError says why a row cannot be used."""
    if missing := [name for name in _NEEDED if not row.get(name)]:
        raise ValueError(f"{' and '.join(missing)} missing")
    path = photographs.folder / row["image"]
    if not photographs.contains(path):
        raise ValueError(f"the image {row['image']} is not in the folder of the table")
    if not path.is_file():
        raise ValueError(f"there is no image {row['image']}")
    azimuth_deg = wrap360(_number(row["azimuth_deg"], "azimuth_deg"))
    view = View(index=0, azimuth_deg=azimuth_deg, image=str(path), region=parse_region(row.get("region", "")))
    if view.problem:
        raise ValueError(view.problem)
    return view


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
