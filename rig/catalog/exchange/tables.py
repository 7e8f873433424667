"""Tables of views and of results for other programs, as CSV, JSON or Parquet, and folders of photographs.

All exports contain the views that searches use: those of the complete enrollments.
"""

import csv
import json
import re
from collections.abc import Iterable, Iterator, Mapping
from datetime import datetime
from enum import StrEnum
from io import TextIOWrapper
from itertools import islice
from pathlib import Path
from types import NoneType
from typing import Any, Final, get_args

import numpy as np

from hbr.descriptors import descriptor
from rig.catalog.describing import described
from rig.catalog.exchange.new_files import new_file, new_folder
from rig.catalog.facts import View
from rig.catalog.images import path_of
from rig.catalog.records import Region
from rig.catalog.results import ResultRow
from rig.catalog.transfer import CatalogSource, TransferItem
from rig.core.errors import ExportFailed, UsageError
from rig.core.next_steps import Do
from rig.views.description import PAPER_DESCRIPTOR

TABLE: Final = "views.csv"
"""The table beside the photographs of an export."""


def _column(annotation: Any) -> type:
    """Return the type of a column of a table from the type of a field."""
    (kind,) = set(get_args(annotation) or [annotation]) - {NoneType}
    return str if issubclass(kind, str) else kind


_ANGLES: Final = ("azimuth_deg", "commanded_deg", "encoder_deg", "imu_deg", "imu_sigma_deg")
VIEWS: Final[Mapping[str, type]] = {
    **dict.fromkeys(("object", "label", "note"), str),
    **dict.fromkeys(_ANGLES, float),
    "captured_utc": datetime,
    **dict.fromkeys(("bench", "software", "devices", "conditions", "evidence"), str),
    **dict.fromkeys(("image", "image_sha256", "region", "descriptor"), str),
    "descriptor_version": int,
    "levels": list,
}
"""Columns of a table of views and their types."""

RESULTS: Final[Mapping[str, type]] = {name: _column(field.annotation) for name, field in ResultRow.model_fields.items()}
"""Columns of a table of results and their types."""

_ROW_GROUP: Final = 10_000
"""Rows of a Parquet table that are in memory at once."""


class TableFormat(StrEnum):
    """Format of a table; its suffix is the same."""

    CSV = "csv"
    JSON = "json"
    PARQUET = "parquet"

    @classmethod
    def of(cls, path: Path) -> "TableFormat":
        """Return the format that the suffix of a file names; a `UsageError` if there is none."""
        try:
            return cls(path.suffix.lower().removeprefix("."))
        except ValueError as error:
            known = ", ".join(f".{one}" for one in cls)
            raise UsageError(f"The format of {path} is unknown.", next_step=f"Give a file with {known}.") from error


def write_folder(folder: Path, source: CatalogSource) -> int:
    """Write copies of the images as ``obj{N}__{azimuth}.png``, as in COIL-100, with a table `TABLE`.

    It returns the number of objects, as for all formats.

    Raises `ExportFailed`: the folder is not empty or cannot be written, or an object has two views from the same
    azimuth.
    """
    items = list(source.items())

    def placed() -> Iterator[dict[str, Any]]:
        for number, item in enumerate(items, 1):
            for row, view in _rows(source, item):
                angle = np.format_float_positional(view.azimuth_deg, trim="-")
                target = made / f"obj{number}__{angle}{Path(view.image).suffix}"
                if target.exists():
                    raise ExportFailed(
                        f"{item.name!r} has two views from {angle}°.", next_step="Export a bundle instead."
                    )
                target.write_bytes(source.catalog.database.images.content(view.image))
                yield {**row, "image": target.name}

    with new_folder(folder) as made:
        write_rows(made / TABLE, TableFormat.CSV, VIEWS, placed())
    return len(items)


def write_views(path: Path, source: CatalogSource, form: TableFormat) -> int:
    """Write the views as a table with their CEDD levels, without their images, and return the number of objects.

    Raises `ExportFailed`: the file exists already or cannot be written, or pyarrow is not installed.
    """
    items = list(source.items())
    write_rows(path, form, VIEWS, (row for item in items for row, _ in _rows(source, item)))
    return len(items)


def write_rows(path: Path, form: TableFormat, columns: Mapping[str, type], rows: Iterable[dict[str, Any]]) -> None:
    """Write rows into a new file; errors as for `write_views`."""
    if form is TableFormat.PARQUET:
        _write_parquet(path, columns, iter(rows))
        return
    with new_file(path) as file:
        text = TextIOWrapper(file, encoding="utf-8", newline="")
        if form is TableFormat.JSON:
            text.write(json.dumps([plain_row(row) for row in rows], ensure_ascii=False, indent=1, allow_nan=False))
            text.write("\n")
        else:
            table = csv.DictWriter(text, list(columns), lineterminator="\n")
            table.writeheader()
            for row in rows:
                cells = plain_row(row)
                table.writerow({k: " ".join(map(str, v)) if isinstance(v, list) else v for k, v in cells.items()})
        text.detach()  # flushes


def _write_parquet(path: Path, columns: Mapping[str, type], rows: Iterator[dict[str, Any]]) -> None:
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError as error:
        raise ExportFailed(
            "Parquet needs pyarrow, which is not installed.", next_step=Do.INSTALL_EXTRA(extra="parquet")
        ) from error
    kinds = {
        int: pa.int64(),
        float: pa.float64(),
        str: pa.string(),
        datetime: pa.timestamp("us", "UTC"),
        list: pa.list_(pa.uint8()),
    }
    schema = pa.schema([(name, kinds[kind]) for name, kind in columns.items()])
    with new_file(path) as file, pq.ParquetWriter(file, schema) as writer:
        while part := list(islice(rows, _ROW_GROUP)):
            writer.write_table(pa.Table.from_pylist(part, schema))


def plain_row(row: Mapping[str, Any]) -> dict[str, Any]:
    """Return a row as JSON values."""
    return {key: value.isoformat() if isinstance(value, datetime) else value for key, value in row.items()}


def parse_region(text: str) -> Region | None:
    """Parse a region of a table: x y width height, empty for the whole image. ValueError if it is none."""
    if not text.strip():
        return None
    numbers = re.split(r"[ ,]+", text.strip())
    if len(numbers) != 4 or not all(re.fullmatch("[0-9]{1,6}", number) for number in numbers):
        raise ValueError(f"the region {text!r} is not of the form x y width height, in pixels")
    x, y, width, height = map(int, numbers)
    return x, y, width, height


def _rows(source: CatalogSource, item: TransferItem) -> Iterator[tuple[dict[str, Any], View]]:
    """Yield the views of an object, each with its row: the columns `VIEWS`."""
    kind = descriptor(PAPER_DESCRIPTOR)
    enrollment = item.enrollment
    levels_of = described(source.catalog.database, enrollment, item.name, kind.name).levels[kind.name]
    for view, levels in zip(enrollment.views, levels_of, strict=True):
        by = enrollment.sessions[view.session].provenance
        row = {
            "object": item.name,
            "label": item.label,
            "note": item.note,
            **{name: getattr(view, name) for name in (*_ANGLES, "captured_utc")},
            "bench": by.bench,
            "software": by.software,
            "devices": json.dumps(by.devices, ensure_ascii=False),
            "conditions": json.dumps(by.conditions, ensure_ascii=False),
            "evidence": json.dumps(view.evidence, ensure_ascii=False),
            "image": path_of(view.image),
            "image_sha256": Path(view.image).stem,
            "region": "" if view.region is None else " ".join(map(str, view.region)),
            "descriptor": kind.name,
            "descriptor_version": kind.version,
            "levels": levels.tolist(),
        }
        yield row, view
