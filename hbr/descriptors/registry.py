"""The descriptors by name."""

from typing import Final

from hbr.descriptors.plain import Cedd
from hbr.descriptors.protocol import Descriptor

_KNOWN: Final[dict[str, Descriptor]] = {known.name: known for known in (Cedd(),)}


def descriptor(name: str) -> Descriptor:
    """Return the descriptor of this name.

    Raises
    ------
    ValueError
        There is none; the message lists those there are.
    """
    if name not in _KNOWN:
        raise ValueError(f"descriptor {name!r} is unknown; use one of {', '.join(names())}")
    return _KNOWN[name]


def names() -> tuple[str, ...]:
    """Names of all descriptors, the paper's first."""
    return tuple(_KNOWN)
