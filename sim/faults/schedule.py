"""Simulated faults with their times, in a short notation (``jam@move3+2s``)."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from difflib import get_close_matches
from enum import Enum
from functools import cache
from itertools import product
from types import MappingProxyType
from typing import Self

from rig.core.errors import UsageError
from rig.core.next_steps import Do
from sim.faults import camera, environment, imu, servo  # noqa: F401 - each module registers its faults
from sim.faults.kind import DEVICES, FaultKind, registry


@cache
def fault_kinds() -> Mapping[str, FaultKind]:
    """Return all kinds by name: first the faults that every device can have, then the others."""
    words = ("off", "stuck", "garbage", "wrong", "slow", "delayed", "intermittent")
    order = {f"{device}.{word}": i for i, (device, word) in enumerate(product(DEVICES, words))}
    return MappingProxyType(dict(sorted(registry.items(), key=lambda item: order.get(item[0], len(order)))))


def find_fault(name: str) -> FaultKind:
    """Return the kind called ``name``.

    Raises `UsageError`: no kind has that name; the next step names the most similar ones.
    """
    if name in fault_kinds():
        return fault_kinds()[name]
    of_devices = [f"{device}.{name}" for device in DEVICES if f"{device}.{name}" in fault_kinds()]
    near = of_devices or get_close_matches(name, fault_kinds(), n=2, cutoff=0.5)
    raise UsageError(
        f"There is no fault {name!r}.",
        next_step=f"Did you mean {' or '.join(near)}?" if near else Do.LIST_FAULTS(),
    )


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
        given = "".join(
            f":{name}={value:g}" for name, value in self.values.items() if value != self.kind.parameters[name].default
        )
        when = {
            FaultTrigger.AT: f"{self.mark:g}s",
            FaultTrigger.MOVE: f"move{self.mark:g}",
            FaultTrigger.VIEW: f"view{self.mark:g}",
        }
        length = "" if self.for_s is None else f"+{self.for_s:g}s"
        return f"{self.kind.name}{given}@{when[self.trigger]}{length}"

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
        if value != value:
            raise ValueError
    except ValueError:
        raise UsageError(f"{key} = {text!r} of the fault {name} is not a number.", next_step="Give a number.") from None
    return value
