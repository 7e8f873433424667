"""Contact sheets of a catalog, and an HTML page that shows them with the data of each object."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from statistics import median
from typing import Any, Final, NamedTuple
from urllib.parse import quote

import cv2
import numpy as np

from rig.catalog.exchange.batch import Enrollment, ExportedObject, Object, Session, region_of_view
from rig.catalog.exchange.bundle import new_file, read_stored
from rig.catalog.exchange.new_folder import new_folder
from rig.catalog.records import EnrollmentStatus
from rig.core.errors import ExportFailed
from rig.core.phrases import counted
from rig.core.templates import environment
from rig.report.contact_sheet import Image, contact_sheet, thumbnail
from rig.report.page import JPEG_QUALITY
from rig.report.records import TILE
from rig.views.image_files import decode

SHEETS: Final = "sheets"
_STAMP: Final = (56, 56)


class _Shown(NamedTuple):
    item: Object
    sheet: str
    stamp: str
    views: int
    enrolled: str
    items_: list[tuple[str, str]]


def write_sheets(folder: Path, objects: Iterable[ExportedObject]) -> int:
    """Write a contact sheet of every object, ``0001-mug-white.jpg``, and return their number.

    Raises
    ------
    ExportFailed
        The folder is not empty or cannot be written, or an image is not the one that was stored.
    """
    with new_folder(folder) as made:
        return sum(1 for _ in _shown(made, None, objects))


def write_catalog_page(target: Path, objects: Iterable[ExportedObject]) -> int:
    """Write an HTML page with the contact sheets, and return the number of objects.

    ``target`` is the file (suffix ``.html``; the sheets are in a folder beside it), or a folder for ``index.html``.

    Raises
    ------
    ExportFailed
        As `write_sheets`.
    """
    if target.suffix.lower() == ".html":
        sheets = target.with_name(f"{target.stem}-{SHEETS}")
        with new_file(target) as file, new_folder(sheets) as made:
            shown = list(_shown(made, sheets.name, objects))
            file.write(_page(shown))
    else:
        with new_folder(target) as made:
            (made / SHEETS).mkdir()
            shown = list(_shown(made / SHEETS, SHEETS, objects))
            (made / "index.html").write_bytes(_page(shown))
    return len(shown)


def _page(shown: list[_Shown]) -> bytes:
    template = environment("rig.report").get_template("catalog.html.j2")
    labels = sorted({one.item.label for one in shown} - {""})
    return template.render(objects=shown, views=sum(one.views for one in shown), labels=labels).encode()


def _shown(folder: Path, link: str | None, objects: Iterable[ExportedObject]) -> Iterator[_Shown]:
    """Write the sheets into ``folder``; ``link`` is its path from the page, None without a page."""
    for number, (item, files) in enumerate(objects, start=1):
        complete = [e for e in item.enrollments if e.status == EnrollmentStatus.COMPLETE]
        if not complete:
            continue
        (enrollment,) = complete
        pictures = list(_pictures(enrollment, files))
        slug = Path(enrollment.views[0].image).parts[1].split("-", 1)[-1]
        sheet, stamp = f"{number:04d}-{slug}.jpg", f"{number:04d}-{slug}-small.jpg"
        _write(folder / sheet, contact_sheet(pictures, [view.azimuth_deg for view in enrollment.views], tile=TILE))
        if link is not None:
            _write(folder / stamp, thumbnail(pictures[0], _STAMP))
        enrolled = f"{enrollment.finished_utc:%Y-%m-%d %H:%M} UTC" if enrollment.finished_utc else "–"
        items = list(_items(item, enrollment))
        yield _Shown(item, quote(f"{link}/{sheet}"), quote(f"{link}/{stamp}"), len(enrollment.views), enrolled, items)


def _pictures(enrollment: Enrollment, files: dict[str, Path]) -> Iterator[Image]:
    for view in enrollment.views:
        image = decode(read_stored(files[view.image], view.image_sha256))
        yield thumbnail(image, TILE, region_of_view(view))


def _write(path: Path, image: Image) -> None:
    encoded, jpeg = cv2.imencode(".jpg", np.ascontiguousarray(image), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not encoded:
        raise ExportFailed(
            f"The picture {path.name} cannot be encoded.", next_step="Export an object with fewer views."
        )
    path.write_bytes(jpeg.tobytes())


def _items(item: Object, enrollment: Enrollment) -> Iterator[tuple[str, str]]:
    if item.note:
        yield "note", item.note
    yield "views", counted(len(enrollment.views), "view")
    earlier = len(item.enrollments) - 1
    if earlier:
        yield "other enrollments", str(earlier)
    sharpness = [view.evidence["sharpness"] for view in enrollment.views if "sharpness" in view.evidence]
    if sharpness:
        yield "sharpness", f"median {median(sharpness):.0f}; {min(sharpness):.0f} to {max(sharpness):.0f}"
    for session in enrollment.sessions:
        yield "taken", _taken(session)


def _taken(session: Session) -> str:
    devices = ", ".join(f"{name} {_identity(identity)}" for name, identity in session.devices.items())
    where = f"bench {session.bench}" if session.bench else ""
    words = (f"{session.started_utc:%Y-%m-%d %H:%M} UTC", where, session.software, devices)
    return "; ".join(word for word in words if word)


def _identity(identity: Any) -> str:
    if isinstance(identity, dict):
        return " ".join(str(value) for value in identity.values() if value not in (None, ""))
    return str(identity)
