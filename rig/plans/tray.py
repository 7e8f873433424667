"""A whole tray of objects, listed in a CSV file, one after the other; what is enrolled already is skipped."""

import csv
from collections import Counter
from collections.abc import Generator, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from enum import StrEnum
from pathlib import Path
from typing import Final, Protocol

from rig.bench import Bench
from rig.catalog import Catalog, ObjectSummary, clean_name
from rig.core.errors import ObjectNotFound, RigError, RotationDisagreement, UsageError, ViewRejected
from rig.events.events import Event, Item
from rig.plans.enroll import enroll

COLUMNS: Final = ("name", "label", "note", "views")
FEWEST, MOST = 4, 720
"""Views that an enrollment may have, as `enroll.views` of the configuration."""

AT_THE_OBJECT: Final = (ViewRejected, RotationDisagreement, ObjectNotFound)
"""Errors that lie with one object, so that the next one may do; any other ends the tray."""


@dataclass(frozen=True, slots=True)
class TrayItem:
    """A line of the list: ``line`` in the file, from 1; ``views`` None where the list leaves it to the program."""

    line: int
    name: str
    label: str | None = None
    note: str | None = None
    views: int | None = None


class TrayDecision(StrEnum):
    """What somebody says about an object."""

    PROCEED = "proceed"
    RESTART = "restart"
    SKIP = "skip"
    STOP = "stop"


class TrayOperator(Protocol):
    """Whoever brings the objects, or somebody who answers for hands that bring them by themselves."""

    def request(self, item: TrayItem, number: int, of: int, kept: ObjectSummary | None) -> TrayDecision:
        """Ask for the object; PROCEED, or RESTART if an interrupted one (``kept``) was moved meanwhile."""
        ...

    def decide_after_error(self, item: TrayItem, error: RigError) -> TrayDecision:
        """Say whether an object that failed is tried again (PROCEED), skipped, or the tray stopped."""
        ...


class AutomaticOperator:
    """AutomaticOperator that put every object by the platter's mark, the same way each time, and ask nobody."""

    def request(self, item: TrayItem, number: int, of: int, kept: ObjectSummary | None) -> TrayDecision:  # noqa: ARG002
        return TrayDecision.PROCEED

    def decide_after_error(self, item: TrayItem, error: RigError) -> TrayDecision:  # noqa: ARG002
        return TrayDecision.STOP


def read_tray(path: Path) -> tuple[TrayItem, ...]:
    """Read a list of objects: CSV in UTF-8, separated by commas or semicolons, with a line of headings.

    Raises
    ------
    UsageError
        It cannot be read, or lines of it are wrong: all of them, each with its number.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise UsageError(
            f"The list {path} cannot be read.",
            next_step="Give a CSV file with --list.",
            evidence={"reason": error.strerror or str(error)},
        ) from error
    except UnicodeDecodeError as error:
        line = error.object[: error.start].count(b"\n") + 1
        raise UsageError(
            f"The list {path} is not in UTF-8.",
            next_step="Save it as CSV UTF-8.",
            evidence={"mistakes": [f"line {line}: byte 0x{error.object[error.start]:02x}"]},
        ) from error
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
                        mistakes.append(f"line {line}: {error.what}")
    except csv.Error as error:
        mistakes.append(f"this is no CSV: {error}")
    counts = Counter(item.name for item in items)
    mistakes += [
        f"line {item.line}: {item.name!r} is listed {counts[item.name]} times"
        for item in items
        if counts[item.name] > 1
    ]
    if not items and not mistakes:
        mistakes.append("there is no object in it")
    if mistakes:
        raise UsageError(
            f"{len(mistakes)} mistake{'s' if len(mistakes) > 1 else ''} in the list {path}.",
            next_step="Mend the lines listed; nothing was enrolled.",
            evidence={"mistakes": mistakes},
        )
    return tuple(items)


def enroll_tray(
    bench: Bench,
    catalog: Catalog,
    items: Sequence[TrayItem],
    *,
    views: int | None = None,
    operator: TrayOperator | None = None,
) -> Generator[Event, None, None]:
    """Enroll the objects of a tray one after the other; yields an `Item` before the events of each.

    Objects that are complete in the catalog are skipped, interrupted ones go on with the views they lack: after an
    interruption the same call does what is left.

    Parameters
    ----------
    bench, catalog
        Open.
    items
        From `read_tray`.
    views
        Views of objects for which the list says nothing; ``enroll.views`` otherwise.
    operator
        Brings the objects; without one they are taken to stand there when their turn comes.

    Raises
    ------
    RigError
        As `enroll`, where the operator does not want to go on.
    """
    operator = operator or AutomaticOperator()
    for number, item in enumerate(items, 1):
        while True:
            known = {summary.name: summary for summary in catalog.objects()}.get(item.name)
            kept = known if known is not None and known.unfinished_views is not None else None
            if known is not None and kept is None and known.views:
                yield Item(number, len(items), item.name, "skip", "it is enrolled already")
                break
            answer = operator.request(item, number, len(items), kept)
            if answer is TrayDecision.STOP:
                return
            if answer is TrayDecision.SKIP:
                yield Item(number, len(items), item.name, "skip", "as asked")
                break
            resume = kept is not None and answer is TrayDecision.PROCEED
            action = "resume" if resume else "replace" if kept else "enroll"
            yield Item(number, len(items), item.name, action)
            try:
                yield from enroll(
                    bench,
                    catalog,
                    item.name,
                    views=item.views or views,
                    label=item.label,
                    note=item.note,
                    resume=resume,
                    replace=kept is not None and not resume,
                )
            except AT_THE_OBJECT as error:
                answer = operator.decide_after_error(item, error)
                if answer is TrayDecision.STOP:
                    raise
                if answer is TrayDecision.SKIP:
                    yield Item(number, len(items), item.name, "skip", error.what)
                    break
            else:
                break


def _rows(text: str) -> Generator[tuple[int, list[str]], None, None]:
    """Yield each row with the line it begins on."""
    heading = text.partition("\n")[0]
    separator = ";" if heading.count(";") > heading.count(",") else ","
    reader = csv.reader(text.splitlines(keepends=True), delimiter=separator, strict=True)
    line = 1
    for cells in reader:
        yield line, cells
        line = reader.line_num + 1


def _heading_mistakes(line: int, headings: Sequence[str]) -> list[str]:
    mistakes = [
        f"line {line}: {heading!r} is no column" + (f"; did you mean {near[0]}?" if near else f": {', '.join(COLUMNS)}")
        for heading in headings
        if heading not in COLUMNS
        for near in [get_close_matches(heading, COLUMNS, n=1)]
    ]
    mistakes += [f"line {line}: the column {h} comes twice" for h, n in Counter(headings).items() if n > 1]
    if "name" not in headings and not mistakes:
        mistakes.append(f"line {line}: there is no column name; write the headings {','.join(COLUMNS[:3])} first")
    return mistakes


def _item(line: int, headings: Sequence[str], cells: Sequence[str]) -> TrayItem:
    if len(cells) > len(headings):
        raise UsageError(
            f"{len(cells)} values under {len(headings)} headings", next_step="Put text that holds a comma in quotes."
        )
    values = {heading: cell.strip() for heading, cell in zip(headings, cells, strict=False)}
    views = None
    if values.get("views"):
        if not values["views"].isdecimal() or not FEWEST <= int(values["views"]) <= MOST:
            raise UsageError(
                f"views is {values['views']!r}, not a number from {FEWEST} to {MOST}", next_step="Mend it."
            )
        views = int(values["views"])
    return TrayItem(line, clean_name(values.get("name", "")), values.get("label"), values.get("note"), views)
