"""From a stored image to the descriptors that the catalog keeps of it."""

from collections.abc import Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hbr.descriptors import PAPERS, Descriptor, descriptor, names
from rig.catalog.records import JsonObject, Region
from rig.config import ViewConfig
from rig.core.errors import CatalogError, UsageError
from rig.views import image_files as images
from rig.views.description import ViewDescriber


class Reference(NamedTuple):
    """A sitting's picture of the empty table: where it is, relative to the catalog, and its SHA-256."""

    image: str
    sha256: str

    @classmethod
    def of(cls, image: str | None, sha256: str | None) -> "Reference | None":
        return None if image is None or sha256 is None else cls(image, sha256)


@lru_cache(maxsize=4)
def stored_describer(
    root: Path, names: tuple[str, ...], region: Region | None, reference: Reference | None
) -> ViewDescriber:
    """Return what describes stored images as the bench did that took them: with its picture of the empty table.

    Raises
    ------
    CatalogError
        That picture is missing or is not the one that was stored.
    """
    if all(name in PAPERS for name in names):
        reference = None  # they look for no object
    empty_table = None if reference is None else images.read(root / reference.image, reference.sha256)
    return ViewDescriber(ViewConfig(roi=region), names, empty_table)


def known_descriptor(name: str) -> Descriptor:
    """Return the descriptor of this name; a `UsageError` lists those there are."""
    try:
        return descriptor(name)
    except ValueError as error:
        raise UsageError(f"there is no descriptor {name!r}", next_step=f"choose one of {', '.join(names())}") from error


def settings_of(region: Region | None) -> dict[str, Any]:
    """Return the settings of a descriptor as they are stored with it."""
    return {} if region is None else {"region": list(region)}


def region_of(settings: JsonObject) -> Region | None:
    """Return the part of the image that a stored descriptor is of; None for all of it.

    Raises
    ------
    CatalogError
        It was described in a way that this program does not know.
    """
    match dict(settings):
        case {} if not settings:
            return None
        case {"region": [int(x), int(y), int(width), int(height)], **other} if not other:
            return x, y, width, height
    raise CatalogError(
        f"a view is described with settings that this program does not know: {dict(settings)}",
        next_step="update hbr-rig on this computer, or describe the views anew: rig catalog redescribe",
    )


def packed_rows(
    levels: NDArray[np.uint8], further: Mapping[str, NDArray[np.uint8]], default: str, region: Region | None
) -> Iterator[dict[str, Any]]:
    """Yield the rows of the descriptors of one view, without its id."""
    for name, found in {default: levels, **further}.items():
        kind = known_descriptor(name)
        yield {
            "name": name,
            "version": kind.version,
            "settings": settings_of(region),
            "packed": kind.pack(found),
        }
