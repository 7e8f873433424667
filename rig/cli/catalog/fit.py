"""`rig catalog fit`: fit the stopping rule of the dense search to the catalog."""

import os
import sys
from math import isfinite
from typing import TYPE_CHECKING, Annotated, Final

import typer

from rig.cli.ui.command import command
from rig.cli.ui.jobs import interruptible
from rig.cli.ui.options import ClusterOption, jobs_of
from rig.cli.ui.settings import Settings
from rig.core.clock import SystemClock, seconds_between
from rig.core.errors import CatalogError
from rig.core.next_steps import Do
from rig.core.phrases import counted, percent, percent_words, sentence

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

    from hbr import FittedRule
    from hbr.core.arrays import FloatArray
    from hbr.dense.fitting import Task
    from rig.catalog.unfinished import UnfinishedJob

_SEVERAL_PROCESSES: Final = 20_000
"""Views from which the searches take longer than the start of further processes."""


@command
def fit(
    settings: Settings,
    error_rate: Annotated[
        float, typer.Option(min=0.0001, max=0.5, help="Largest share of wrong objects among those named.")
    ] = 0.01,
    false_reject: Annotated[
        float, typer.Option(min=0.0001, max=0.5, help="Largest share of enrolled objects called unknown.")
    ] = 0.02,
    cluster: ClusterOption = None,
) -> None:
    """Fit the stopping rule, which decides when rig identify ends a search, to the catalog.

    The command searches for each enrolled object with its own views, as if the camera had been a little to the side.
    Then it leaves the object out and searches again, as for an unknown object. In a catalog of more than 1000 objects,
    it searches for 1000 of them among all. It reports what the rule cannot guarantee, and how much more data is needed.
    Repeat the command when rig identify reports that the catalog has changed.

    Example: rig catalog fit --bench sim --error-rate 0.005
    """
    from hbr import DenseIndex, fit_stopping_rule
    from rig.catalog.derived import views as enrolled_views
    from rig.catalog.jobs import JobProgress
    from rig.catalog.unfinished import UnfinishedJob
    from rig.cli.ui.present import Progress
    from rig.core.json_form import plain
    from rig.core.processes import map_in_processes
    from rig.search.stopping_rules import FILE, digest, stopping_rule_values, write_stopping_rule
    from rig.views.description import BENCH_DESCRIPTOR

    clock = SystemClock()
    with settings.open_catalog(read_only=True) as catalog:
        with Progress("Describing the enrolled views") as progress:
            views = enrolled_views(catalog, BENCH_DESCRIPTOR, progress)
        if not len(views):
            raise CatalogError("The catalog is empty.", next_step=Do.ENROLL())
        path = catalog.path / FILE
    begun_ns = clock.now_ns()
    print(f"Searching for {len(views.object_names)} objects among each other ...", file=sys.stderr)
    index = DenseIndex(views)
    unfinished = UnfinishedJob(path.with_name("fit.unfinished"), digest(index))
    unfinished.load()

    def interrupted() -> str:
        kept = "the searches so far are stored. The same command continues."
        return f"Interrupted; {kept if unfinished.is_stored else 'nothing changed.'}"

    with unfinished, interruptible(interrupted), Progress("Searching") as progress:
        where = jobs_of(None, cluster)
        if where is None and len(views) >= _SEVERAL_PROCESSES:
            where = os.cpu_count() or 1

        def searched(
            work: "Callable[[Task], FloatArray]", tasks: "Sequence[Task]"
        ) -> "Iterator[tuple[Task, FloatArray]]":
            found = _continued(unfinished, tasks, lambda left: map_in_processes(work, left, where or 1))
            for done, one in enumerate(found):
                progress(JobProgress(done, len(tasks)))
                yield one

        found = fit_stopping_rule(index, error_rate=error_rate, false_reject=false_reject, tasks=searched)
    unfinished.remove()
    made_utc = f"{clock.utc():%Y-%m-%dT%H:%M:%SZ}"
    write_stopping_rule(path, found.rule, index, made_utc=made_utc)
    if settings.json:
        outcome = {key: value for key, value in plain(found).items() if key != "rule"}
        values = stopping_rule_values(found.rule, index, made_utc=made_utc)
        settings.print_json({"file": str(path), "fit": outcome, **values})
        return
    for words in _lines(found, len(views.object_names), seconds_between(begun_ns, clock.now_ns())):
        print(words)
    print(f"Stored: {path}")


def _continued(
    unfinished: "UnfinishedJob",
    tasks: "Sequence[Task]",
    search: "Callable[[Sequence[Task]], Iterable[tuple[Task, FloatArray]]]",
) -> "Iterator[tuple[Task, FloatArray]]":
    """Yield the searches for all objects: first those that are stored, then the others, which are stored, too."""
    import numpy as np

    from hbr.dense.fitting import NUMBERS_OF_VIEW

    left = []
    for task in tasks:
        try:
            found = np.array(unfinished.found[repr(task)], np.float64)
        except (KeyError, TypeError, ValueError):  # not stored, or changed by hand
            found = np.empty(0)
        if found.ndim == 3 and found.shape[2] == NUMBERS_OF_VIEW:
            yield task, found
        else:
            left.append(task)
    for task, found in search(left):
        unfinished.store({repr(task): found.tolist()})
        yield task, found


def _lines(found: "FittedRule", objects: int, seconds: float) -> list[str]:
    from rig.events.note_wording import limitation_words

    rule = found.rule
    searched = (f"{found.searched} of " if 0 < found.searched < objects else "") + counted(objects, "object")
    lines = [
        f"{rule.searches} leave-one-out searches of {counted(found.views, 'view')} for {searched} in {seconds:.1f} s"
    ]
    if found.ended:
        lines.append(
            f"  answers  {found.ended} searches ended at a confidence of {percent_words(rule.min_confidence)}, after "
            f"{found.mean_views:.2f} views on average, {found.wrong} of them with a wrong object "
            f"({percent(found.wrong / found.ended)})"
        )
    if isfinite(rule.open_set_thresholds[-1]):
        thresholds = ", ".join(f"{one:.3f}" for one in rule.open_set_thresholds)
        share = f": {found.rejected} of {rule.searches} searches for enrolled objects" if found.ended else ""
        share += f" ({percent(found.rejected / rule.searches)})" if found.ended else ""
        lines.append(f"  unknown  below an open-set score of {thresholds} after 1, 2, ... views{share}")
    if found.accepted is not None:
        pairs = ", ".join(f"{one} for {other}" for one, other in found.confused[:3])
        lines.append(
            f"  left out  {found.accepted} of {rule.searches} left-out objects were taken for another object "
            f"({percent(found.accepted / rule.searches)}){f': {pairs}' if pairs else ''}"
        )
    if not rule.limitations:
        lines.append(
            f"Guaranteed for searches like these: at most {percent(rule.error_rate)} wrong answers, and "
            f"{percent(rule.false_reject)} of the enrolled objects called unknown."
        )
    return [*lines, *(f"Not guaranteed: {sentence(limitation_words(one))}" for one in rule.limitations)]
