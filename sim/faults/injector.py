"""Makes faults happen at their time."""

from collections.abc import Callable
from dataclasses import dataclass

from sim.clock import Timer
from sim.faults.kind import End
from sim.faults.schedule import Fault, Trigger
from sim.parts import SimParts
from sim.world import Happening

DURING_S = 0.1
"""A fault "during" a move begins so long after the shaft has set off: a step of 5° takes 0.3 s."""


@dataclass(frozen=True, slots=True)
class Occurrence:
    """That a fault began or ended, and when on the bench's clock."""

    fault: Fault
    began: bool
    time_ns: int


class Faults:
    """The faults of one bench.

    Views and moves are counted from 0 as the world sees them: move k is the first time that the shaft sets off before
    view k, and view k the first frame that is fetched after it. So the numbers are those of a plan's events, for the
    first plan on a bench.

    Attributes
    ----------
    history
        What has happened so far.
    listeners
        Called with each `Occurrence`.
    """

    def __init__(self, parts: SimParts) -> None:
        self.history: list[Occurrence] = []
        self.listeners: list[Callable[[Occurrence], None]] = []
        self._parts = parts
        self._clock = parts.world.clock
        self._waiting: list[Fault] = []
        self._timers: list[Timer] = []
        self._active: dict[int, tuple[Fault, End]] = {}
        self._views = 0
        self._moved = True
        self._set_off_for = -1
        self._begun = 0
        parts.world.watchers.append(self._notice)

    def schedule(self, *faults: Fault) -> None:
        """Let faults happen at their time; those whose time has come happen now."""
        for fault in faults:
            if fault.trigger is not Trigger.AT:
                self._waiting.append(fault)
            elif (at_ns := round(fault.mark * 1e9)) <= self._clock.now_ns():
                self._begin(fault)
            else:
                self._at(at_ns, fault)

    @property
    def active(self) -> tuple[Fault, ...]:
        """What is wrong now."""
        return tuple(fault for fault, _ in self._active.values())

    def clear(self) -> None:
        """End what is wrong and forget what was to come: somebody has mended the bench."""
        self._waiting.clear()
        for timer in self._timers:
            timer.cancel()
        self._timers.clear()
        for number in list(self._active):
            self._end(number)

    # -- inside ---------------------------------------------------------------------------------------------------

    def _notice(self, happening: Happening) -> None:
        now_ns = self._clock.now_ns()
        if happening is Happening.SET_OFF:
            self._moved = True
            if self._set_off_for == self._views:
                return  # another stop on the way of the same move
            self._set_off_for = self._views
            self._due(Trigger.MOVE, self._views, now_ns + round(DURING_S * 1e9))
        elif self._moved:  # not a frame that is taken again
            self._moved = False
            self._due(Trigger.VIEW, self._views, now_ns + 1)
            self._views += 1

    def _due(self, trigger: Trigger, number: int, at_ns: int) -> None:
        due = [fault for fault in self._waiting if fault.trigger is trigger and fault.mark == number]
        for fault in due:
            self._waiting.remove(fault)
            self._at(at_ns, fault)

    def _at(self, at_ns: int, fault: Fault) -> None:
        self._timers.append(self._clock.call_at(at_ns, lambda: self._begin(fault)))

    def _begin(self, fault: Fault) -> None:
        number = self._begun
        self._begun += 1
        rng = self._parts.world.rng(f"fault {number} {fault.kind.name}")
        self._tell(fault, began=True)
        self._active[number] = fault, fault.kind.begin(self._parts, fault.values, rng)
        if fault.for_s is not None:
            at_ns = self._clock.now_ns() + round(fault.for_s * 1e9)
            self._timers.append(self._clock.call_at(at_ns, lambda: self._end(number)))

    def _end(self, number: int) -> None:
        if number in self._active:
            fault, end = self._active.pop(number)
            end()
            self._tell(fault, began=False)

    def _tell(self, fault: Fault, *, began: bool) -> None:
        occurrence = Occurrence(fault, began, self._clock.now_ns())
        self.history.append(occurrence)
        for listener in self.listeners:
            listener(occurrence)
