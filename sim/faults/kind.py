"""A kind of simulated fault: its name, description, parameters, beginning and end.

Decision: docs/decisions/0001.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import TypeVar

import numpy as np

from rig.core.errors import UsageError
from sim.clock import VirtualClock
from sim.devices import SimDevices

DEVICES = ("servo", "imu", "camera")
F = TypeVar("F")
Values = Mapping[str, float]

End = Callable[[], None]
"""A function that removes the cause of a fault; its consequences remain."""


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


Begin = Callable[[SimDevices, Values, np.random.Generator], End]


@dataclass(frozen=True, slots=True)
class FaultKind:
    """A kind of simulated fault.

    ``what`` describes it in a sentence. ``begin`` starts it in the given devices and returns the function that ends it.
    """

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
        registry[name] = FaultKind(name, what, MappingProxyType(parameters), begin)
        return begin

    return register


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
