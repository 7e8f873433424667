"""The work of each kind of job on the served bench: the jobs of `rig.jobs`, and how the pages show them."""

from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import AbstractContextManager, closing, nullcontext
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Final, Protocol, assert_never

from rig.bench import Bench
from rig.bench.bench import DEVICES
from rig.catalog import Action, Catalog
from rig.config import RigConfig
from rig.core.errors import UsageError
from rig.core.json_form import plain
from rig.core.phrases import counted, duration_words
from rig.events.events import Enrolled, Identified, event_dict
from rig.events.lines import line
from rig.jobs.desk import Desk, Progress, Remark, Result, Step, Steps
from rig.jobs.enroll import enroll, enroll_list, plan
from rig.jobs.identify import identify
from rig.jobs.table import acknowledge, goto, home, refer
from rig.jobs.table_image import take_table_image
from rig.plans.operator import Choice, Operator, Question
from rig.plans.tray import TrayItem
from rig.web.bench_catalog import BenchCatalog
from rig.web.requests import (
    AcknowledgeRequest,
    CalibrateRequest,
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
"""Entry-point group of the calibrations."""


class Calibration(Protocol):
    """A calibration that a job can run, if necessary with an object that the request names."""

    @property
    def title(self) -> str: ...

    def __call__(self, desk: Desk, thing: str | None) -> Steps[bool]: ...


def calibrations() -> dict[str, Calibration]:
    """Return the installed calibrations by name."""
    return {point.name: point.load() for point in sorted(entry_points(group=CALIBRATIONS), key=lambda p: p.name)}


class ServedDesk(Desk):
    """The desk of a job of the server: the bench is open, and the pages ask."""

    def __init__(self, context: Context, catalog: BenchCatalog) -> None:
        self.operator = _BrowserOperator(context)
        self.config = context.bench.config
        self.place = catalog.place
        self._bench = context.bench
        self._catalog = catalog

    def open_bench(self, devices: Iterable[str] = DEVICES) -> AbstractContextManager[Bench]:  # noqa: ARG002
        return nullcontext(self._bench)

    def who_places(self, bench: Bench) -> Operator:  # noqa: ARG002
        return self.operator

    def open_to_read(self) -> Catalog:
        return self._catalog.open_to_read()

    def log(self, action: Action, **details: Any) -> Iterator[Remark]:
        if self.place.url is None:  # waiting for a server that is away would delay the answer to a STOP
            yield from super().log(action, **details)


class _BrowserOperator:
    """Asks in the browser."""

    is_there = True

    def __init__(self, context: Context) -> None:
        self._context = context

    def choose(self, question: Question) -> Choice:
        return self._context.asked(question.text, tuple(question.choices))

    def ask_sample(self) -> str | None:
        return None  # the request names it


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
        if isinstance(job.request, DoctorRequest):
            return self._examine  # which opens the devices itself

        def work(context: Context) -> None:
            desk = ServedDesk(context, self.catalog)
            with closing(self._steps(context, desk)) as steps:
                for step in steps:
                    _show(context, step)

        return work

    def _steps(self, context: Context, desk: Desk) -> Steps[object]:
        """Return the job that a request asks for."""
        request = context.job.request
        match request:
            case EnrollRequest():
                values = request.model_dump(exclude={"kind", "name"})
                return enroll(desk, request.name, **values, ask=False)
            case TrayRequest():
                items = [
                    TrayItem(n, one.name, one.label, one.note, one.views) for n, one in enumerate(request.objects, 1)
                ]
                return enroll_list(desk, items, views=request.views, ask=False)
            case DryRunRequest():
                return _dry_run(desk, request)
            case IdentifyRequest():
                return identify(
                    desk,
                    strategy=request.strategy,
                    max_views=request.max_views,
                    seed=self.seed,
                    watch=request.watch,
                    sample=request.sample,
                    person=context.job.operator,
                    next_folder=lambda: self._next_folder(context),
                    live=context.add,
                )
            case EmptyTableRequest():
                return take_table_image(desk, anyway=request.anyway)
            case GotoRequest():
                return goto(desk, request.angle_deg)
            case HomeRequest():
                return home(desk)
            case ReferenceRequest():
                return refer(desk, revolutions=request.revolutions, here=request.here)
            case AcknowledgeRequest():
                return acknowledge(desk, reboot=request.reboot)
            case CalibrateRequest():
                return _calibrated(context, desk, request)
            case DoctorRequest():
                raise AssertionError
            case _:
                assert_never(request)

    def _next_folder(self, context: Context) -> Path:
        """Return the folder of the job's next saved run."""
        name = f"{context.bench.clock.utc():%Y%m%d-%H%M%S}-{context.job.id}"
        name = name if not (self.runs / name).exists() else f"{name}-{context.job.views}"
        context.job.run = name
        return self.runs / name

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


def _show(context: Context, step: Step) -> None:
    """Report a step of a job; an operator who cancels closes the job here, and so the torque goes off."""
    match step:
        case Remark(text=text, event=event):
            if event is None:
                context.note(text)
            else:
                context.add(event)
        case Progress():
            context.note(step.words)
        case Result():
            context.job.result, context.job.result_text = step.values, step.text
        case _:
            context.add(step)
            if isinstance(step, Enrolled | Identified):
                context.job.result, context.job.result_text = event_dict(step), line(step)


def _dry_run(desk: Desk, request: DryRunRequest) -> Steps[None]:
    names = {one.name: one.views for one in request.objects}
    found = plan(desk, names, views=request.views, resume=request.resume, replace=request.replace)
    views, seconds = sum(one.views for one in found), sum(one.seconds for one in found)
    yield Result(
        {"dry_run": plain(found)},
        f"{counted(len(found), 'object')}, {counted(views, 'view')}, about {duration_words(seconds)}. "
        "Nothing was moved or stored.",
    )


def _calibrated(context: Context, desk: Desk, request: CalibrateRequest) -> Steps[None]:
    """Run a calibration; its results are those of the job together."""
    found = calibrations()
    if request.name not in found:
        raise UsageError(f"There is no calibration {request.name!r}.", next_step=f"Choose one of {', '.join(found)}.")
    results: list[Result] = []
    with closing(found[request.name](desk, request.object)) as steps:
        for step in steps:
            if isinstance(step, Result):
                results.append(step)
                context.note(step.text)
            else:
                yield step
    values = [{"name": one.values["name"], "passed": one.values["passed"], "text": one.text} for one in results]
    yield Result({"calibrations": values}, "\n".join(one.text for one in results))


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
