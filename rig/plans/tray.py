"""A tray: objects of a CSV list that are enrolled one after the other. Complete ones are skipped."""

import csv
from collections import Counter
from collections.abc import Generator, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Final

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
    step = "Choose a CSV file."
    with os_errors_as(UsageError, f"The list {path} cannot be read.", next_step=step):
        content = read(path, max_bytes=MAX_FILE_BYTES)
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = error.object[: error.start].count(b"\n") + 1
        raise UsageError(
            f"The list {path} is not encoded in UTF-8.",
            next_step='Save it as "CSV UTF-8".',
            evidence={"mistakes": [f"line {line}: byte 0x{error.object[error.start]:02x}"]},
        ) from error
    # All mistakes are reported at once, so that the list is corrected once.
    mistakes: list[str] = []
    items: list[TrayItem] = []
    try:
        rows = _rows(text)
        first, headings = next(rows, (1, []))
        headings = [heading.strip().lower() for heading in headings]
        mistakes += _heading_mistakes(first, headings)
        if not mistakes:
            for line, cells in rows:
                if any(cell.strip() for cell in cells):
                    try:
                        items.append(_item(line, headings, cells))
                    except UsageError as error:
                        mistakes.append(f"line {line}: {error.what.rstrip('.')}")
    except csv.Error as error:
        mistakes.append(f"this is not CSV: {error}")
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


def _rows(text: str) -> Generator[tuple[int, list[str]], None, None]:
    """Yield each row with its first line in the file, from 1."""
    header = text.partition("\n")[0]
    separator = ";" if header.count(";") > header.count(",") else ","
    reader = csv.reader(text.splitlines(keepends=True), delimiter=separator, strict=True)
    line = 1
    for cells in reader:
        yield line, cells
        line = reader.line_num + 1


def _heading_mistakes(line: int, headings: Sequence[str]) -> list[str]:
    mistakes = []
    for heading in headings:
        if heading not in COLUMNS:
            near = get_close_matches(heading, COLUMNS, n=1)
            hint = f"Did you mean {near[0]}?" if near else f"The columns are {', '.join(COLUMNS)}."
            mistakes.append(f"line {line}: {heading!r} is not a column. {hint}")
    mistakes += [f"line {line}: the column {h} is there twice" for h, n in Counter(headings).items() if n > 1]
    if "name" not in headings and not mistakes:
        mistakes.append(f"line {line}: there is no column name; the first line must be {','.join(COLUMNS)}")
    return mistakes


def _item(line: int, headings: Sequence[str], cells: Sequence[str]) -> TrayItem:
    if len(cells) > len(headings):
        raise UsageError(
            f"{len(cells)} values in {len(headings)} columns.", next_step="Put text with a comma in quotes."
        )
    values = {heading: cell.strip() for heading, cell in zip(headings, cells, strict=False)}
    views = None
    if values.get("views"):
        views = whole(values["views"])
        if views is None or not MIN_VIEWS <= views <= MAX_VIEWS:
            raise UsageError(
                f"views is {values['views'][:20]!r}, not a number from {MIN_VIEWS} to {MAX_VIEWS}.",
                next_step="Correct it.",
            )
    return TrayItem(line, clean_name(values.get("name", "")), values.get("label"), values.get("note"), views)
