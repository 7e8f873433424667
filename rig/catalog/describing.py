"""Description of stored images by the descriptors that the catalog stores with them."""

from collections.abc import Iterable, Mapping
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hbr.descriptors import Descriptor, descriptor, names
from rig.catalog.columns import damaged
from rig.catalog.image_store import ImageStore
from rig.catalog.records import JsonObject, PackedDescriptor, Region, is_region
from rig.config import ViewConfig
from rig.core.errors import CatalogError, UsageError
from rig.core.next_steps import Do
from rig.views.description import ViewDescriber

ROUNDED: Final = 0.02
"""Largest share of a view's levels that another computer may have rounded to the neighbouring level."""

EmptyTable = tuple[str, str]
"""Path of an empty-table image relative to the catalog, and its SHA-256."""


@lru_cache(maxsize=4)
def stored_describer(
    store: ImageStore, names: tuple[str, ...], region: Region | None, empty_table: EmptyTable | None
) -> ViewDescriber:
    """Return a describer that describes stored images as the bench did, with the empty-table image of their session.

    Raises
    ------
    CatalogError
        The empty-table image is missing or is not the stored one.
    """
    # Descriptors of the whole image, such as the paper's, need no segmentation.
    if empty_table is None or all(descriptor(name).whole_image for name in names):
        return ViewDescriber(ViewConfig(roi=region), names)
    return ViewDescriber(ViewConfig(roi=region), names, store.pixels(*empty_table))


def known_descriptor(name: str) -> Descriptor:
    """Return the descriptor of this name. A `UsageError` lists the known ones."""
    try:
        return descriptor(name)
    except ValueError as error:
        raise UsageError(
            f"There is no descriptor {name!r}.", next_step=f"Choose one of {', '.join(names())}."
        ) from error


def settings_of(region: Region | None) -> JsonObject:
    """Return the settings of a descriptor as they are stored with it."""
    return {} if region is None else {"region": list(region)}


def region_of(settings: JsonObject) -> Region | None:
    """Return the part of the image that a stored descriptor describes; None for the whole image.

    Raises
    ------
    CatalogError
        This program does not know the settings.
    """
    match dict(settings):
        case {} if not settings:
            return None
        case {"region": [x, y, width, height], **other} if not other and is_region((x, y, width, height)):
            return x, y, width, height
    raise CatalogError(
        f"A view is described with settings that this program does not know: {dict(settings)}.",
        next_step=("Update hbr-rig on this computer, or", Do.REDESCRIBE()),
    )


def is_current(name: str, version: int) -> bool:
    """Return whether this program computes this version of a descriptor."""
    return name in names() and descriptor(name).version == version


def pack(levels: Mapping[str, NDArray[np.uint8]], region: Region | None) -> list[PackedDescriptor]:
    """Pack the levels of a view by each descriptor.

    Raises
    ------
    UsageError
        There is no descriptor of one of the names.
    TypeError, ValueError
        The levels do not fit their descriptor.
    """
    settings = settings_of(region)
    kinds = ((known_descriptor(name), found) for name, found in levels.items())
    return [PackedDescriptor(kind.name, kind.version, settings, kind.pack(found)) for kind, found in kinds]


def unpack(packed: Iterable[PackedDescriptor]) -> dict[str, NDArray[np.uint8]]:
    """Return the levels of a view by name. Versions that this program does not compute are left out."""
    found = {}
    for one in packed:
        if is_current(one.name, one.version):
            try:
                found[one.name] = descriptor(one.name).unpack(one.packed)
            except ValueError as error:
                raise damaged(f"a descriptor {one.name}", one.packed) from error
    return found


def matches(kind: Descriptor, packed: bytes, levels: NDArray[np.uint8]) -> bool:
    """Return whether stored levels are those of the image: equal, or nearly equal for a descriptor that rounds.

    The arithmetic of another computer may have rounded a level the other way.
    """
    if kind.pack(levels) == packed:
        return True
    if kind.whole_image or len(packed) != kind.size_bytes:
        return False
    off = np.abs(kind.unpack(packed).astype(np.int16) - levels)
    return int(off.max()) <= 1 and float((off > 0).mean()) <= ROUNDED
