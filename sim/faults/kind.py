"""An entry of the vocabulary: a name, what it does, its parameters, and how it begins and ends."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from rig.core.clock import seconds_between
from rig.core.errors import UsageError
from sim.clock import Timer, VirtualClock
from sim.parts import SimParts

DEVICES = ("servo", "imu", "camera")

End = Callable[[], None]
"""Takes the cause away; what it has done stays done."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """A number that a fault takes: its default, what it means (with its unit), and its range."""

    default: float
    meaning: str
    low: float = -float("inf")
    high: float = float("inf")


def share(default: float, of: str) -> Parameter:
    """Return a parameter that is a share between 0 and 1."""
    return Parameter(default, f"share of {of}", 0.0, 1.0)


Begin = Callable[[SimParts, Mapping[str, float], np.random.Generator], End]


@dataclass(frozen=True, slots=True)
class Kind:
    """What can go wrong.

    ``begin`` makes it happen in the given parts and returns what ends it. ``momentary`` faults are over at once; to end
    one undoes it as far as a person at the bench would.
    """

    name: str
    what: str
    parameters: Mapping[str, Parameter]
    begin: Begin

    def values(self, given: Mapping[str, float]) -> dict[str, float]:
        """Return all parameters, those not ``given`` at their defaults.

        Raises
        ------
        UsageError
            There is no such parameter, or its value is out of range.
        """
        for name, value in given.items():
            if name not in self.parameters:
                raise UsageError(
                    f"The fault {self.name} has no parameter {name!r}.",
                    next_step=f"Choose of {', '.join(self.parameters)}." if self.parameters else "Leave it out.",
                )
            parameter = self.parameters[name]
            if not parameter.low <= value <= parameter.high:
                raise UsageError(
                    f"{name} = {value:g} is out of range for the fault {self.name}.",
                    next_step=f"Give {parameter.low:g} to {parameter.high:g} ({parameter.meaning}).",
                )
        return {name: given.get(name, parameter.default) for name, parameter in self.parameters.items()}


registry: dict[str, Kind] = {}
"""Every fault that was entered by `kind`."""


def kind(name: str, what: str, **parameters: Parameter) -> Callable[[Begin], Begin]:
    """Enter a function into the vocabulary as the beginning of the fault ``name``."""

    def enter(begin: Begin) -> Begin:
        registry[name] = Kind(name, what, MappingProxyType(parameters), begin)
        return begin

    return enter


def repeatedly(clock: VirtualClock, period_s: float, action: Callable[[], None]) -> End:
    """Call ``action`` now and every ``period_s`` from now on; return what stops that."""
    timer: Timer | None = None

    def act() -> None:
        nonlocal timer
        timer = clock.call_at(clock.now_ns() + round(period_s * 1e9), act)
        action()

    def stop() -> None:
        if timer:
            timer.cancel()

    act()
    return stop


class Delay:
    """Holds things back for a time on the clock: `put` now, `newest` of those that are old enough."""

    def __init__(self, clock: VirtualClock, seconds: float) -> None:
        self._clock = clock
        self._seconds = seconds
        self._kept: list[tuple[int, bytes]] = []

    def through(self, value: bytes) -> bytes:
        """Put ``value`` in and return the newest that is old enough, or the oldest there is."""
        now_ns = self._clock.now_ns()
        self._kept.append((now_ns, value))
        while len(self._kept) > 1 and seconds_between(self._kept[1][0], now_ns) >= self._seconds:
            del self._kept[0]
        return self._kept[0][1]
