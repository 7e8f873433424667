"""The known descriptors and their names."""

from pathlib import Path
from typing import Final

from hbr.descriptors.base import Descriptor
from hbr.descriptors.colours import Colours
from hbr.descriptors.edges import Edges
from hbr.descriptors.embedding import MODEL_NAME, PREFIX, Embedding
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


_MODELS: Final[dict[str, Embedding]] = {}


def descriptor(name: str) -> Descriptor:
    """Return the descriptor of this name. It opens no file: names come from saved runs and from catalogs of others.

    Raises
    ------
    ValueError
        The name is unknown (the message lists the known ones), or it names a model that is not loaded.
    """
    known = _KNOWN.get(name) or _MODELS.get(name)
    if known is None and name.startswith(PREFIX):
        raise ValueError(f"the model of descriptor {name!r} is not loaded; load its file first")
    if known is None:
        raise ValueError(f"descriptor {name!r} is unknown; use one of {', '.join(names())}, or {PREFIX}FILE")
    return known


def load_descriptor(given: str) -> Descriptor:
    """Return the descriptor that the user names: ``onnx:FILE`` loads a model, other names are those of `descriptor`.

    Raises
    ------
    ValueError
        The name is unknown, or the model file cannot be used.
    """
    if given.startswith(PREFIX) and not MODEL_NAME.fullmatch(given):
        return load_model(Path(given.removeprefix(PREFIX)))
    return descriptor(given)


def load_model(path: Path) -> Embedding:
    """Load a model file; from now on `descriptor` knows it by its digest.

    Raises
    ------
    ValueError
        The model file cannot be used.
    """
    model = Embedding(path)
    return _MODELS.setdefault(model.name, model)


def loaded_models() -> tuple[Embedding, ...]:
    """Return the models that were loaded."""
    return tuple(_MODELS.values())


def names() -> tuple[str, ...]:
    """Return the names of all descriptors that come with the library, the paper's first."""
    return tuple(_KNOWN)
