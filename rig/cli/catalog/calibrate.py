"""`rig catalog calibrate`: when a search ends and what it calls unknown, rehearsed on the catalog."""

import sys
from typing import TYPE_CHECKING, Annotated

import typer

from rig.cli.ui.command import command
from rig.cli.ui.settings import Settings

if TYPE_CHECKING:
    from rig.search.stopping_rules import Rehearsed


@command
def calibrate(
    settings: Settings,
    error_rate: Annotated[
        float, typer.Option(min=0.0001, max=0.5, help="Wrong objects among those named, at most.")
    ] = 0.01,
    false_reject: Annotated[
        float, typer.Option(min=0.0001, max=0.5, help="Enrolled objects called unknown, at most.")
    ] = 0.02,
) -> None:
    """Rehearse searches for every enrolled object, and keep the rules by which rig identify ends.

    Each object is looked for by its own views, as if taken a little aside, and once more with the whole object left
    out, as a stranger. What cannot be promised is said, and how much more data it takes. Do it again when the catalog
    has changed; rig identify notices.

    Example: rig catalog calibrate --bench sim --error-rate 0.005
    """
    from hbr import DenseIndex
    from rig.core.clock import SystemClock, seconds_between
    from rig.core.errors import CatalogError
    from rig.events.events import plain
    from rig.search.stopping_rules import FILE, rehearse, rules_values, write_rules
    from rig.views.description import BENCH_DESCRIPTOR

    clock = SystemClock()
    with settings.open_catalog(read_only=True) as catalog:
        views = catalog.views(BENCH_DESCRIPTOR).views
        if not len(views):
            raise CatalogError("The catalog is empty.", next_step="Enroll at least one object: rig enroll NAME.")
        path = catalog.path / FILE
    begun_ns = clock.now_ns()
    print(f"Looking for {len(views.object_names)} objects among each other ...", file=sys.stderr)
    index = DenseIndex(views)
    found = rehearse(index, error_rate=error_rate, false_reject=false_reject)
    made_utc = f"{clock.utc():%Y-%m-%dT%H:%M:%SZ}"
    write_rules(path, found.rules, index, made_utc=made_utc)
    if settings.json:
        values = rules_values(found.rules, index, made_utc=made_utc)
        outcome = {key: value for key, value in plain(found).items() if key != "rules"}
        settings.print_json({"file": str(path), "rehearsed": outcome, **values})
        return
    for words in _lines(found, len(views.object_names), seconds_between(begun_ns, clock.now_ns())):
        print(words)
    print(f"Kept: {path}")


def _lines(found: "Rehearsed", objects: int, seconds: float) -> list[str]:
    from math import isfinite

    from rig.events.wording import counted, percent_words, sentence

    rules = found.rules
    lines = [
        f"{rules.searches} rehearsed searches of {counted(found.views, 'view')} for {counted(objects, 'object')}, "
        f"in {seconds:.1f} s"
    ]
    if found.ended:
        lines.append(
            f"  answers  a search ends at a probability of {percent_words(rules.certainty)}: {found.ended} did, after "
            f"{found.mean_views:.2f} views, {found.wrong} of them with a wrong object ({found.wrong / found.ended:.1%})"
        )
    if isfinite(rules.familiar[-1]):
        least = ", ".join(f"{one:.3f}" for one in rules.familiar)
        so = f": {found.rejected} of {rules.searches} searches for enrolled objects ended so"
        share = f"{so} ({found.rejected / rules.searches:.1%})" if found.ended else ""
        lines.append(f"  unknown  below a familiarity of {least} after 1, 2, ... views{share}")
    if found.accepted is not None:
        pairs = ", ".join(f"{one} for {other}" for one, other in found.taken_for)
        lines.append(
            f"  strangers  {found.accepted} of {rules.searches} left out were taken for another object "
            f"({found.accepted / rules.searches:.1%}){f': {pairs}' if pairs else ''}"
        )
    if not rules.promises:
        lines.append(
            f"Promised, for searches like these: at most {rules.error_rate:.1%} wrong answers, and "
            f"{rules.false_reject:.1%} of the enrolled objects called unknown."
        )
    return [*lines, *(f"Not promised: {sentence(words)}" for words in rules.promises)]
