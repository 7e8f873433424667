"""Simulated faults with their times, in a short notation (``jam@move3+2s``) or in a TOML file."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from difflib import get_close_matches
from enum import Enum
from functools import cache
from itertools import product
from pathlib import Path
from types import MappingProxyType
from typing import Any, Self

from rig.config.toml_file import MAX_FILE_BYTES, loads
from rig.core.errors import UsageError, os_errors_as
from rig.core.files import read
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

_SHORT = re.compile(r"(?P<name>[a-z0-9_.]+)(?P<values>(?::[^:@]*)*)(?:@(?P<when>.*))?")
_WHEN = re.compile(r"(?:(?P<at>[\d.]+)s|move(?P<move>\d+)|view(?P<view>\d+))(?:\+(?P<length>[\d.]+)s)?")
_KEYS = ("name", "at_s", "during_move", "after_view", "for_s")


class FaultTrigger(Enum):
    """The events that start a fault."""

    AT = "at_s"
    MOVE = "during_move"
    VIEW = "after_view"


@dataclass(frozen=True, slots=True)
class Fault:
    """A simulated fault with its time.

    Attributes
    ----------
    kind
        Its kind.
    values
        The values of all its parameters.
    trigger, mark
        It begins at ``mark`` seconds of the bench's clock, or during the move or after the view with that number.
        `sim.faults.injector.Faults` counts moves and views from 0.
    for_s
        Its duration; None: it lasts until it is ended.
    """

    kind: FaultKind
    values: Mapping[str, float] = field(default_factory=dict)
    trigger: FaultTrigger = FaultTrigger.AT
    mark: float = 0.0
    for_s: float | None = None

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
        match = _SHORT.fullmatch(text.strip())
        if not match:
            raise _unreadable(text)
        given: dict[str, Any] = {"name": match["name"]}
        for entry in match["values"].split(":")[1:]:
            name, sign, value = entry.partition("=")
            if not sign or name in _KEYS:
                raise _unreadable(text)
            given[name] = value
        if match["when"] is not None:
            when = _WHEN.fullmatch(match["when"])
            if not when:
                raise _unreadable(text)
            keys = {"at_s": "at", "during_move": "move", "after_view": "view", "for_s": "length"}
            given |= {key: when[group] for key, group in keys.items() if when[group] is not None}
        return cls.from_table(given)

    @classmethod
    def from_table(cls, table: Mapping[str, Any]) -> Self:
        """Return the fault of a table: ``name``, ``at_s`` or ``during_move`` or ``after_view``, ``for_s``, parameters.

        Raises `UsageError` if there is no such fault or parameter, or a value is not valid.
        """
        name = table.get("name")
        if not isinstance(name, str):
            raise UsageError(
                "A fault has no name.", next_step=('Add a name, for example name = "jam".', Do.LIST_FAULTS())
            )
        kind = find_fault(name)
        triggers = [trigger for trigger in FaultTrigger if trigger.value in table]
        if len(triggers) > 1:
            raise UsageError(
                f"The fault {name} has more than one time.",
                next_step=f"Give one of {' and '.join(trigger.value for trigger in triggers)}.",
            )
        numbers = {key: _number(name, key, value) for key, value in table.items() if key != "name"}
        for_s = numbers.pop("for_s", None)
        trigger = triggers[0] if triggers else FaultTrigger.AT
        mark = numbers.pop(trigger.value, 0.0)
        if mark < 0 or (for_s is not None and for_s <= 0):
            raise UsageError(f"The time of the fault {name} is negative.", next_step="Give a time of 0 or later.")
        if trigger is not FaultTrigger.AT and mark != int(mark):
            raise UsageError(
                f"{trigger.value} = {mark:g} of the fault {name} is not a whole number.",
                next_step="Give a whole number.",
            )
        return cls(kind, kind.values(numbers), trigger, mark, for_s)


def load_faults(path: Path) -> list[Fault]:
    """Return the faults of a TOML file: ``faults = ["jam@move3+2s", ...]``, or tables ``[[faults]]``.

    Raises `UsageError`: the file or one of its faults cannot be read; the message says which one.
    """
    try:
        with os_errors_as(UsageError, f"Cannot read the faults in {path}.", next_step="Give an existing file."):
            content = loads(read(path, max_bytes=MAX_FILE_BYTES).decode())
    except ValueError as error:
        raise UsageError(
            f"{path} is not a TOML file.", next_step="Correct the line.", evidence={"reason": str(error)}
        ) from error
    entries = content.pop("faults", None)
    if content or not isinstance(entries, list):
        raise UsageError(
            f"{path} is not a list of faults.",
            next_step='Write faults = ["jam@move3+2s"], or a table [[faults]] for each, and nothing else.',
            evidence={"keys": list(content)} if content else None,
        )
    return [_entry(entry, f"Fault {number} in {path}: ") for number, entry in enumerate(entries, 1)]


def read_faults(entries: list[Any]) -> list[Fault]:
    """Return the faults of a configuration's list of texts and tables; raises UsageError as `load_faults` does."""
    return [_entry(entry, f"Fault {number}: ") for number, entry in enumerate(entries, 1)]


def _entry(entry: Any, where: str) -> Fault:
    try:
        if isinstance(entry, str):
            return Fault.parse(entry)
        if isinstance(entry, dict):
            return Fault.from_table(entry)
        raise _unreadable(str(entry))
    except UsageError as error:
        raise UsageError(where + error.what, next_step=error.steps, evidence=error.evidence) from error


def _number(name: str, key: str, value: Any) -> float:
    try:
        if isinstance(value, bool):
            raise ValueError
        number = float(value)
        if number != number:
            raise ValueError
    except (TypeError, ValueError):
        raise UsageError(
            f"{key} = {value!r} of the fault {name} is not a number.", next_step="Give a number."
        ) from None
    return number


def _unreadable(text: str) -> UsageError:
    return UsageError(f"Cannot read the fault {text!r}.", next_step=f"Write {NOTATION}.")
