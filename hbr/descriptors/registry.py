"""The known descriptors and their names."""

from functools import cache
from pathlib import Path
from typing import Final

from hbr.descriptors.base import Descriptor
from hbr.descriptors.colours import Colours
from hbr.descriptors.edges import Edges
from hbr.descriptors.embedding import PREFIX, Embedding
from hbr.descriptors.joined import Joined
from hbr.descriptors.plain_cedd import Cedd

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

#: Names of the descriptors of the whole image, which the paper's voting compares.
PAPERS: Final = tuple(known.name for known in _KNOWN.values() if known.whole_image)


def descriptor(name: str) -> Descriptor:
    """Return the descriptor of this name; ``onnx:FILE`` is the embedding of a neural network.

    Raises
    ------
    ValueError
        The name is unknown (the message lists the known ones), or the model file cannot be used.
    """
    if name.startswith(PREFIX):
        return _embedding(name.removeprefix(PREFIX))
    if name not in _KNOWN:
        raise ValueError(f"descriptor {name!r} is unknown; use one of {', '.join(names())}, or {PREFIX}FILE")
    return _KNOWN[name]


@cache
def _embedding(path: str) -> Descriptor:
    return Embedding(Path(path))


def names() -> tuple[str, ...]:
    """Return the names of all descriptors that come with the library, the paper's first."""
    return tuple(_KNOWN)
