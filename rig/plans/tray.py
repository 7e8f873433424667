"""A tray: objects of a CSV list that are enrolled one after the other. Complete ones are skipped."""

import csv
from collections import Counter
from collections.abc import Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from rig.bench import Bench
from rig.catalog import Catalog, ObjectSummary, clean_name
from rig.core.errors import (
    NoObject,
    ObjectNotFound,
    RigError,
    RotationDisagreement,
    UsageError,
    ViewRejected,
    os_errors_as,
)
from rig.core.files import read
from rig.core.phrases import counted, whole
from rig.events.events import Event, Item, SkipReason
from rig.motion.scan_speed import takes_in_motion
from rig.plans.enroll import enroll
from rig.plans.operator import Choice, Operator, Question, Subject, Unattended

COLUMNS: Final = ("name", "label", "note", "views")
MAX_FILE_BYTES: Final = 1_000_000  # ten thousand objects; a larger file is not a tray
MIN_VIEWS, MAX_VIEWS = 4, 720
"""Limits of the number of views, as for `enroll.views` of the configuration."""

OBJECT_ERRORS: Final = (NoObject, ViewRejected, RotationDisagreement, ObjectNotFound)
"""Errors that concern one object: the tray can continue with the next one. Any other error ends the tray."""


@dataclass(frozen=True, slots=True)
class TrayItem:
    """One object of the list; ``line`` is its line in the file, from 1. ``views`` is None for the default."""

    line: int
    name: str
    label: str | None = None
    note: str | None = None
    views: int | None = None


def read_tray(path: Path) -> tuple[TrayItem, ...]:
    """Read a list of objects: CSV in UTF-8 with a header line, separated by commas or semicolons.

    Raises `UsageError`: the file cannot be read, or it has mistakes; the evidence lists all of them with their lines.
    """
    with os_errors_as(UsageError, f"The list {path} cannot be read.", next_step="Choose a CSV file."):
        content = read(path, max_bytes=MAX_FILE_BYTES)
    # All mistakes are reported at once, so that the list is corrected once.
    items: list[TrayItem] = []
    mistakes: list[str] = []
    try:
        for line, row in _rows(content.decode("utf-8-sig")):
            try:
                items.append(_item(line, row))
            except UsageError as error:
                mistakes.append(f"line {line}: {error.what.rstrip('.')}")
    except UnicodeDecodeError as error:
        line, byte = error.object[: error.start].count(b"\n") + 1, error.object[error.start]
        mistakes.append(f'line {line}: byte 0x{byte:02x} is not UTF-8; save the list as "CSV UTF-8"')
    except csv.Error as error:
        mistakes.append(f"this is not CSV: {error}")
    except UsageError as error:
        mistakes.append(error.what.rstrip("."))
    counts = Counter(item.name for item in items)
    mistakes += [
        f"line {item.line}: {item.name!r} is in the list {counts[item.name]} times"
        for item in items
        if counts[item.name] > 1
    ]
    if not items and not mistakes:
        mistakes.append("the list has no objects")
    if mistakes:
        raise UsageError(
            f"The list {path} has {len(mistakes)} mistake{'s' if len(mistakes) > 1 else ''}.",
            next_step="Correct these lines. Nothing was enrolled.",
            evidence={"mistakes": mistakes},
        )
    return tuple(items)


def _rows(text: str) -> Iterator[tuple[int, Mapping[str | None, Any]]]:
    """Yield the rows that are not empty by their headings, each with its last line in the file, from 1.

    Raises `UsageError`: the headings are not those of a tray.
    """
    header = text.partition("\n")[0]
    separator = ";" if header.count(";") > header.count(",") else ","
    reader = csv.DictReader(text.splitlines(keepends=True), delimiter=separator, strict=True)
    headings = reader.fieldnames = [heading.strip().lower() for heading in reader.fieldnames or ()]
    if "name" not in headings or len({*headings, *COLUMNS}) > len(COLUMNS) or len(set(headings)) < len(headings):
        raise UsageError(
            f"line 1: its columns are {', '.join(headings) or 'missing'}, but they must be name, and each at most once "
            f"{', '.join(COLUMNS[1:])}.",
            next_step="Correct it.",
        )
    for row in reader:
        if any("".join(cell or "").strip() for cell in row.values()):
            yield reader.line_num, row


def _item(line: int, row: Mapping[str | None, Any]) -> TrayItem:
    if None in row:  # the cells beyond the headings
        raise UsageError("It has more values than columns.", next_step="Put text with a comma in quotes.")
    values = {heading: cell.strip() for heading, cell in row.items() if cell is not None}
    views = None
    if values.get("views"):
        views = whole(values["views"])
        if views is None or not MIN_VIEWS <= views <= MAX_VIEWS:
            raise UsageError(
                f"views is {values['views'][:20]!r}, not a number from {MIN_VIEWS} to {MAX_VIEWS}.",
                next_step="Correct it.",
            )
    return TrayItem(line, clean_name(values.get("name", "")), values.get("label"), values.get("note"), views)


def left_to_enroll(catalog: Catalog, items: Sequence[TrayItem]) -> list[TrayItem]:
    """Return the objects of a tray that are not enrolled, or whose enrollment was interrupted."""
    known = {summary.name: summary for summary in catalog.known_objects()}
    return [item for item in items if _action(known.get(item.name)) != "skip"]


def _action(known: ObjectSummary | None) -> str:
    """Return what a tray does with an object of the catalog; None: the catalog has none."""
    if known is not None and known.unfinished_views is not None:
        return "resume"
    return "skip" if known is not None and known.views else "enroll"


def enroll_tray(
    bench: Bench,
    catalog: Catalog,
    items: Sequence[TrayItem],
    *,
    views: int | None = None,
    operator: Operator | None = None,
    fly: bool | None = None,
) -> Generator[Event, None, None]:
    """Enroll the objects of a tray one after the other; yields an `Item` before the events of each.

    Complete objects are skipped, and interrupted enrollments are resumed. So after an interruption, the same call
    enrolls the remaining objects. ``views`` is for objects without their own number of views; by default
    ``enroll.views``. The ``operator`` puts the objects on the table, and decides whether each is enrolled; by default
    `Unattended`. ``fly`` takes the views in motion. The default is ``enroll.mode``; "auto" means in motion if the
    camera's time is calibrated and the cable budget allows a revolution.

    Raises `RigError`: as in `enroll`, if the operator decides to stop.
    """
    operator = operator or Unattended()
    for number, item in enumerate(items, 1):
        while True:
            known = {summary.name: summary for summary in catalog.known_objects()}.get(item.name)
            action = _action(known)
            if action == "skip":
                yield Item(number, len(items), item.name, "skip", SkipReason.ALREADY_ENROLLED)
                break
            # The operator places the next object, skips it, or ends the tray.
            decision = operator.choose(next_object(item, number, len(items), known if action == "resume" else None))
            if decision is Choice.STOP:
                return
            if decision is Choice.SKIP:
                yield Item(number, len(items), item.name, "skip", SkipReason.OPERATOR)
                break
            if decision is Choice.RESTART:
                action = "replace"
            yield Item(number, len(items), item.name, action)
            try:
                yield from enroll(
                    bench,
                    catalog,
                    item.name,
                    views=item.views or views,
                    label=item.label,
                    note=item.note,
                    resume=action == "resume",
                    replace=action == "replace",
                    fly=takes_in_motion(bench.config, fly, tray=True),
                )
            # A problem of one object ends this object only; a fault of the bench ends the tray.
            except OBJECT_ERRORS as error:
                decision = operator.choose(after_error(error, item))
                if decision is Choice.STOP:
                    raise
                if decision is Choice.SKIP:
                    yield Item(number, len(items), item.name, "skip", SkipReason.ERROR, error.code)
                    break
            else:
                break


def next_object(item: TrayItem, number: int, of: int, interrupted: ObjectSummary | None) -> Question:
    """Return the question for the next object of a tray; ``interrupted`` is its interrupted enrollment, if any."""
    label = f" ({item.label})" if item.label else ""
    others = {Choice.SKIP: "skip", Choice.STOP: "stop"}
    if interrupted is None:
        text = f"{number} of {of}: put {item.name}{label} on the table and take your hands away."
        return Question(Subject.OBJECT, text, {Choice.CONTINUE: "continue", **others})
    views = counted(interrupted.unfinished_views or 0, "view")
    text = (
        f"{number} of {of}: {item.name} has {views} of an interrupted enrollment. You can resume it if the object was "
        "not moved."
    )
    again = {Choice.CONTINUE: "resume", Choice.RESTART: "enroll again because the object was moved"}
    return Question(Subject.UNFINISHED, text, {**again, **others})


def after_error(error: RigError, item: TrayItem) -> Question:
    """Return the question after an error that concerns one object."""
    choices = {Choice.CONTINUE: "try again", Choice.SKIP: "skip", Choice.STOP: "stop"}
    text = f"{item.name}: {error.what}"
    return Question(Subject.FAILURE, text, choices, unattended=Choice.STOP, steps=error.steps)
