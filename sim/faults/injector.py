"""Injects simulated faults at their times."""

from collections.abc import Callable
from dataclasses import dataclass

from sim.clock import Timer
from sim.devices import SimDevices
from sim.faults.kind import End, Fault, FaultTrigger
from sim.world import Activity

DURING_S = 0.1  # within the ramp of every move
"""A fault "during" a move begins this long after the shaft has started; a step of 5° takes 0.3 s."""


@dataclass(frozen=True, slots=True)
class Occurrence:
    """The beginning or the end of a simulated fault, with its time on the bench's clock."""

    fault: Fault
    began: bool
    time_ns: int


class Faults:
    """The simulated faults of one bench.

    Moves and views are counted from 0 in the simulated world: move k is the first start of the shaft before view k, and
    view k is the first frame that is fetched after it. For the first plan on a bench these are the plan's numbers.

    ``history`` has every `Occurrence` so far; ``listeners`` are called with each.
    """

    def __init__(self, devices: SimDevices) -> None:
        self.history: list[Occurrence] = []
        self.listeners: list[Callable[[Occurrence], None]] = []
        self._devices = devices
        self._clock = devices.world.clock
        self._waiting: list[Fault] = []
        self._timers: list[Timer] = []
        self._active: dict[int, tuple[Fault, End | None]] = {}
        self._views = 0
        self._moved = True
        self._set_off_for = -1
        self._begun = 0
        devices.world.listeners.append(self._notice)

    def schedule(self, *faults: Fault) -> None:
        """Schedule faults for their times; a time that has passed means now."""
        for fault in faults:
            if fault.trigger is not FaultTrigger.AT:
                self._waiting.append(fault)
            elif (at_ns := round(fault.mark * 1e9)) <= self._clock.now_ns():
                self._begin(fault)
            else:
                self._at(at_ns, fault)

    @property
    def active(self) -> tuple[Fault, ...]:
        """The faults that have begun and not ended."""
        return tuple(fault for fault, _ in self._active.values())

    def end(self, name: str) -> bool:
        """End the active faults called ``name``; return whether there was one."""
        numbers = [number for number, (fault, _) in self._active.items() if fault.kind.name == name]
        for number in numbers:
            self._end(number)
        return bool(numbers)

    def clear(self) -> None:
        """End the active faults and cancel the scheduled ones, as if the bench had been repaired."""
        self._waiting.clear()
        for timer in self._timers:
            timer.cancel()
        self._timers.clear()
        for number in list(self._active):
            self._end(number)

    def _notice(self, activity: Activity) -> None:
        now_ns = self._clock.now_ns()
        if activity is Activity.MOTION_STARTED:
            self._moved = True
            if self._set_off_for == self._views:
                return  # the same move in several steps
            self._set_off_for = self._views
            self._due(FaultTrigger.MOVE, self._views, now_ns + round(DURING_S * 1e9))
        elif self._moved:  # the first frame of this view, not a repeated one
            self._moved = False
            self._due(FaultTrigger.VIEW, self._views, now_ns + 1)
            self._views += 1

    def _due(self, trigger: FaultTrigger, number: int, at_ns: int) -> None:
        due = [fault for fault in self._waiting if fault.trigger is trigger and fault.mark == number]
        for fault in due:
            self._waiting.remove(fault)
            self._at(at_ns, fault)

    def _at(self, at_ns: int, fault: Fault) -> None:
        self._timers.append(self._clock.call_at(at_ns, lambda: self._begin(fault)))

    def _begin(self, fault: Fault) -> None:
        number = self._begun
        self._begun += 1
        rng = self._devices.world.rng(f"fault {number} {fault.kind.name}")
        self._report(fault, began=True)
        self._active[number] = fault, fault.kind.begin(self._devices, rng, **fault.values)
        if fault.for_s is not None:
            at_ns = self._clock.now_ns() + round(fault.for_s * 1e9)
            self._timers.append(self._clock.call_at(at_ns, lambda: self._end(number)))

    def _end(self, number: int) -> None:
        if number in self._active:
            fault, end = self._active.pop(number)
            if end is not None:
                end()
            self._report(fault, began=False)

    def _report(self, fault: Fault, *, began: bool) -> None:
        occurrence = Occurrence(fault, began, self._clock.now_ns())
        self.history.append(occurrence)
        for listener in self.listeners:
            listener(occurrence)
