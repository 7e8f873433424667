"""The desk of a command: its options open bench and catalog, and the terminal asks and shows."""

import sys
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager
from typing import Any

from rig.bench import Bench
from rig.bench.bench import DEVICES
from rig.catalog import Catalog
from rig.catalog.copying import open_or_copy
from rig.catalog.jobs import JobProgress
from rig.catalog.journal import BackgroundDelivery, waiting
from rig.cli.ui import prompts
from rig.cli.ui.present import ProgressBar
from rig.cli.ui.settings import Settings
from rig.core.clock import SystemClock
from rig.core.errors import RigError
from rig.core.next_steps import in_words
from rig.core.notify import notify_of_job, print_note
from rig.doctor.finding import Finding
from rig.events.events import Enrolled, Event, Identified, event_dict
from rig.events.wording import line
from rig.jobs.desk import Desk, JobResult, Progress, Remark, Steps
from rig.plans.operator import Operator, Unattended


class CommandDesk(Desk):
    """The desk of a command.

    ``before`` is called before each question and each note: it removes the live display. ``yes`` asks nothing;
    ``with_json`` asks at a terminal also with ``--json``, because a person must do something.

    ``bench`` is the one that the job has opened.
    """

    bench: Bench

    def __init__(
        self,
        settings: Settings,
        before: Callable[[], None] = lambda: None,
        *,
        yes: bool = False,
        with_json: bool = False,
    ) -> None:
        self.config = settings.load()
        self.place = settings.place
        is_there = (with_json or not settings.json) and prompts.is_interactive()
        self.operator: Operator = Unattended() if yes else prompts.TerminalOperator(is_there=is_there, before=before)
        self._settings = settings
        self._before = before

    def open_bench(self, devices: Iterable[str] = DEVICES) -> AbstractContextManager[Bench]:
        self.bench = self._settings.open_bench(devices=tuple(devices))
        return self.bench

    def open_to_read(self) -> Catalog:
        self.deliver_waiting()
        if self.place.url is None:
            return self._settings.open_catalog(read_only=True)
        return open_or_copy(self.place, SystemClock())

    def deliver_waiting(self) -> None:
        """Deliver the journal if something is in it."""
        if waiting(self.place, SystemClock()):
            for remark in self.deliver():
                self.note(remark)

    def background_delivery(self) -> BackgroundDelivery:
        """Return a delivery of the journal during the work of a ``with`` block; its results are printed on stderr."""
        return BackgroundDelivery(self.place, SystemClock(), print_note)

    def preparing(self) -> AbstractContextManager[Callable[[JobProgress], None]]:
        return ProgressBar("Preparing objects for searches")

    def note(self, remark: Remark) -> None:
        """Print a remark of a job on stderr."""
        self._before()
        text = " ".join(filter(None, (remark.text, in_words(remark.steps))))
        print(f"{'Note: ' if remark.is_warning else ''}{text}", file=sys.stderr, flush=True)

    def run(self, kind: str, steps: Steps[object], show: Callable[[Event], None] | None = None) -> object:
        """Run a job to its end, and return what it returns; by default its events are printed line by line.

        ``kind`` is the one of the server's jobs, for `notify_command`.
        """
        result: Any = None
        state, failure, text = "interrupted", None, ""
        try:
            while True:
                step = next(steps)
                if isinstance(step, Enrolled | Identified):
                    result, text = event_dict(step), line(step)
                match step:
                    case Remark() as remark:
                        self.note(remark)
                    case JobResult(values=result, text=text):
                        self._before()
                        self._settings.say(text, result)
                    case Progress() as progress:
                        values = {"event": "progress", "share": progress.share, "words": progress.words}
                        self._settings.say(progress.words, values)
                    case Finding() as finding:
                        self._settings.say(finding.words, finding.reported)
                    case event if show is not None:
                        show(event)
                    case event:
                        self._settings.say(line(event), event_dict(event))
        except StopIteration as end:
            state = "done"
            return end.value
        except RigError as error:
            state, failure, text = "failed", error.problem, error.problem.detail
            raise
        finally:
            steps.close()  # the table stops before the operator hears that the job has ended
            if self.config.notify_command:
                job = {"kind": kind, "state": state, "error": failure, "result": result}
                notify_of_job(self.config.notify_command, self._settings.bench_name, kind, text, job)
