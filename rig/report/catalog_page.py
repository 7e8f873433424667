"""Contact sheets of a catalog, and an HTML page that shows them with the data of each object."""

import re
import unicodedata
from collections.abc import Iterator
from pathlib import Path
from statistics import median
from typing import Any, Final, NamedTuple

import cv2
import numpy as np

from rig.catalog.exchange.new_files import new_folder
from rig.catalog.exchange.tables import enrolled
from rig.catalog.facts import Enrollment, Session
from rig.catalog.transfer import CatalogSource, Item
from rig.core.errors import ExportFailed
from rig.core.phrases import counted
from rig.core.templates import environment
from rig.report.contact_sheet import Image, contact_sheet, thumbnail
from rig.report.page import JPEG_QUALITY
from rig.report.records import TILE
from rig.views.image_files import decode

SHEETS: Final = "sheets"
MAX_SLUG_LENGTH: Final = 40
_STAMP: Final = (56, 56)


class _Shown(NamedTuple):
    item: Item
    sheet: str
    stamp: str
    views: int
    enrolled: str
    items_: list[tuple[str, str]]


def write_catalog_page(folder: Path, source: CatalogSource) -> int:
    """Write a folder with an HTML page ``index.html`` and a contact sheet of every object; return their number.

    Raises
    ------
    ExportFailed
        The folder is not empty or cannot be written.
    CatalogError
        An image is not the one that was stored.
    """
    with new_folder(folder) as made:
        (made / SHEETS).mkdir()
        shown = list(_shown(made / SHEETS, source))
        (made / "index.html").write_bytes(_page(shown))
    return len(shown)


def _page(shown: list[_Shown]) -> bytes:
    template = environment("rig.report").get_template("catalog.html.j2")
    labels = sorted({one.item.label for one in shown} - {""})
    return template.render(objects=shown, views=sum(one.views for one in shown), labels=labels).encode()


def _shown(folder: Path, source: CatalogSource) -> Iterator[_Shown]:
    """Write the sheets into a folder beside the page."""
    for number, (item, enrollment, regions) in enumerate(enrolled(source), start=1):
        pictures = [
            thumbnail(decode(source.content(view.image)), TILE, region)
            for view, region in zip(enrollment.views, regions, strict=True)
        ]
        stem = f"{number:04d}-{_slug(item.name)}".rstrip("-")
        sheet, stamp = f"{stem}.jpg", f"{stem}-small.jpg"
        _write(folder / sheet, contact_sheet(pictures, [view.azimuth_deg for view in enrollment.views], tile=TILE))
        _write(folder / stamp, thumbnail(pictures[0], _STAMP))
        finished_utc = next(one.finished_utc for one in item.enrollments if one.enrollment is enrollment)
        when = f"{finished_utc:%Y-%m-%d %H:%M} UTC" if finished_utc else "–"
        items = list(_items(item, enrollment))
        yield _Shown(item, f"{SHEETS}/{sheet}", f"{SHEETS}/{stamp}", len(enrollment.views), when, items)


def _slug(name: str) -> str:
    """Return a name for a file; it may be empty."""
    plain = unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode().lower()
    return re.sub(r"[^a-z0-9]+", "-", plain)[:MAX_SLUG_LENGTH].strip("-")


def _write(path: Path, image: Image) -> None:
    encoded, jpeg = cv2.imencode(".jpg", np.ascontiguousarray(image), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not encoded:
        raise ExportFailed(
            f"The picture {path.name} cannot be encoded.", next_step="Export an object with fewer views."
        )
    path.write_bytes(jpeg.tobytes())


def _items(item: Item, enrollment: Enrollment) -> Iterator[tuple[str, str]]:
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
    by = session.provenance
    devices = ", ".join(f"{name} {_identity(identity)}" for name, identity in by.devices.items())
    where = f"bench {by.bench}" if by.bench else ""
    words = (f"{session.started_utc:%Y-%m-%d %H:%M} UTC", where, by.software, devices)
    return "; ".join(word for word in words if word)


def _identity(identity: Any) -> str:
    if isinstance(identity, dict):
        in_order = sorted(identity, key=lambda name: name != "model")  # the model first
        return " ".join(str(identity[name]) for name in in_order if identity[name] not in (None, ""))
    return str(identity)
