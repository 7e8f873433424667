"""Contact sheets of a catalog, and an HTML page that shows them with the data of each object."""

import re
import unicodedata
from collections.abc import Iterator
from pathlib import Path
from statistics import median
from typing import Any, Final

from rig.catalog.exchange.new_files import new_folder
from rig.catalog.exchange.tables import enrolled
from rig.catalog.facts import Enrollment, Session
from rig.catalog.transfer import CatalogSource, Item
from rig.core.phrases import counted
from rig.report.contact_sheet import contact_sheet, thumbnail
from rig.report.page import FEW, STAMP, Meta, ShownObject, jpeg, render_page
from rig.report.records import TILE
from rig.report.summary import SummaryItem
from rig.views.image_files import decode

SHEETS: Final = "sheets"
MAX_SLUG_LENGTH: Final = 40


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
        shown = list(_objects(made / SHEETS, source))
        objects = [one for one, _ in shown]
        labels = sorted({one.note for one in objects} - {""})
        items = [
            SummaryItem("objects", f"{len(objects)}"),
            SummaryItem("views", f"{sum(views for _, views in shown)}"),
            *([SummaryItem("labels", f"{len(labels)}", ", ".join(labels))] if labels else []),
        ]
        (made / "index.html").write_bytes(render_page("Catalog", objects, items, meta=Meta()).encode())
    return len(objects)


def _objects(folder: Path, source: CatalogSource) -> Iterator[tuple[ShownObject, int]]:
    """Write the sheets into a folder beside the page."""
    for number, (item, enrollment, regions) in enumerate(enrolled(source), start=1):
        views = enrollment.views
        pictures = [
            thumbnail(decode(source.content(view.image)), TILE, region)
            for view, region in zip(views, regions, strict=True)
        ]
        stem = f"{number:04d}-{_slug(item.name)}".rstrip("-")
        sheet, stamp = f"{stem}.jpg", f"{stem}-small.jpg"
        (folder / sheet).write_bytes(jpeg(contact_sheet(pictures, [view.azimuth_deg for view in views], tile=TILE)))
        (folder / stamp).write_bytes(jpeg(thumbnail(pictures[0], STAMP)))
        finished_utc = next(one.finished_utc for one in item.enrollments if one.enrollment is enrollment)
        when = f"{finished_utc:%Y-%m-%d %H:%M} UTC" if finished_utc else "–"
        line = f"{counted(len(views), 'view')}, enrolled {when}"
        rows = [SummaryItem(*words) for words in _items(item, enrollment)]
        addresses = f"{SHEETS}/{stamp}", f"{SHEETS}/{sheet}"
        unfold = number <= FEW
        shown = ShownObject(number, addresses[0], item.name, line, addresses[1], rows, unfold, note=item.label)
        yield shown, len(views)


def _slug(name: str) -> str:
    """Return a name for a file; it may be empty."""
    plain = unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode().lower()
    return re.sub(r"[^a-z0-9]+", "-", plain)[:MAX_SLUG_LENGTH].strip("-")


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
