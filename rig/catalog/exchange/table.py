"""Views as rows of a table: a CSV file with the images beside it, or a Parquet file."""

import csv
import json
from collections.abc import Iterable, Iterator, Mapping
from datetime import datetime
from io import TextIOWrapper
from pathlib import Path
from typing import IO, Any, Final

from hbr.core.angles import wrap360
from hbr.descriptors import descriptor
from rig.catalog.exchange.batch import (
    Enrollment,
    ExportedObject,
    ImportBatch,
    ImportProblem,
    Object,
    Reason,
    RejectedFile,
    View,
    in_utc,
    parse_region,
    region_of_view,
    region_text,
)
from rig.catalog.exchange.bundle import new_file, read_stored
from rig.catalog.exchange.new_folder import new_folder
from rig.catalog.exchange.photographs import Photograph, assemble
from rig.catalog.records import EnrollmentStatus, this_software
from rig.core.errors import ExportFailed, ImportRejected
from rig.core.next_steps import Do
from rig.views.description import PAPER_DESCRIPTOR
from rig.views.image_files import IMAGE_FOLDER

TABLE: Final = "views.csv"
_NUMBERS: Final = ("commanded_deg", "encoder_deg", "imu_deg", "imu_sigma_deg")
_NEEDED: Final = ("object", "azimuth_deg", "image")
_COLUMNS: Final = (
    *("object", "label", "note", "azimuth_deg", "image"),
    *_NUMBERS,
    *("captured_utc", "bench", "software", "image_sha256", "region", "descriptor", "descriptor_version", "packed"),
)
_MAX_BYTES: Final = 1_000_000_000


def read_table(path: Path, *, now: datetime) -> ImportBatch:
    """Read a CSV file with one row per view: ``object``, ``azimuth_deg``, ``image`` (a relative path) and more.

    Unknown columns are ignored. A row that cannot be used is rejected; the others are imported.

    Raises
    ------
    ImportRejected
        The file is not such a table.
    """
    folder = path.parent.resolve()
    photographs, rejected = [], []
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise ImportRejected(f"{path} is larger than {_MAX_BYTES} bytes.", next_step="Split it.")
        with path.open(encoding="utf-8-sig", newline="") as file:
            rows = csv.DictReader(file, strict=True)
            if missing := [name for name in _NEEDED if name not in (rows.fieldnames or ())]:
                raise ImportRejected(
                    f"{path} has no column {' or '.join(missing)}.",
                    next_step=f"Write the names of the columns into the first line: {', '.join(_NEEDED)}.",
                    evidence={"columns": list(rows.fieldnames or ())},
                )
            for row in rows:
                try:
                    photographs.append(_photograph(row, folder))
                except ValueError as error:
                    reason = Reason(ImportProblem.INVALID_VALUE, {"error": str(error)})
                    rejected.append(RejectedFile(f"{path.name}, line {rows.line_num}", reason))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ImportRejected(f"{path} cannot be read: {error}.", next_step="Save it as CSV in UTF-8.") from error
    if not photographs:
        raise ImportRejected(
            f"{path} has no row that can be used.",
            next_step="Fix the listed rows." if rejected else "Add one row per view.",
            evidence={"rejected": [f"{file.path}: {file.reason}" for file in rejected[:5]]},
        )
    return assemble(str(path), photographs, rejected, now, this_software())


def write_table(target: Path, objects: Iterable[ExportedObject]) -> int:
    """Write the views that searches use as a CSV file, with copies of their images.

    ``target`` is the file (suffix ``.csv``; the images are in a folder beside it), or a folder for ``views.csv`` and
    the images.

    Raises
    ------
    ExportFailed
        The target exists or cannot be written, or an image is not the stored one.
    """
    if target.suffix.lower() == ".csv":
        images = target.with_name(f"{target.stem}-{IMAGE_FOLDER}")
        with new_file(target) as file, new_folder(images) as made:
            return _write_table(file, made, images.name, objects)
    with new_folder(target) as made, (made / TABLE).open("wb") as file:
        return _write_table(file, made / IMAGE_FOLDER, IMAGE_FOLDER, objects)


def _write_table(file: IO[bytes], images: Path, link: str, objects: Iterable[ExportedObject]) -> int:
    """Write the table to ``file`` and the images into ``images``; ``link`` is its path from the table."""
    count = 0
    text = TextIOWrapper(file, encoding="utf-8", newline="")
    rows = csv.DictWriter(text, _COLUMNS, lineterminator="\n")
    rows.writeheader()
    for item, files in objects:
        count += 1
        for row, view in _rows(item):
            within = Path(view.image).relative_to(IMAGE_FOLDER)
            (images / within).parent.mkdir(parents=True, exist_ok=True)
            (images / within).write_bytes(read_stored(files[view.image], view.image_sha256))
            row["image"] = Path(link, within).as_posix()
            rows.writerow({key: "" if value is None else value for key, value in row.items() if key in _COLUMNS})
    text.detach()  # flushes; the caller closes the file
    return count


def write_parquet(path: Path, objects: Iterable[ExportedObject]) -> int:
    """Write the views that searches use as a Parquet table, with their CEDD levels, without their images.

    Raises
    ------
    ExportFailed
        The file exists already or cannot be written, or pyarrow is not installed.
    """
    pa, pq = pyarrow()
    text, number = pa.string(), pa.float64()
    schema = pa.schema(
        [
            *((name, text) for name in ("object", "label", "note")),
            *((name, number) for name in ("azimuth_deg", *_NUMBERS)),
            ("captured_utc", pa.timestamp("us", "UTC")),
            *((name, text) for name in ("bench", "software", "devices", "conditions", "evidence", "image")),
            ("image_sha256", text),
            ("descriptor", text),
            ("descriptor_version", pa.int32()),
            ("levels", pa.list_(pa.uint8())),
        ]
    )
    count = 0
    with new_file(path) as file, pq.ParquetWriter(file, schema) as writer:
        for item, _ in objects:
            count += 1
            rows = [row for row, _ in _rows(item)]
            if rows:
                writer.write_table(pa.Table.from_pylist([{n: row[n] for n in schema.names} for row in rows], schema))
    return count


def pyarrow() -> tuple[Any, Any]:
    """Return the modules pyarrow and pyarrow.parquet; `ExportFailed` if they are not installed."""
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError as error:
        raise ExportFailed(
            "Parquet needs pyarrow, which is not installed.", next_step=Do.INSTALL_EXTRA(extra="parquet")
        ) from error
    return pa, pq


def _rows(item: Object) -> Iterator[tuple[dict[str, Any], View]]:
    for enrollment in item.enrollments:
        if enrollment.status == EnrollmentStatus.COMPLETE:
            for view in enrollment.views:
                yield _row(item, enrollment, view), view


def _row(item: Object, enrollment: Enrollment, view: View) -> dict[str, Any]:
    session = enrollment.sessions[view.session]
    kind = descriptor(PAPER_DESCRIPTOR)
    levels = next((d for d in view.descriptors if (d.name, d.version) == (kind.name, kind.version)), None)
    return {
        "object": item.name,
        "label": item.label,
        "note": item.note,
        **{name: getattr(view, name) for name in ("azimuth_deg", *_NUMBERS, "captured_utc", "image", "image_sha256")},
        "bench": session.bench,
        "software": session.software,
        "devices": json.dumps(session.devices, ensure_ascii=False),
        "conditions": json.dumps(session.conditions, ensure_ascii=False),
        "evidence": json.dumps(view.evidence, ensure_ascii=False),
        "region": region_text(region_of_view(view)),
        "descriptor": levels.name if levels else None,
        "descriptor_version": levels.version if levels else None,
        "packed": levels.packed if levels else None,
        "levels": kind.unpack(bytes.fromhex(levels.packed)).tolist() if levels else None,
    }


def _photograph(row: Mapping[str, str | None], folder: Path) -> Photograph:
    """Return the photograph of a row. ValueError says why a row cannot be used."""
    texts = {key: value.strip() for key, value in row.items() if isinstance(key, str) and isinstance(value, str)}
    if missing := [name for name in _NEEDED if not texts.get(name)]:
        raise ValueError(f"{' and '.join(missing)} missing")
    path = folder / texts["image"]
    if not path.resolve().is_relative_to(folder):
        raise ValueError(f"the image {texts['image']} is not in the folder of the table")
    if not path.is_file():
        raise ValueError(f"there is no image {texts['image']}")
    values: dict[str, Any] = {name: _number(texts[name], name) for name in _NUMBERS if texts.get(name)}
    if (values.get("imu_deg") is None) != (values.get("imu_sigma_deg") is None):
        raise ValueError("imu_deg and imu_sigma_deg: give both or none")
    if texts.get("captured_utc"):
        values["captured_utc"] = datetime.fromisoformat(texts["captured_utc"])
        if values["captured_utc"].tzinfo is None:
            raise ValueError(f"captured_utc {texts['captured_utc']} has no time zone")
        values["captured_utc"] = in_utc(values["captured_utc"])
    azimuth_deg = _number(texts["azimuth_deg"], "azimuth_deg")
    return Photograph(
        path,
        texts["object"],
        float(wrap360(azimuth_deg)),
        values,
        **{key: texts.get(key, "") for key in ("label", "note", "bench", "software")},
        region=parse_region(texts.get("region", "")),
    )


def _number(text: str, name: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = float("nan")
    if not abs(number) < 1e9:
        raise ValueError(f"{name} is {text!r}, not an angle in degrees")
    return number
