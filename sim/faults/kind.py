"""Kinds of simulated faults, and faults with their times in a short notation (``jam@move3+2s``).

Decision: docs/decisions/0001.
"""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from difflib import get_close_matches
from enum import Enum
from typing import Self, TypeVar

import numpy as np

from rig.core.errors import UsageError
from rig.core.next_steps import Do
from sim.clock import VirtualClock

F = TypeVar("F")
Rng = np.random.Generator

End = Callable[[], None]
"""A function that removes the cause of a fault; its consequences remain."""
Begin = Callable[..., End | None]
"""Starts a fault in the given `SimDevices`, with a generator of random numbers and the parameters by name.

Returns the function that ends it; None for a fault whose cause is over at once.
"""

_DEVICES = ("servo", "imu", "camera")
_OF_EVERY_DEVICE = ("off", "stuck", "garbage", "wrong", "slow", "delayed", "intermittent")


@dataclass(frozen=True, slots=True)
class Parameter:
    """A number that a fault takes: its default, its meaning with the unit, and its range."""

    default: float
    meaning: str
    low: float = -float("inf")
    high: float = float("inf")


def share(default: float, of: str) -> Parameter:
    """Return a parameter that is a share between 0 and 1."""
    return Parameter(default, f"share of {of}", 0.0, 1.0)


@dataclass(frozen=True, slots=True)
class FaultKind:
    """A kind of simulated fault; ``what`` describes it in a sentence."""

    name: str
    what: str
    parameters: Mapping[str, Parameter]
    begin: Begin

    def values(self, given: Mapping[str, float]) -> dict[str, float]:
        """Return all parameters, those not ``given`` at their defaults.

        Raises `UsageError` if the fault has no such parameter, or its value is out of range.
        """
        for name, value in given.items():
            if name not in self.parameters:
                raise UsageError(
                    f"The fault {self.name} has no parameter {name!r}.",
                    next_step=f"Use {', '.join(self.parameters)}." if self.parameters else "Remove the parameter.",
                )
            parameter = self.parameters[name]
            if not parameter.low <= value <= parameter.high:
                raise UsageError(
                    f"{name} = {value:g} is out of range for the fault {self.name}.",
                    next_step=f"Give {parameter.low:g} to {parameter.high:g} ({parameter.meaning}).",
                )
        return {name: given.get(name, parameter.default) for name, parameter in self.parameters.items()}


registry: dict[str, FaultKind] = {}
"""All kinds that `simulated_fault` registered, by name."""


def simulated_fault(name: str, what: str, **parameters: Parameter) -> Callable[[Begin], Begin]:
    """Register a function as the beginning of the fault ``name``: a decorator, or called with a lambda."""

    def register(begin: Begin) -> Begin:
        registry[name] = FaultKind(name, what, parameters, begin)
        return begin

    return register


def fault_kinds() -> dict[str, FaultKind]:
    """Return all kinds by name: first the faults that every device can have, then the others."""
    common = [f"{device}.{word}" for device in _DEVICES for word in _OF_EVERY_DEVICE]
    return {name: registry[name] for name in dict.fromkeys([*common, *registry])}


def find_fault(name: str) -> FaultKind:
    """Return the kind called ``name``.

    Raises `UsageError`: no kind has that name; the next step names the most similar ones.
    """
    if name in registry:
        return registry[name]
    of_devices = [f"{device}.{name}" for device in _DEVICES if f"{device}.{name}" in registry]
    near = of_devices or get_close_matches(name, fault_kinds(), n=2, cutoff=0.5)
    raise UsageError(
        f"There is no fault {name!r}.",
        next_step=f"Did you mean {' or '.join(near)}?" if near else Do.LIST_FAULTS(),
    )


# -- what most faults do ----------------------------------------------------------------------------------------------


def switched(thing: object, attribute: str, value: object, back: object) -> End:
    """Set an attribute; return the function that sets it ``back``."""
    setattr(thing, attribute, value)
    return lambda: setattr(thing, attribute, back)


def added(functions: list[F], function: F) -> End:
    """Add a function to those that a device calls; return the function that removes it."""
    functions.append(function)
    return lambda: functions.remove(function)


def repeatedly(clock: VirtualClock, period_s: float, action: Callable[[], None]) -> End:
    """Call ``action`` now and every ``period_s`` from now on; return the function that stops it."""
    action()
    return clock.every(period_s, action)


# -- faults with their times ------------------------------------------------------------------------------------------

NOTATION = "NAME[:PARAMETER=VALUE...][@TIME[+2s]], where TIME is 12s, move3 or view10 and +2s is the duration"

_FAULT = re.compile(
    r"(?P<name>[a-z0-9_.]+)(?P<values>(?::[a-z0-9_]+=[^:@]*)*)"
    r"(?:@(?:(?P<at>[\d.]+)s|move(?P<move>\d+)|view(?P<view>\d+))(?:\+(?P<length>[\d.]+)s)?)?"
)


class FaultTrigger(Enum):
    """The events that start a fault."""

    AT = "at"
    MOVE = "move"
    VIEW = "view"


@dataclass(frozen=True, slots=True)
class Fault:
    """A simulated fault with its time."""

    kind: FaultKind
    """Its kind."""
    values: Mapping[str, float] = field(default_factory=dict)
    """The values of all its parameters."""
    trigger: FaultTrigger = FaultTrigger.AT
    mark: float = 0.0
    """It begins at ``mark`` seconds of the bench's clock, or during the move or after the view with that number.
    `sim.faults.injector.Faults` counts moves and views from 0."""
    for_s: float | None = None
    """Its duration; None: it lasts until it is ended."""

    def __str__(self) -> str:
        parameters = self.kind.parameters
        given = "".join(
            f":{name}={value:g}" for name, value in self.values.items() if value != parameters[name].default
        )
        when = f"{self.mark:g}s" if self.trigger is FaultTrigger.AT else f"{self.trigger.value}{self.mark:g}"
        length = "" if self.for_s is None else f"+{self.for_s:g}s"
        return f"{self.kind.name}{given}@{when}{length}"

    @classmethod
    def parse(cls, text: str) -> Self:
        """Return the fault that a text in the short notation describes.

        Raises `UsageError` if the text cannot be read, or the fault or a parameter does not exist.
        """
        match = _FAULT.fullmatch(text.strip())
        if not match:
            raise UsageError(f"Cannot read the fault {text!r}.", next_step=f"Write {NOTATION}.")
        kind = find_fault(match["name"])
        given = dict(entry.split("=", 1) for entry in match["values"].split(":")[1:])
        values = {name: _number(kind.name, name, value) for name, value in given.items()}
        trigger = next((one for one in FaultTrigger if match[one.value] is not None), FaultTrigger.AT)
        mark = _number(kind.name, "the time", match[trigger.value] or "0")
        for_s = None if match["length"] is None else _number(kind.name, "the duration", match["length"])
        if for_s == 0:
            raise UsageError(f"The fault {kind.name} has no duration.", next_step="Give a time above 0.")
        return cls(kind, kind.values(values), trigger, mark, for_s)


def _number(name: str, key: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if value != value:
        raise UsageError(f"{key} = {text!r} of the fault {name} is not a number.", next_step="Give a number.")
    return value
