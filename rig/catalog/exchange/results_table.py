"""Results as a table: CSV, JSON, or Parquet."""

import csv
import io
import json
from collections.abc import Sequence
from datetime import datetime
from enum import StrEnum
from pathlib import Path
from typing import Any

from rig.catalog.exchange.bundle import new_file
from rig.catalog.exchange.table import pyarrow
from rig.catalog.results import Result


class TableFormat(StrEnum):
    """Format of a table of results; its suffix is the same."""

    CSV = "csv"
    JSON = "json"
    PARQUET = "parquet"


def write_results(path: Path, results: Sequence[Result], form: TableFormat) -> None:
    """Write results as one table into a new file.

    Raises
    ------
    ExportFailed
        The file exists already or cannot be written, or pyarrow is not installed.
    """
    if form is TableFormat.PARQUET:
        pa, pq = pyarrow()
        kinds = {int: pa.int64(), float: pa.float64(), str: pa.string(), datetime: pa.timestamp("us", "UTC")}
        schema = pa.schema([(name, kinds[kind]) for name, kind in COLUMNS.items()])
        with new_file(path) as file:
            pq.write_table(pa.Table.from_pylist([result.as_row() for result in results], schema), file)
        return
    plain = [plain_row(result) for result in results]
    if form is TableFormat.JSON:
        text = json.dumps(plain, ensure_ascii=False, indent=1, allow_nan=False) + "\n"
    else:
        lines = io.StringIO(newline="")
        table = csv.DictWriter(lines, list(COLUMNS), lineterminator="\n")
        table.writeheader()
        table.writerows(plain)
        text = lines.getvalue()
    with new_file(path) as file:
        file.write(text.encode())


def plain_row(result: Result) -> dict[str, Any]:
    """Return a result as a row of JSON values."""
    return {k: v.isoformat() if isinstance(v, datetime) else v for k, v in result.as_row().items()}


COLUMNS: dict[str, type] = {
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
