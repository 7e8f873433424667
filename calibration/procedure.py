"""A calibration procedure: it measures on a bench, evaluates the data, and yields results.

A procedure is a dataclass of its options. `Procedure.measure` moves the bench, yields events, and returns an
`Evaluation`, which becomes a dated `CalibrationResult`. The function ``evaluate`` of each module fits the data without
a bench.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, fields
from typing import Any, ClassVar, Self

from calibration.outcome import as_json, in_force, outcome_text
from rig.bench import Bench, calibrate
from rig.calibrations import (
    CalibrationRejection,
    CalibrationResult,
    CalibrationStore,
    Contribution,
    Estimate,
    RejectionCode,
)
from rig.catalog import log
from rig.charts.xy import Chart
from rig.core.errors import LimitExceeded
from rig.core.phrases import filled
from rig.events.events import Event
from rig.jobs.desk import Desk, JobResult, Progress, Remark, Steps
from rig.jobs.regions import warn_of_other_regions
from rig.motion.move import Move
from rig.motion.turntable import Turntable
from rig.plans.operator import Choice, Question, Subject

Plot = Callable[[CalibrationResult], Chart | None]


@dataclass(frozen=True, slots=True)
class Ask:
    """A request to the operator; the procedure continues when the next event is requested."""

    words: str


@dataclass(slots=True, kw_only=True)
class Evaluation:
    """The result of a fit: the part of a `CalibrationResult` that does not depend on date and device."""

    name: str
    residual_unit: str = ""
    limit: float | None = None
    residual: float | None = None
    estimates: dict[str, Estimate] = field(default_factory=dict)
    proposed: dict[str, Any] = field(default_factory=dict)
    """Settings to apply if the calibration passes."""
    evidence: dict[str, Any] = field(default_factory=dict)
    rejections: list[CalibrationRejection] = field(default_factory=list)

    @property
    def passed(self) -> bool:
        return not self.rejections

    @property
    def settings(self) -> dict[str, Any]:
        """The settings to apply; none unless the calibration passed."""
        return self.proposed if self.passed else {}

    def reject_if(self, condition: object, code: RejectionCode, **values: Any) -> None:
        """Add a rejection with the numbers that its words need, if ``condition`` is true."""
        if condition:
            self.reject(code, **values)

    def reject_above(self, limit: float, code: RejectionCode, **values: Any) -> None:
        """Add a rejection if the first of its numbers is above a limit: the words get ``rms_px`` and ``limit_px``."""
        name, value = next(iter(values.items()))
        unit = name.partition("_")[2]
        self.reject_if(value > limit, code, **values, **{f"limit_{unit}" if unit else "limit": limit})

    def reject(self, code: RejectionCode, **values: Any) -> Self:
        """Add a rejection with the numbers that its words need, and return the evaluation."""
        # as Python numbers, because a result is compared with the one that is read from its file
        plain = {key: value.item() if hasattr(value, "item") else value for key, value in values.items()}
        self.rejections.append(CalibrationRejection(code, plain))
        return self

    def estimate(self, name: str, value: Any, unit: str, *budget: Contribution) -> Estimate:
        """Add an estimate with the contributions to its uncertainty, and return it."""
        self.estimates[name] = found = Estimate(float(value), budget, unit)
        return found

    def result(self, **about: Any) -> CalibrationResult:
        """Return the dated result; ``about`` are the attributes of `CalibrationResult` that an evaluation lacks."""
        own = {item.name: getattr(self, item.name) for item in fields(self) if item.name != "proposed"}
        own |= {"rejections": tuple(self.rejections), "settings": self.settings}
        return CalibrationResult(**{"reference": "", "operator": "", "device": {}} | own | about)


Measured = Generator[Event | Ask | Progress, None, Evaluation]


class Procedure(ABC):
    """A calibration procedure; subclasses are dataclasses of their options."""

    result_name: ClassVar[str]
    """Name of the result."""
    reference: ClassVar[str]
    """What the quantity is compared with, in words: a template of the procedure's options."""
    devices: ClassVar[tuple[str, ...]]
    """The devices that the result is bound to."""
    valid_days: ClassVar[float]
    """Days for which the result is valid."""
    requires: ClassVar[tuple[str, ...]] = ()
    """Names of the results that must be in force; `measure` gets them in this order."""
    plots: ClassVar[Sequence[Plot]] = ()
    """Functions that draw the result, the main plot first; they return None if there is nothing to draw."""

    @abstractmethod
    def measure(self, bench: Bench, *required: CalibrationResult) -> Measured:
        """Measure on the bench, yield events, and return the evaluation.

        Raises `UsageError`: an option is out of range; before anything moves. `LimitExceeded`: the cable leaves too
        little room; before anything moves. `ViewRejected`, `MotionTimeout`, `DeviceFault`, `DeviceSilent`: see
        `rig.views.capture` and `rig.motion.turntable`.
        """

    def live(
        self, bench: Bench, *required: CalibrationResult
    ) -> Generator[Event | Ask | Progress | CalibrationResult, None, None]:
        """Calibrate the bench: yield events, and then the result. Raises what `measure` raises."""
        when_utc = bench.clock.utc()
        found = yield from self.measure(bench, *required)
        yield found.result(
            when_utc=when_utc,
            reference=filled(self.reference, **vars(self)),
            operator=log.operator(),
            device=bench.apparatus(*self.devices),
            valid_days=self.valid_days,
        )


def calibrated(desk: Desk, procedures: Sequence[Procedure]) -> Steps[bool]:
    """Run procedures one after the other, and store each result; return whether all of them passed.

    A result that passed is in force for the next procedure. The first that does not pass ends the job.
    """
    with desk.open_bench() as bench:
        store = CalibrationStore(bench.config.calibration_path(bench.name))
        for procedure in procedures:
            passed = yield from _measured(desk, bench, store, procedure)
            if not passed:
                return False
            reported, region = bench.calibration_findings, bench.config.view.roi
            calibrate(bench, store)
            for finding in bench.calibration_findings:
                if finding not in reported:  # a setting in the configuration takes precedence
                    yield Remark(f"{finding}.")
            if bench.config.view.roi != region and desk.place.may_exist():
                with desk.open_to_read() as catalog:
                    yield from warn_of_other_regions(bench, catalog)
    return True


def _measured(desk: Desk, bench: Bench, store: CalibrationStore, procedure: Procedure) -> Steps[bool]:
    """Run one procedure, and store its result; return whether it passed."""
    required = [in_force(bench, name) for name in procedure.requires]
    with closing(procedure.live(bench, *required)) as steps:
        for step in steps:
            if isinstance(step, CalibrationResult):
                path = store.add(step)
                then = ", in force from now on." if step.passed else "; earlier results stay in force."
                outcome = {"event": "calibrated", "passed": step.passed, "id": step.id, "file": str(path)}
                yield JobResult({**outcome, **as_json(step)}, f"{outcome_text(step)}\nStored in {path}{then}")
                if not step.passed:
                    return False
            elif isinstance(step, Ask):
                question = Question(Subject.CALIBRATION, step.words)
                if not desk.operator.is_there:
                    yield Remark(step.words, is_warning=False)
                elif desk.operator.choose(question) is Choice.STOP:
                    return False
            else:
                yield step
    return True


@contextmanager
def returning(table: Turntable) -> Iterator[Callable[[float], Move]]:
    """Yield the function that rotates the table; return to the start angle at the end of the ``with`` block.

    The table also returns when the generator around the block is closed. After an error or an interruption nothing
    moves: the table stays where it stopped, without torque.
    """
    start_deg = table.return_deg

    def go_back() -> None:
        table.goto(start_deg)
        table.approach(start_deg)

    try:
        yield table.goto
    except GeneratorExit:
        go_back()
        raise
    go_back()


def lower_end(bench: Bench, start_deg: float, length_deg: float) -> float:
    """Return the lower end of a range of ``length_deg`` that begins or ends at ``start_deg``, within the cable budget.

    Raises `LimitExceeded` if the cable leaves too little room.
    """
    low, high = bench.config.table.limits_deg
    lower = start_deg if start_deg + length_deg <= high else start_deg - length_deg
    if lower < low:
        raise too_little_room(bench, f"{length_deg:g}°")
    return lower


def too_little_room(bench: Bench, needed: str) -> LimitExceeded:
    """Return the error of a cable budget below the ``needed`` one."""
    low, high = bench.config.table.limits_deg
    return LimitExceeded(
        f"The cable leaves {high - low:.0f}°, the procedure needs {needed}.",
        next_step="If the cable is long enough, widen table.limits_deg.",
        evidence={"limits_deg": [low, high]},
    )
