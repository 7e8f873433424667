"""The objects that come with the simulated bench."""

from collections.abc import Mapping
from functools import cache
from types import MappingProxyType

from sim.objects.packs import packs
from sim.objects.pottery import pottery
from sim.objects.solid import Solid
from sim.objects.toys import toys

CONFUSABLE: tuple[tuple[str, str], ...] = (
    ("mug-white", "mug-star"),
    ("vase-blue", "vase-poppy"),
    ("bottle-green", "bottle-harvest"),
    ("can-tomato", "can-tomato-offer"),
    ("cereal-plain", "cereal-puzzle"),
    ("toy-house", "toy-house-green"),
)
"""Pairs that differ only in one sticker, face or marking. From the other sides they look the same."""


@cache
def shelf() -> Mapping[str, Solid]:
    """Return the built-in objects by name. Their textures are painted when they are first drawn."""
    return MappingProxyType({solid.name: solid for solid in (*pottery(), *packs(), *toys())})
