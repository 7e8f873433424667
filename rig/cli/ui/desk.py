"""The desk of a command: its options open bench and catalog, and the terminal asks and shows."""

import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager

from rig.bench import Bench
from rig.bench.bench import DEVICES
from rig.catalog import Catalog
from rig.catalog.jobs import JobProgress
from rig.catalog.journal import Journal
from rig.cli.ui.jobs import is_interactive, progress_bar
from rig.cli.ui.operator import TerminalOperator
from rig.cli.ui.settings import Settings
from rig.core.clock import Clock
from rig.core.next_steps import in_words
from rig.events.events import Event, event_dict
from rig.events.lines import line
from rig.jobs.desk import Desk, Progress, Remark, Result, Steps
from rig.plans.operator import Operator, Unattended


class CommandDesk(Desk):
    """The desk of a command.

    Parameters
    ----------
    settings
        The options of the command.
    before
        Called before each question and each note: removes the live display.
    yes
        Do not ask.

    Attributes
    ----------
    bench, catalog
        Those that the job has opened.
    """

    bench: Bench
    catalog: Catalog

    def __init__(self, settings: Settings, before: Callable[[], None] = lambda: None, *, yes: bool = False) -> None:
        self.config = settings.load()
        self.place = self.config.catalog_place(settings.bench_name)
        self.operator: Operator = (
            Unattended() if yes else TerminalOperator(is_there=not settings.json and is_interactive(), before=before)
        )
        self._settings = settings
        self._before = before

    def open_bench(self, devices: Iterable[str] = DEVICES) -> AbstractContextManager[Bench]:
        self.bench = self._settings.open_bench(devices=tuple(devices))
        return self.bench

    def open_to_read(self) -> Catalog:
        return self._settings.open_for_search()

    def open_to_enroll(self, clock: Clock) -> Catalog:
        self.catalog = self._settings.open_for_enrollment(clock)
        return self.catalog

    def deliver(self) -> Iterator[Remark]:
        if isinstance(self.catalog, Journal):
            self._before()
            self._settings.deliver()
        yield from ()

    def preparing(self) -> AbstractContextManager[Callable[[JobProgress], None]]:
        return progress_bar("Preparing objects for searches")

    def note(self, remark: Remark) -> None:
        """Print a remark of a job on stderr."""
        self._before()
        text = " ".join(filter(None, (remark.text, in_words(remark.steps))))
        picture = "" if self._settings.json else remark.picture
        print(f"{'Note: ' if remark.is_warning else ''}{text}{picture}", file=sys.stderr, flush=True)

    def run(self, steps: Steps[object], show: Callable[[Event], None] | None = None) -> object:
        """Run a job to its end, and return what it returns; by default its events are printed line by line."""
        try:
            while True:
                match next(steps):
                    case Remark() as remark:
                        self.note(remark)
                    case Result() as result:
                        self._settings.say(result.text, result.values)
                    case Progress() as progress:
                        values = {"event": "progress", "share": progress.share, "words": progress.words}
                        self._settings.say(progress.words, values)
                    case event if show is not None:
                        show(event)
                    case event:
                        self._settings.say(line(event), event_dict(event))
        except StopIteration as end:
            return end.value
        finally:
            steps.close()
