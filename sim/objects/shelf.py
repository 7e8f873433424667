"""The objects that come with the simulated bench."""

from collections.abc import Mapping
from functools import cache
from types import MappingProxyType

from sim.objects.packs import more_twins, packs
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

MORE_CONFUSABLE: tuple[tuple[str, str], ...] = (
    ("book-atlas", "book-atlan"),
    ("jar-honey", "jar-honey-amber"),
    ("bottle-milk", "bottle-milk-plain"),
    ("box-tissues", "box-tissues-sale"),
)
"""Pairs of which the second one does not stand on the shelf (`twins`)."""


@cache
def shelf() -> Mapping[str, Solid]:
    """Return the built-in objects by name. Their textures are painted when they are first drawn."""
    return MappingProxyType({solid.name: solid for solid in (*pottery(), *packs(), *toys())})


@cache
def twins() -> Mapping[str, Solid]:
    """Return the objects of all pairs by name, `CONFUSABLE` and `MORE_CONFUSABLE`."""
    things = {**shelf(), **{solid.name: solid for solid in more_twins()}}
    return MappingProxyType({name: things[name] for pair in (*CONFUSABLE, *MORE_CONFUSABLE) for name in pair})
