"""The objects that come with the simulated bench: ``objects.toml``, made of a few shapes."""

import tomllib
from collections.abc import Callable, Mapping
from functools import cache
from importlib.resources import files
from math import cos, pi, sin
from types import MappingProxyType
from typing import Any

import numpy as np

from sim.objects.paint import painted
from sim.objects.polyhedron import Polyhedron, box, face, lying_cylinder, prism
from sim.objects.projection import Colour, Paint
from sim.objects.revolution import Revolution
from sim.objects.solid import Curve, Part, Solid
from sim.objects.tube import Tube, handle, ray

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


Table = dict[str, Any]


@cache
def shelf() -> Mapping[str, Solid]:
    """Return the built-in objects by name. Their textures are painted when they are first drawn."""
    left_out = {second for _, second in MORE_CONFUSABLE}
    return MappingProxyType({name: solid for name, solid in read_objects().items() if name not in left_out})


@cache
def twins() -> Mapping[str, Solid]:
    """Return the objects of all pairs by name, `CONFUSABLE` and `MORE_CONFUSABLE`."""
    things = {**read_objects(), **shelf()}
    return MappingProxyType({name: things[name] for pair in (*CONFUSABLE, *MORE_CONFUSABLE) for name in pair})


def read_objects() -> dict[str, Solid]:
    """Return the objects of ``objects.toml`` by name."""
    tables = tomllib.loads(files("sim.objects").joinpath("objects.toml").read_text("utf-8"))
    colours: dict[str, Colour] = {name: (b, g, r) for name, (b, g, r) in tables.pop("colours").items()}
    objects = {}
    for name, own in tables.items():
        base = tables[own["like"]] if "like" in own else {}
        prints = base.get("prints", {}) | own.get("prints", {})
        paints: dict[str, Paint] = {}
        for role, table in prints.items():
            # A print on the print of the same name begins with that of the object that this one is like.
            ground, strokes = _print(table, prints if table.get("on") != role else base["prints"])
            paints[role] = painted(*_coloured([ground, strokes], colours))
        parts = [_part(table, paints, colours) for table in own.get("parts") or base["parts"]]
        symmetry_deg = float(own.get("symmetry_deg", base.get("symmetry_deg", 360)))
        objects[name] = Solid(name, tuple(parts), symmetry_deg)
    return objects


def _print(table: Table, others: Mapping[str, Table]) -> tuple[Any, list[Any]]:
    ground, strokes = _print(others[table["on"]], others) if "on" in table else (table["ground"], [])
    return ground, [*strokes, *table.get("strokes", ())]


def _coloured(value: Any, colours: Mapping[str, Colour]) -> Any:
    """Return ``value`` with colours in place of their names; so a text cannot be the name of a colour."""
    if isinstance(value, list):
        return [_coloured(each, colours) for each in value]
    return colours.get(value, value) if isinstance(value, str) else value


# -- shapes -----------------------------------------------------------------------------------------------------------


def _part(table: Table, paints: Mapping[str, Paint], colours: Mapping[str, Colour]) -> Part:
    """Return a part, with paints or colours in place of their names and curves in place of their descriptions."""

    def paint(value: Any) -> Paint | Colour:
        return paints.get(value) or colours[value] if isinstance(value, str) else tuple(value)

    read: dict[str, Callable[[Any], Any]] = {
        **dict.fromkeys(("profile", "inside", "path"), _curve),
        **dict.fromkeys(("paint", "top", "wall", "end", "colour", "lining"), paint),
        "walls": lambda walls: tuple(paint(wall) for wall in walls),
        "faces": lambda faces: tuple(face(one["corners"], paint(one["paint"])) for one in faces),
    }
    values = {key: read.get(key, _plain)(value) for key, value in table.items()}
    shape: Part = _SHAPES[values.pop("shape")](**values)
    return shape


def _plain(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


def _revolution(paint: Paint | Colour, **values: Any) -> Revolution:
    return Revolution(paint=painted(paint) if isinstance(paint, tuple) else paint, **values)


_SHAPES: dict[str, Callable[..., Part]] = {
    "revolution": _revolution,
    "tube": Tube,
    "box": box,
    "prism": prism,
    "lying_cylinder": lying_cylinder,
    "faces": Polyhedron,
}


_ROUNDS = 4  # each round doubles the points: 16 for each corner


def smooth(*corners: tuple[float, ...]) -> Curve:
    """Return the curve through ``corners`` with rounded edges (Chaikin's corner cutting); its ends do not move."""
    points = np.array(corners, dtype=np.float64)
    for _ in range(_ROUNDS):
        cut = np.stack([0.75 * points[:-1] + 0.25 * points[1:], 0.25 * points[:-1] + 0.75 * points[1:]], axis=1)
        points = np.concatenate([points[:1], cut.reshape(-1, points.shape[1]), points[-1:]])
    return tuple(tuple(float(x) for x in point) for point in points)


def _curve(pieces: list[Any]) -> Curve:
    points: list[tuple[float, ...]] = []
    for piece in pieces:
        match piece:
            case {"smooth": corners}:
                points += smooth(*map(tuple, corners))
            case {"handle": values}:
                points += handle(*values)
            case {"ray": azimuth_deg, "points": places}:
                points += ray(azimuth_deg, *places)
            case {"sphere": radius}:
                points += [(radius * sin(pi * i / 90), radius * (1 + cos(pi * i / 90))) for i in range(91)]
            case _:
                points.append(tuple(piece))
    return tuple(points)
