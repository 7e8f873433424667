"""All kinds of simulated faults by name."""

from collections.abc import Mapping
from difflib import get_close_matches
from functools import cache
from itertools import product
from types import MappingProxyType

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
