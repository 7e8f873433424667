"""The descriptors by name."""

from typing import Final

from hbr.descriptors.colours import Colours
from hbr.descriptors.edges import Edges
from hbr.descriptors.joined import Joined
from hbr.descriptors.plain import Cedd
from hbr.descriptors.protocol import Descriptor

_CEDD: Final = Cedd()
_EDGES: Final = Edges()
_COLOURS: Final = Colours()
_KNOWN: Final[dict[str, Descriptor]] = {
    known.name: known
    for known in (
        _CEDD,
        Cedd(name="cedd-blurred", blur=0.9),
        _COLOURS,
        _EDGES,
        Joined("cedd+colours", 1, (_CEDD, _COLOURS), (0.5, 0.5)),
        Joined("edges+colours", 1, (_EDGES, _COLOURS), (0.6, 0.4)),
    )
}


#: Those that the paper's voting compares: CEDD's levels.
PAPERS: Final = tuple(known.name for known in _KNOWN.values() if isinstance(known, Cedd))


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
