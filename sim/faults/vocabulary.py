"""All faults by name."""

from collections.abc import Mapping
from difflib import get_close_matches
from functools import cache
from types import MappingProxyType

from rig.core.errors import UsageError
from sim.faults import camera, imu, servo, surroundings  # noqa: F401 - each registers its faults when imported
from sim.faults.kind import DEVICES, Kind, registry


@cache
def kinds() -> Mapping[str, Kind]:
    """Return the vocabulary by name: the faults that every device has, then the particular ones."""
    order = {f"{device}.{word}": i for i, (device, word) in enumerate(_device_words())}
    return MappingProxyType(dict(sorted(registry.items(), key=lambda item: order.get(item[0], len(order)))))


def find_kind(name: str) -> Kind:
    """Return the kind called ``name``.

    Raises
    ------
    UsageError
        There is none; the next step names the nearest.
    """
    if name in kinds():
        return kinds()[name]
    of_devices = [f"{device}.{name}" for device in DEVICES if f"{device}.{name}" in kinds()]
    near = of_devices or get_close_matches(name, kinds(), n=2, cutoff=0.5)
    raise UsageError(
        f"There is no fault {name!r}.",
        next_step=f"Did you mean {' or '.join(near)}?" if near else "List them: rig faults",
    )


def _device_words() -> list[tuple[str, str]]:
    words = ("off", "stuck", "garbage", "wrong", "slow", "delayed", "intermittent")
    return [(device, word) for device in DEVICES for word in words]
