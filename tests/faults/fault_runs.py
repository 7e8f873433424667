"""Enrollments and identifications under simulated faults, and checks of their outcomes."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

from sqlalchemy import func, select

from hbr.core.angles import wrap180
from rig.bench import Bench
from rig.catalog import Catalog, Enrollment, View, derived
from rig.config import load_config
from rig.core.clock import seconds_between
from rig.core.errors import RigError
from rig.events.events import Accepted, Enrolled, Event, Identified
from rig.plans.enroll import enroll
from rig.plans.identify import identify
from rig.safety.saved_state import MemoryStore
from rig.search.model import Model, model_of
from sim.bench import ShelfOperator, open_sim_bench
from sim.devices import SimDevices
from sim.faults import Fault, Faults
from sim.noise import NoiseModel
from sim.objects.shelf import shelf
from sim.world import World
from tests.faults.angle_code import Coded, coded_deg
from tests.small import SMALL

VIEWS = 72
SHORT = 5
"""Views of an enrollment that may be short."""
LATE = 12
"""Views of an enrollment that detects the fault only at its end, or only in a large move."""
NAME = "toy-car"
KNOWN = (NAME, "cereal-puzzle", "dice")
NOISE = NoiseModel(full_well_e=0, read_noise_e=0)
"""The bench's noise without that of the pixels, which takes most of the time and changes nothing here."""
STILL_S = 1.0
"""Longer than the servo's watchdog needs to stop the table."""


def objects() -> dict[str, Coded]:
    return {name: Coded(shelf()[name]) for name in KNOWN}


class LastingState(MemoryStore):
    """The state of benches that are opened one after the other, as if each had a program of its own."""

    outlasts_program = True


@dataclass
class Rig:
    """Simulated devices that several benches open one after the other, and a catalog on a real disk."""

    devices: SimDevices
    operator: ShelfOperator
    folder: Path
    settings: tuple[str, ...] = SMALL

    def bench(self, *faults: str) -> Bench:
        scheduled = [Fault.parse(text) for text in faults]
        return open_sim_bench(load_config(None, self.settings), self.operator, faults=scheduled, devices=self.devices)

    @contextmanager
    def opened(self, *faults: str) -> Iterator[tuple[Bench, Catalog]]:
        with self.bench(*faults) as bench, Catalog.open(self.folder, clock=bench.clock) as catalog:
            yield bench, catalog

    @property
    def world(self) -> World:
        return self.devices.world

    @property
    def faults(self) -> Faults:
        assert self.operator.faults is not None
        return self.operator.faults

    @property
    def torque(self) -> bool:
        """Whether the servo's torque is on, from its register."""
        return bool(self.devices.servo.memory["Torque Enable"])


@contextmanager
def new_rig(folder: Path, *settings: str, seed: int = 7) -> Iterator[Rig]:
    world = World(noise=NOISE, seed=seed)
    settings = (*SMALL, *settings)
    config = load_config(None, settings)
    with SimDevices.connected(config, world) as devices:
        operator = ShelfOperator(world, objects())
        operator.state = LastingState()
        rig = Rig(devices, operator, folder, settings)
        try:
            yield rig
        finally:
            if rig.operator.faults:
                rig.operator.faults.clear()


@dataclass
class Outcome:
    """Events and error of a plan; ``found_s`` is the time from the first fault to the end, when the torque is off."""

    events: list[Event] = field(default_factory=list)
    error: RigError | None = None
    found_s: float = 0.0

    @property
    def code(self) -> int | None:
        return None if self.error is None else self.error.code

    @property
    def stored(self) -> set[int]:
        """Indices of the views that were reported as stored."""
        return {event.index for event in self.events if isinstance(event, Accepted)}


@contextmanager
def _outcome(rig: Rig) -> Iterator[Outcome]:
    """Yield an outcome for the caller to fill in; store an error in it."""
    outcome = Outcome()
    try:
        yield outcome
    except RigError as error:
        outcome.error = error
    began_ns = next((occurrence.time_ns for occurrence in rig.faults.history if occurrence.began), None)
    if began_ns is not None:
        outcome.found_s = seconds_between(began_ns, rig.world.clock.now_ns())


def enrollment(
    rig: Rig,
    *faults: str,
    resume: bool = False,
    replace: bool = False,
    views: int = VIEWS,
    at_most: int | None = None,
) -> Outcome:
    """Enroll, at most ``at_most`` views of the plan if it is given."""
    with _outcome(rig) as outcome, rig.opened(*faults) as (bench, catalog):
        plan = enroll(bench, catalog, NAME, views=None if resume else views, resume=resume, replace=replace)
        for event in plan:
            outcome.events.append(event)
            if len(outcome.stored) == at_most:
                plan.close()
    return outcome


def identification(rig: Rig, *faults: str) -> Outcome:
    rig.operator.next_object, rig.operator.yaw_deg = NAME, 77.0
    with _outcome(rig) as outcome, rig.opened(*faults) as (bench, _):
        outcome.events.extend(identify(bench, known_views()))
    return outcome


@cache
def known_views() -> Model:
    """Return the views of three objects, enrolled without a fault."""
    with TemporaryDirectory() as folder, new_rig(Path(folder), seed=1) as rig, rig.opened() as (bench, catalog):
        for name in KNOWN:
            for _ in enroll(bench, catalog, name, views=6):
                pass
        return model_of(derived.views(catalog))


def check_stored(
    rig: Rig,
    expected: set[int],
    *,
    tolerance_deg: float,
    planned: int = VIEWS,
    offset: bool = False,
    shown: bool = True,
) -> None:
    """Check that the expected views are stored and complete, each with the azimuth that its image shows.

    With ``offset``, all azimuths may differ by one angle. Without ``shown``, images may show no angle.
    """
    with Catalog.open(rig.folder, clock=rig.world.clock) as catalog:
        stored = newest_views(catalog)
        assert {view.index for view in stored} == expected
        offset_deg = 0.0
        for view in stored:
            image = catalog.read_image(view.image)
            true_deg = coded_deg(image)
            assert true_deg is not None or not shown, f"view {view.index} shows no object"
            error_deg = 0.0 if true_deg is None else float(wrap180(view.azimuth_deg + true_deg - offset_deg))
            if offset and view is stored[0]:
                offset_deg, error_deg = error_deg, 0.0
            assert abs(error_deg) <= tolerance_deg, f"view {view.index} is {error_deg:+.2f}° off"
            planned_deg = -view.index * 360.0 / planned
            assert abs(wrap180(view.azimuth_deg - planned_deg)) <= 1.0


def newest_views(catalog: Catalog) -> Sequence[View]:
    """Return the views of the newest enrollment, complete or not."""
    with catalog.reading() as state:
        newest = state.transaction.scalar(select(func.max(Enrollment.id)))
        found = state.enrollments(Enrollment.id == newest)
        return found[0].enrollment.views if found else ()


def check_stands(rig: Rig) -> None:
    """Check that the table stops and does not move again."""
    rig.world.clock.sleep(STILL_S)
    before = rig.world.shaft()
    assert before[1] == 0
    rig.world.clock.sleep(STILL_S)
    assert rig.world.shaft() == before


def answer(outcome: Outcome) -> Identified | None:
    last = outcome.events[-1] if outcome.events else None
    return last if isinstance(last, Identified) else None


def enrolled(outcome: Outcome) -> bool:
    return bool(outcome.events) and isinstance(outcome.events[-1], Enrolled)
