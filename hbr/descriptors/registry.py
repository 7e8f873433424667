"""The known descriptors and their names."""

import warnings
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from typing import Final

from hbr.descriptors.base import Descriptor
from hbr.descriptors.colours import Colours
from hbr.descriptors.edges import Edges
from hbr.descriptors.embedding import MODEL_NAME, PREFIX, Embedding, read_model
from hbr.descriptors.joined import Joined
from hbr.descriptors.layer_embedding import MAGIC, LayerEmbedding, load_layer
from hbr.descriptors.plain_cedd import Cedd

GROUP: Final = "hbr.descriptors"
"""Entry-point group in which packages name their descriptors: instances, not classes."""

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

Model = Embedding | LayerEmbedding
_MODELS: Final[dict[str, Model]] = {}


def descriptor(name: str) -> Descriptor:
    """Return the descriptor of this name. Opens no file: names come from saved runs and from other users' catalogs.

    Raises
    ------
    ValueError
        The name is unknown (the message lists the known ones), or it names a model that is not loaded.
    """
    known = _KNOWN.get(name) or _MODELS.get(name) or _plugins().get(name)
    if known is None and name.startswith(PREFIX):
        raise ValueError(f"the model of descriptor {name!r} is not loaded; load its file first")
    if known is None:
        raise ValueError(f"descriptor {name!r} is unknown; use one of {', '.join(names())}, or {PREFIX}FILE")
    return known


def register(added: Descriptor) -> None:
    """Make a descriptor known by its name in this process; an entry point does so in every process.

    Raises
    ------
    ValueError
        The name belongs to another descriptor, or to networks.
    """
    if added.name.startswith(PREFIX) or _KNOWN.setdefault(added.name, added) != added:
        raise ValueError(f"the name {added.name!r} is taken; choose another one")


@cache
def _plugins() -> dict[str, Descriptor]:
    """Return the descriptors of other packages. One that cannot be loaded is left out, with a warning."""
    found: dict[str, Descriptor] = {}
    for point in entry_points(group=GROUP):
        try:
            plugged: Descriptor = point.load()
            found[plugged.name] = plugged
        except (ImportError, AttributeError) as error:
            warnings.warn(f"the descriptor {point.name!r} of {point.value} cannot be loaded: {error}", stacklevel=2)
    return found


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


def load_model(path: Path) -> Model:
    """Load a model file, or a file of `hbr.descriptors.layer_embedding.fit_layer`; `descriptor` knows it by its digest.

    Raises
    ------
    ValueError
        The model file cannot be used.
    """
    content = read_model(path)
    is_layer = content.startswith(MAGIC)
    model = load_layer(path, content, _KNOWN["edges+colours"]) if is_layer else Embedding(path)
    return _MODELS.setdefault(model.name, model)


def loaded_models() -> tuple[Model, ...]:
    """Return the models that were loaded."""
    return tuple(_MODELS.values())


def names() -> tuple[str, ...]:
    """Return the names of all descriptors apart from networks, the paper's first."""
    return tuple(_KNOWN | _plugins())
