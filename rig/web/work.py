"""The work of each kind of job on the bench."""

from collections.abc import Callable, Generator
from contextlib import closing
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Final, Protocol, assert_never

from rig.bench import Bench, ObjectAlreadyPlaced, TableClearer
from rig.calibrations import CalibrationResult
from rig.catalog import Catalog, ObjectSummary
from rig.catalog.shared import comparable_views, journal_words
from rig.config import RigConfig
from rig.core.clock import SystemClock
from rig.core.errors import RigError, TableNotEmpty, UsageError, ViewRejected
from rig.core.phrases import counted, duration_words
from rig.events.events import Enrolled, Event, FrameUsed, Identified, Started, event_dict, plain
from rig.events.lines import line
from rig.motion.turntable import Turntable
from rig.plans.capture import announced, moved
from rig.plans.enroll import enroll
from rig.plans.estimate import dry_run
from rig.plans.identify import identify
from rig.plans.photograph_table import photograph_table
from rig.plans.record import ResultRecorder
from rig.plans.similar_objects import similar_objects
from rig.plans.tray import TrayDecision, TrayItem, enroll_tray
from rig.plans.watch import watch
from rig.search.current_model import CurrentModel
from rig.search.model import Model
from rig.search.saved_run import RunSaver
from rig.search.strategies import descriptor_for
from rig.search.strategies import strategy as strategy_named
from rig.views.description import PAPER_DESCRIPTOR
from rig.views.empty_table import empty_table_status
from rig.views.object_presence import TableWatcher
from rig.web.bench_catalog import BenchCatalog
from rig.web.requests import (
    AcknowledgeRequest,
    CalibrateRequest,
    Choice,
    DoctorRequest,
    DryRunRequest,
    EmptyTableRequest,
    EnrollRequest,
    GotoRequest,
    HomeRequest,
    IdentifyRequest,
    Job,
    ReferenceRequest,
    TrayRequest,
)
from rig.web.worker import Context, Work

CALIBRATIONS: Final = "rig.calibrations"
"""Entry-point group of the calibrations: functions that yield the steps of a calibration."""

_DECISIONS: Final = {
    Choice.CONTINUE: TrayDecision.PROCEED,
    Choice.RESTART: TrayDecision.RESTART,
    Choice.SKIP: TrayDecision.SKIP,
    Choice.STOP: TrayDecision.STOP,
}


class Calibration(Protocol):
    """A calibration that a job can run on the bench, if necessary with an object that the request names."""

    @property
    def title(self) -> str: ...

    def __call__(self, bench: Bench, thing: str | None) -> Generator["CalibrationStep", None, None]: ...


@dataclass(frozen=True, slots=True)
class CalibrationStep:
    """A step of a calibration: a text that the operator may have to ``confirm``, an event of a plan, or a result."""

    text: str
    confirm: bool = False
    event: Event | None = None
    result: CalibrationResult | None = None


def calibrations() -> dict[str, Calibration]:
    """Return the installed calibrations by name."""
    return {point.name: point.load() for point in sorted(entry_points(group=CALIBRATIONS), key=lambda p: p.name)}


@dataclass(slots=True)
class WorkFactory:
    """A factory of the work of a job.

    Parameters
    ----------
    catalog
        Opens the bench's catalog.
    runs
        Folder of the saved runs.
    examine
        Yields the findings of the doctor as JSON values; called while the bench is closed.
    seed
        For strategies that draw random numbers.
    """

    catalog: BenchCatalog
    runs: Path
    examine: Callable[[], Generator[dict[str, Any], None, None]]
    seed: int = 0

    def __call__(self, job: Job) -> Work:
        request = job.request
        match request:
            case EnrollRequest():
                return lambda context: self._enroll(context, request)
            case TrayRequest():
                return lambda context: self._tray(context, request)
            case DryRunRequest():
                return lambda context: self._dry_run(context, request)
            case IdentifyRequest():
                return lambda context: self._identify(context, request)
            case EmptyTableRequest():
                return lambda context: _run(context, photograph_table(context.bench, anyway=request.anyway))
            case GotoRequest():
                return lambda context: self._rotate(context, request.angle_deg)
            case HomeRequest():
                return lambda context: self._rotate(context, 0.0)
            case ReferenceRequest():
                return lambda context: _refer(context, request)
            case AcknowledgeRequest():
                return lambda context: _acknowledge(context, reboot=request.reboot)
            case DoctorRequest():
                return self._examine
            case CalibrateRequest():
                return lambda context: _calibrate(context, request.name, request.object)
            case _:
                assert_never(request)

    def _enroll(self, context: Context, request: EnrollRequest) -> None:
        bench = context.bench
        with self.catalog.open_to_enroll(bench.clock) as catalog:
            _check_free(catalog, request)
            _refresh_empty_table(context)
            events = enroll(
                bench,
                catalog,
                request.name,
                views=request.views,
                label=request.label,
                note=request.note,
                resume=request.resume,
                replace=request.replace,
            )
            self._run_enrollment(context, catalog, events)

    def _tray(self, context: Context, request: TrayRequest) -> None:
        items = tuple(
            TrayItem(number, one.name, one.label, one.note, one.views) for number, one in enumerate(request.objects, 1)
        )
        with self.catalog.open_to_enroll(context.bench.clock) as catalog:
            _refresh_empty_table(context)
            events = enroll_tray(context.bench, catalog, items, views=request.views, operator=_BrowserOperator(context))
            self._run_enrollment(context, catalog, events)

    def _run_enrollment(self, context: Context, catalog: Catalog, events: Generator[Event, None, object]) -> None:
        """Report the events; name similar objects, and deliver each object to the server of the catalog, if any."""
        with closing(events):
            for event in events:
                if isinstance(event, Enrolled):  # it is stored now; Enrolled stays its last event
                    _report(context, similar_objects(comparable_views(catalog, event.name), event.name))
                _report(context, event)
                if isinstance(event, Started) and (words := journal_words(catalog)):
                    context.note(words)
                if isinstance(event, Enrolled):
                    for words in self.catalog.deliver():
                        context.note(words)
                        context.job.result_text = f"{context.job.result_text}\n{words}"

    def _dry_run(self, context: Context, request: DryRunRequest) -> None:
        names = {one.name: one.views for one in request.objects}
        with self.catalog.open_to_enroll(context.bench.clock) as catalog:
            found = dry_run(
                context.bench, catalog, names, views=request.views, resume=request.resume, replace=request.replace
            )
        context.job.result = {"dry_run": plain(found)}
        views, seconds = sum(one.views for one in found), sum(one.seconds for one in found)
        context.job.result_text = (
            f"{counted(len(found), 'object')}, {counted(views, 'view')}, about {duration_words(seconds)}. "
            "Nothing was moved or stored."
        )

    def _identify(self, context: Context, request: IdentifyRequest) -> None:
        bench, before = context.bench, context.bench.config
        if request.max_views is not None:
            update = {"identify": before.identify.limited_to(request.max_views)}
            bench.config = before.model_copy(update=update)
        name = request.strategy or bench.config.identify.strategy
        chosen = None if name is None else strategy_named(name)
        operator = bench.operator
        try:
            with (
                self.catalog.open_to_read() as catalog,
                CurrentModel(catalog, None if chosen is None else descriptor_for(chosen)) as model,
            ):
                known = model()  # report a catalog that cannot be searched before anything moves
                if request.watch and isinstance(operator, ObjectAlreadyPlaced):
                    bench.operator = TableWatcher(bench)
                if known.descriptor != PAPER_DESCRIPTOR and known.with_empty_table is not False:
                    _refresh_empty_table(context)
                events: Generator[Event, None, object]
                if request.watch:
                    events = watch(bench, model, strategy=chosen, seed=self.seed, live=context.add)
                else:
                    events = identify(bench, known, strategy=chosen, seed=self.seed, live=context.add)
                if bench.config.identify.record != "none":
                    recorder = ResultRecorder(
                        *(self.catalog.place, bench),
                        clock=SystemClock(),
                        catalog_version=lambda: model.version,
                        operator=context.job.operator,
                        with_image=bench.config.identify.record == "image",
                    )
                    recorder.sample = request.sample
                    events = recorder.stream(events)
                _run(context, _saved(context, self.runs, events, model))
        finally:
            bench.config, bench.operator = before, operator

    def _rotate(self, context: Context, angle_deg: float) -> None:
        def steps() -> Generator[Event, None, None]:
            with Turntable(context.bench) as table:
                yield moved(0, (yield from announced(0, table, angle_deg, asked_deg=angle_deg)))

        _run(context, steps())

    def _examine(self, context: Context) -> None:
        context.close_bench()  # the checks open the devices themselves
        findings = []
        with closing(self.examine()) as found:
            for finding in found:
                findings.append(finding)
                context.note(f"{finding['topic']}: {finding['finding']}")
        context.job.result = {"findings": findings}
        bad = sum(finding["level"] == "bad" for finding in findings)
        context.job.result_text = f"{bad or 'No'} problem{'s' * (bad != 1)} found."


class _BrowserOperator:
    """Asks the questions of a tray in the browser."""

    def __init__(self, context: Context) -> None:
        self._context = context

    def request(self, item: TrayItem, number: int, of: int, interrupted: ObjectSummary | None) -> TrayDecision:
        if interrupted is None:
            text = f"{number} of {of}: put {item.name} on the table and take your hands away."
            return self._ask(text, (Choice.CONTINUE, Choice.SKIP, Choice.STOP))
        text = (
            f"{number} of {of}: {item.name} has {interrupted.unfinished_views or 0} views of an interrupted "
            "enrollment. Continue it if the object was not moved; restart it otherwise."
        )
        return self._ask(text, (Choice.CONTINUE, Choice.RESTART, Choice.SKIP, Choice.STOP))

    def decide_after_error(self, item: TrayItem, error: RigError) -> TrayDecision:
        text = f"{item.name}: {error.what} {error.next_step}"
        return self._ask(text, (Choice.CONTINUE, Choice.SKIP, Choice.STOP))

    def _ask(self, text: str, choices: tuple[Choice, ...]) -> TrayDecision:
        return _DECISIONS[self._context.asked(text, choices)]


def _run(context: Context, events: Generator[Event, None, object]) -> None:
    """Report the events of a plan; an operator who cancels closes the plan, and so the torque goes off."""
    with closing(events):
        for event in events:
            if not isinstance(event, FrameUsed):  # reported during the rotation
                _report(context, event)


def _report(context: Context, event: Event) -> None:
    context.add(event)
    if isinstance(event, Enrolled | Identified):
        context.job.result, context.job.result_text = event_dict(event), line(event)


def _saved(
    context: Context, runs: Path, events: Generator[Event, None, object], model: Callable[[], Model]
) -> Generator[Event, None, None]:
    """Yield the events of searches, and save each search in its own folder."""

    def next_folder() -> Path:
        name = f"{context.bench.clock.utc():%Y%m%d-%H%M%S}-{context.job.id}"
        return runs / (name if not (runs / name).exists() else f"{name}-{context.job.views}")

    with closing(events), RunSaver(next_folder, context.bench, model) as saver:
        for event in events:
            saver.add(event)
            if saver.folder is not None:
                context.job.run = saver.folder.name
            yield event


def _check_free(catalog: Catalog, request: EnrollRequest) -> None:
    """Reject a name that is in use before the table is cleared or moves."""
    known = {summary.name: summary for summary in catalog.known_objects()}.get(request.name)
    if known is None or request.resume or request.replace:
        return
    if known.unfinished_views is not None:
        raise UsageError(
            f"{request.name} has an interrupted enrollment with {known.unfinished_views} views.",
            next_step="Continue it, or enroll the object again.",
        )
    if known.views:
        raise UsageError(
            f"{request.name} is enrolled already, with {known.views} views.",
            next_step="Choose another name, or enroll it again. The old views stay in use until the new ones are "
            "complete.",
        )


def _refresh_empty_table(context: Context) -> None:
    """Take an empty-table image if it is old and the operator of the bench can clear the table by itself."""
    bench = context.bench
    status = empty_table_status(bench)
    if bench.config.table.carries == "camera" or (status.table is not None and not status.problems):
        return
    if isinstance(bench.operator, TableClearer) and bench.operator.clear():
        try:
            _run(context, photograph_table(bench))
        except (TableNotEmpty, ViewRejected) as error:  # the job can continue without the image
            context.note(f"{error.what} {error.next_step}")


def _acknowledge(context: Context, *, reboot: bool) -> None:
    safety = context.bench.safety
    fault = safety.fault
    state = safety.acknowledge(reboot=reboot)
    context.job.result = {"acknowledged": fault.model_dump() if fault else None, "state": str(state)}
    context.job.result_text = f"Acknowledged: {fault.what}" if fault else "No fault was latched."


def _refer(context: Context, request: ReferenceRequest) -> None:
    if request.here == (request.revolutions is not None):
        raise UsageError("revolutions and here are both given, or both missing.", next_step="Give one of them.")
    safety = context.bench.safety
    if request.revolutions is None:
        safety.set_angle(0.0)
    else:
        safety.set_revolutions(request.revolutions)
    context.job.result_text = "The table's angle is set."


def _calibrate(context: Context, name: str, thing: str | None) -> None:
    found = calibrations()
    if name not in found:
        raise UsageError(f"There is no calibration {name!r}.", next_step=f"Choose one of {', '.join(found)}.")
    results = []
    with closing(found[name](context.bench, thing)) as steps:
        for step in steps:
            if step.event is not None:
                context.add(step.event)
            elif step.confirm:
                if context.asked(step.text, (Choice.CONTINUE, Choice.STOP)) is Choice.STOP:
                    return
            else:
                context.note(step.text)
            if step.result is not None:
                results.append({"name": step.result.name, "passed": step.result.passed, "text": step.text})
    context.job.result = {"calibrations": results}
    context.job.result_text = "\n".join(str(one["text"]) for one in results)


def doctor_findings(
    bench: str, config: RigConfig, seed: int | None, options: tuple[str, ...]
) -> Generator[dict[str, Any], None, None]:
    """Yield the findings of the doctor about a bench that is not open."""
    from rig.doctor.checks import CHECKS
    from rig.doctor.context import open_context
    from rig.doctor.examination import run_checks

    with open_context(bench, config, seed=seed, options=options) as context:
        context.holder = None  # the holder is this program, which has closed its devices
        for finding in run_checks(context, CHECKS):
            yield finding.as_dict()
