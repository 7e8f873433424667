"""Tables of views and of results, and folders of photographs, for other programs.

All formats contain the views that searches use: those of the complete enrollments.
"""

import csv
import json
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from datetime import datetime
from enum import StrEnum
from io import TextIOWrapper
from pathlib import Path
from typing import IO, Any, Final, NamedTuple

import numpy as np

from hbr.descriptors import descriptor
from rig.catalog.derived import described, regions_of
from rig.catalog.exchange.new_files import new_document, new_file, new_folder
from rig.catalog.facts import Enrollment, View
from rig.catalog.images import path_of
from rig.catalog.records import EnrollmentStatus, Region
from rig.catalog.results import Result
from rig.catalog.transfer import CatalogSource, Item
from rig.core.errors import ExportFailed
from rig.core.next_steps import Do
from rig.views.description import PAPER_DESCRIPTOR
from rig.views.image_files import IMAGE_FOLDER

TABLE: Final = "views.csv"
NAMES: Final = "objects.csv"
"""File with the names of obj1, obj2, ..., beside the photographs of an export."""

ANGLES: Final = ("commanded_deg", "encoder_deg", "imu_deg", "imu_sigma_deg")
"""Columns that a photograph of another program does not have."""
_CSV: Final = (
    *("object", "label", "note", "azimuth_deg", "image", *ANGLES, "captured_utc", "bench", "software"),
    *("image_sha256", "region", "descriptor", "descriptor_version", "packed"),
)
_PARQUET: Final[Mapping[str, type]] = {
    **dict.fromkeys(("object", "label", "note"), str),
    **dict.fromkeys(("azimuth_deg", *ANGLES), float),
    "captured_utc": datetime,
    **dict.fromkeys(("bench", "software", "devices", "conditions", "evidence", "image", "image_sha256"), str),
    "descriptor": str,
    "descriptor_version": np.int32,
    "levels": np.ndarray,
}
"""Columns of the table of views in each format; with types where the format has some."""

RESULTS: Final[Mapping[str, type]] = {
    "result": int,
    "time_utc": datetime,
    **dict.fromkeys(("sample", "outcome", "object"), str),
    **dict.fromkeys(("yaw_deg", "yaw_sigma_deg", "period_deg", "confidence", "score", "margin"), float),
    "views": int,
    **dict.fromkeys(("operator", "user", "host", "bench", "software", "catalog_version", "image", "image_sha256"), str),
    **dict.fromkeys(("answered_sample", "answered_outcome", "answered_object"), str),
    "corrections": int,
    "corrected_utc": datetime,
    **dict.fromkeys(("corrected_by", "correction_reason"), str),
}
"""Columns of `Result.as_row` and their types."""


class TableFormat(StrEnum):
    """Format of a table of results; its suffix is the same."""

    CSV = "csv"
    JSON = "json"
    PARQUET = "parquet"


class Enrolled(NamedTuple):
    """An object and its complete enrollment, with the part of the image that is described of each view."""

    item: Item
    enrollment: Enrollment
    regions: tuple[Region | None, ...]


def enrolled(source: CatalogSource) -> Iterator[Enrolled]:
    """Yield the objects that are completely enrolled, with the enrollment that searches use."""
    for item in source.items():
        for one in item.enrollments:
            if one.status is EnrollmentStatus.COMPLETE:
                yield Enrolled(item, one.enrollment, regions_of(source.catalog, one.enrollment))


def write_folder(folder: Path, source: CatalogSource) -> int:
    """Write the views as ``obj{N}__{azimuth}.png``, and the names of the objects in ``objects.csv``.

    The files are copies of the stored ones, and the azimuths are exact.

    Returns
    -------
    Number of objects, as for all formats.

    Raises
    ------
    ExportFailed
        The folder is not empty or cannot be written, or an object has two views from the same azimuth.
    CatalogError
        An image is not the stored one.
    """
    count = 0
    with (
        new_folder(folder) as made,
        (made / NAMES).open("wb") as file,
        _csv(file, ("object", "name", "label", "note", "region")) as rows,
    ):
        for count, (item, enrollment, regions) in enumerate(enrolled(source), 1):
            about = {"name": item.name, "label": item.label, "note": item.note, "region": region_text(regions[0])}
            rows.writerow({"object": f"obj{count}", **about})
            for view in enrollment.views:
                angle = np.format_float_positional(view.azimuth_deg, trim="-")
                target = made / f"obj{count}__{angle}{Path(view.image).suffix}"
                if target.exists():
                    raise ExportFailed(
                        f"{item.name!r} has two views from {angle}°.", next_step="Export a bundle instead."
                    )
                target.write_bytes(source.content(view.image))
    return count


def write_table(target: Path, source: CatalogSource) -> int:
    """Write the views as a CSV file, with copies of their images.

    ``target`` is the file (suffix ``.csv``; the images are in a folder beside it), or a folder for ``views.csv`` and
    the images. Errors are those of `write_folder`.
    """
    count = 0
    with new_document(target, TABLE, IMAGE_FOLDER) as (file, images, link), _csv(file, _CSV) as table:
        for rows in _rows(source):
            count += 1
            for row, view in rows:
                within = Path(row["image"]).relative_to(IMAGE_FOLDER)
                (images / within).parent.mkdir(exist_ok=True)
                (images / within).write_bytes(source.content(view.image))
                table.writerow({**row, "image": Path(link, within).as_posix()})
    return count


def write_parquet(path: Path, source: CatalogSource) -> int:
    """Write the views as a Parquet table, with their CEDD levels, without their images.

    Raises
    ------
    ExportFailed
        The file exists already or cannot be written, or pyarrow is not installed.
    """
    return _write_parquet(path, _PARQUET, ([row for row, _ in rows] for rows in _rows(source)))


def write_results(path: Path, results: Iterable[Result], form: TableFormat) -> None:
    """Write results as one table into a new file; errors as for `write_parquet`."""
    if form is TableFormat.PARQUET:
        _write_parquet(path, RESULTS, [[result.as_row() for result in results]])
        return
    plain = [plain_row(result) for result in results]
    with new_file(path) as file:
        if form is TableFormat.JSON:
            file.write((json.dumps(plain, ensure_ascii=False, indent=1, allow_nan=False) + "\n").encode())
            return
        with _csv(file, RESULTS) as rows:
            rows.writerows(plain)


def region_text(region: Region | None) -> str:
    """Return a region as text for a table: x y width height; empty for the whole image."""
    return "" if region is None else " ".join(map(str, region))


def parse_region(text: str) -> Region | None:
    """Parse the text of `region_text`. ValueError if it is not a region."""
    if not text.strip():
        return None
    numbers = re.split(r"[ ,]+", text.strip())
    if len(numbers) != 4 or not all(re.fullmatch("[0-9]{1,6}", number) for number in numbers):
        raise ValueError(f"the region {text!r} is not of the form x y width height, in pixels")
    x, y, width, height = map(int, numbers)
    return x, y, width, height


def plain_row(result: Result) -> dict[str, Any]:
    """Return a result as a row of JSON values."""
    return {k: v.isoformat() if isinstance(v, datetime) else v for k, v in result.as_row().items()}


def _rows(source: CatalogSource) -> Iterator[list[tuple[dict[str, Any], View]]]:
    """Yield the rows of each object, with all columns of both formats, and their views."""
    kind = descriptor(PAPER_DESCRIPTOR)
    for item, enrollment, regions in enrolled(source):
        levels_of = described(source.catalog, enrollment, item.name, kind.name).levels[kind.name]
        rows = []
        for view, region, levels in zip(enrollment.views, regions, levels_of, strict=True):
            by = enrollment.sessions[view.session].provenance
            row = {
                "object": item.name,
                "label": item.label,
                "note": item.note,
                **{name: getattr(view, name) for name in ("azimuth_deg", *ANGLES, "captured_utc")},
                "image": path_of(view.image),
                "image_sha256": Path(view.image).stem,
                "bench": by.bench,
                "software": by.software,
                "devices": json.dumps(by.devices, ensure_ascii=False),
                "conditions": json.dumps(by.conditions, ensure_ascii=False),
                "evidence": json.dumps(view.evidence, ensure_ascii=False),
                "region": region_text(region),
                "descriptor": kind.name,
                "descriptor_version": kind.version,
                "packed": kind.pack(levels).hex(),
                "levels": levels,
            }
            rows.append((row, view))
        yield rows


@contextmanager
def _csv(file: IO[bytes], columns: Iterable[str]) -> Iterator["csv.DictWriter[str]"]:
    """Yield a writer of the rows of a CSV table with these columns; a row may have others."""
    text = TextIOWrapper(file, encoding="utf-8", newline="")
    rows = csv.DictWriter(text, list(columns), lineterminator="\n", extrasaction="ignore")
    rows.writeheader()
    yield rows
    text.detach()  # flushes; the caller closes the file


def _write_parquet(path: Path, columns: Mapping[str, type], portions: Iterable[list[dict[str, Any]]]) -> int:
    """Write rows as a Parquet table in portions, and return the number of portions; a row may have other columns."""
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError as error:
        raise ExportFailed(
            "Parquet needs pyarrow, which is not installed.", next_step=Do.INSTALL_EXTRA(extra="parquet")
        ) from error
    kinds = {
        int: pa.int64(),
        np.int32: pa.int32(),
        float: pa.float64(),
        str: pa.string(),
        datetime: pa.timestamp("us", "UTC"),
        np.ndarray: pa.list_(pa.uint8()),
    }
    schema = pa.schema([(name, kinds[kind]) for name, kind in columns.items()])
    count = 0
    with new_file(path) as file, pq.ParquetWriter(file, schema) as writer:
        for rows in portions:
            count += 1
            writer.write_table(pa.Table.from_pylist(rows, schema))
    return count
