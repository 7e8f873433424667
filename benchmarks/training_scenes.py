# mypy: ignore-errors
"""Drawn scenes for the training of the segmentation network: solids on benches, from many sides, with the true pixels.

Nothing comes from photographs. The solids are random: of revolution, boxes, animals, cars, and heaps of parts; and the
simulator's. Some look the same from all sides, some tables are empty, and some cameras move around the object.
"""

from dataclasses import replace
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from hbr.drawing.bench import ENROLLMENT, FOOT_PX, HARD, MILD, DrawnBench, Visit
from sim.objects.shelf import shelf

Floats = NDArray[np.float32]
WIDTH, HEIGHT = 192, 144
SIDES: Final = 20
_LONGEST_PX: Final = 130


class CutOut(NamedTuple):
    """A drawn solid from one side: float32 (h, w, 3), the share of each pixel, float32 (h, w), and x of the axis."""

    image: Floats
    share: Floats
    axis_px: float


class Scene(NamedTuple):
    """A frame, frames of the rotated table, and one of the empty table, uint8 (144, 192, 3), and the true masks.

    The masks are the shares of object and platter in each pixel, uint8 (144, 192).
    """

    image: NDArray[np.uint8]
    rotated: list[NDArray[np.uint8]]
    empty: NDArray[np.uint8]
    object: NDArray[np.uint8]
    platter: NDArray[np.uint8]


# Solids: points on surfaces with normals, each float32 (n, 3): x to the right, y up, z to the camera.


class _Solid:
    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self.points: list[Floats] = []
        self.normals: list[Floats] = []

    def _add(
        self, points: Floats, normals: Floats, at: NDArray[np.float64], rotation: NDArray[np.float64] | None
    ) -> None:
        if rotation is not None:
            points, normals = points @ rotation.T, normals @ rotation.T
        self.points.append((points + at).astype(np.float32))
        self.normals.append(normals.astype(np.float32))

    def ellipsoid(self, at: NDArray[np.float64], axes: NDArray[np.float64], rotation=None) -> None:  # type: ignore[no-untyped-def]
        n = 6000
        way = self.rng.normal(size=(n, 3))
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        normal = way / axes
        self._add(way * axes, normal / np.linalg.norm(normal, axis=1, keepdims=True), at, rotation)

    def box(self, at: NDArray[np.float64], half: NDArray[np.float64], rotation=None) -> None:  # type: ignore[no-untyped-def]
        n = 6000
        points = self.rng.uniform(-1, 1, (n, 3))
        areas = np.array([half[1] * half[2], half[0] * half[2], half[0] * half[1]])
        face = self.rng.choice(3, n, p=areas / areas.sum())
        sign = self.rng.choice([-1.0, 1.0], n)
        points[np.arange(n), face] = sign
        normals = np.zeros((n, 3))
        normals[np.arange(n), face] = sign
        self._add(points * half, normals, at, rotation)

    def lathe(self, radii: NDArray[np.float64], height: float, at: NDArray[np.float64], rotation=None) -> None:  # type: ignore[no-untyped-def]
        n = 9000
        y = self.rng.uniform(0, 1, n)
        angle = self.rng.uniform(0, 2 * np.pi, n)
        radius = np.interp(y, np.linspace(0, 1, len(radii)), radii)
        slope = np.interp(y, np.linspace(0, 1, len(radii)), np.gradient(radii) * (len(radii) - 1)) / max(height, 1e-3)
        normal = np.stack([np.cos(angle), -slope, np.sin(angle)], axis=1)
        body = np.stack([radius * np.cos(angle), y * height, radius * np.sin(angle)], axis=1)
        lids, lid_angle = np.sqrt(self.rng.uniform(0, 1, n // 3)), self.rng.uniform(0, 2 * np.pi, n // 3)
        top = self.rng.random(n // 3) < 0.7
        lid_radius = lids * np.where(top, radii[-1], radii[0])
        lid = np.stack(
            [lid_radius * np.cos(lid_angle), np.where(top, height, 0), lid_radius * np.sin(lid_angle)], axis=1
        )
        lid_normal = np.stack([0 * lids, np.where(top, 1.0, -1.0), 0 * lids], axis=1)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        self._add(np.concatenate([body, lid]), np.concatenate([normal, lid_normal]), at, rotation)

    def ring(self, at: NDArray[np.float64], radius: float, thick: float, tall: float) -> None:
        n = 5000
        a, b = self.rng.uniform(0, 2 * np.pi, (2, n))
        way = np.stack([np.cos(a) * np.cos(b), np.sin(a) * np.cos(b), np.sin(b)], axis=1)
        middle = np.stack([radius * np.cos(a), tall * radius * np.sin(a), 0 * a], axis=1)
        self._add(middle + thick * way, way, at, None)


def _any_way(rng: np.random.Generator, strength: float = 1.0) -> NDArray[np.float64]:
    q, _ = np.linalg.qr(np.eye(3) + strength * rng.normal(size=(3, 3)))
    return q


def solid(rng: np.random.Generator) -> list[CutOut]:
    """Draw a random solid from `SIDES` sides."""
    made, kind = _Solid(rng), rng.random()
    zero = np.zeros(3)
    even = rng.random() < 0.15  # balls, bottles and plates, which look the same from all sides
    if even:
        kind = 0.0
    if kind < 0.34:  # of revolution: cans, bottles, bowls, cups with a handle, fruit
        height = rng.uniform(0.5, 2.6)
        if rng.random() < 0.25:
            radii = np.sin(np.linspace(0.35, np.pi - 0.25, 12)) ** rng.uniform(0.4, 1)
            height = rng.uniform(1.2, 2)
        elif rng.random() < 0.4:
            radii = np.full(6, 0.8) * np.linspace(rng.uniform(0.6, 1), 1, 6)
        else:
            knots = np.clip(np.cumsum(rng.normal(0, 0.25, 7)) + rng.uniform(0.4, 0.9), 0.15, 1.1)
            radii = np.interp(np.linspace(0, 6, 24), np.arange(7), knots)
        if even and rng.random() < 0.3:
            height = rng.uniform(0.15, 0.4)
        made.lathe(radii, height, zero)
        if not even and rng.random() < 0.7:
            made.ring(
                np.array([radii.max() * rng.uniform(0.9, 1.1), height * rng.uniform(0.4, 0.6), 0]),
                rng.uniform(0.15, 0.4) * height, rng.uniform(0.015, 0.08), rng.uniform(0.8, 1.4),
            )  # fmt: skip
        if rng.random() < 0.2:
            made.lathe(np.full(4, rng.uniform(0.02, 0.15)), rng.uniform(0.1, 0.4), np.array([0, height, 0]))
    elif kind < 0.5:  # boxes
        low = 0.0
        for _ in range(int(rng.integers(1, 3))):
            half = rng.uniform(0.15, 1, 3)
            at = np.array([rng.normal(0, 0.1), low + half[1], rng.normal(0, 0.1)])
            made.box(at, half)
            low += 2 * half[1]
    elif kind < 0.66:  # animals
        long, thick, high = rng.uniform(0.6, 1.2), rng.uniform(0.25, 0.45), rng.uniform(0.3, 0.9)
        made.ellipsoid(np.array([0, high + 0.6 * thick, 0]), np.array([long, thick, 0.8 * thick]))
        leg = rng.uniform(0.05, 0.13)
        for x in (-0.7, 0.7):
            for z in (-0.5, 0.5):
                at = np.array([x * long + rng.normal(0, 0.05), 0, z * thick])
                made.lathe(np.linspace(leg, 1.3 * leg, 4), high + 0.5 * thick, at)
        neck = np.array([long * rng.uniform(0.9, 1.3), high + thick * rng.uniform(0.4, 2), 0])
        made.ellipsoid(neck, np.array([rng.uniform(0.2, 0.4), rng.uniform(0.15, 0.28), rng.uniform(0.12, 0.22)]))
        made.ellipsoid(
            (neck + np.array([0.7 * long, high + 0.7 * thick, 0])) / 2, np.array([0.25, 0.35, 0.18]), _any_way(rng, 0.2)
        )
        if rng.random() < 0.6:  # ears or horns
            for z in (-0.12, 0.12):
                made.ellipsoid(neck + np.array([0, 0.25, z]), np.array([0.05, rng.uniform(0.08, 0.22), 0.04]))
        if rng.random() < 0.8:
            drop = rng.uniform(0.2, 0.7)
            made.ellipsoid(
                np.array([-long - 0.05, high + thick - drop / 2, 0]), np.array([0.04, drop, 0.04]), _any_way(rng, 0.15)
            )
    elif kind < 0.76:  # cars
        half = np.array([1.0, rng.uniform(0.12, 0.25), rng.uniform(0.35, 0.5)])
        wheel = rng.uniform(0.12, 0.22)
        made.box(np.array([0, wheel + half[1], 0]), half)
        cab = np.array([rng.uniform(0.3, 0.7), rng.uniform(0.1, 0.3), 0.9 * half[2]])
        made.ellipsoid(np.array([rng.uniform(-0.3, 0.2), wheel + 2 * half[1], 0]), cab * 1.2)
        made.box(np.array([rng.uniform(-0.3, 0.1), wheel + 2 * half[1] + 0.6 * cab[1], 0]), cab * 0.7)
        for x in (-0.65, 0.65):
            for z in (-1, 1):
                made.ellipsoid(np.array([x, wheel, z * half[2]]), np.array([wheel, wheel, 0.07]))
    else:  # heaps of parts
        for _ in range(int(rng.integers(1, 7))):
            at = np.array([rng.normal(0, 0.35), rng.uniform(0.2, 1.6), rng.normal(0, 0.35)])
            axes = rng.uniform(0.06, 0.7, 3)
            (made.ellipsoid if rng.random() < 0.6 else made.box)(at, axes, _any_way(rng))
        made.lathe(np.linspace(rng.uniform(0.2, 0.7), rng.uniform(0.1, 0.5), 4), rng.uniform(0.2, 1), zero)
    if not even and rng.random() < 0.35:  # sticks, handles, spouts
        reach = float(np.abs(np.concatenate(made.points)).max())
        for _ in range(int(rng.integers(1, 4))):
            wide, long = rng.uniform(0.015, 0.07), rng.uniform(0.2, 0.8) * reach
            at = np.array([rng.normal(0, 0.3), rng.uniform(0.3, 1.0) * reach, rng.normal(0, 0.3)])
            made.lathe(
                np.linspace(wide * rng.uniform(0.6, 1.6), wide, 4), long, at, _any_way(rng, rng.uniform(0.1, 1.5))
            )
    colours = _colours(made, rng, even)
    points, normals = np.concatenate(made.points), np.concatenate(made.normals)
    points[:, 1] -= points[:, 1].min()
    if not even and rng.random() < 0.2:
        points[:, 1] *= rng.uniform(0.15, 0.6)
    found = _drawn(points, normals, colours, rng)
    return [found[0]] * SIDES if even and rng.random() < 0.7 else found


def _colours(made: _Solid, rng: np.random.Generator, even: bool) -> Floats:
    """Return the colour of each point: of parts, panels, stripes, spots and grain."""
    vivid = rng.random() < 0.6

    def colour() -> NDArray[np.float64]:
        return rng.uniform(10, 245, 3) if vivid else rng.uniform(12, 243) + rng.normal(0, 12, 3)

    palette = [colour() for _ in range(int(rng.integers(1, 5)))]
    found = [np.tile(palette[int(rng.integers(len(palette)))], (len(points), 1)) for points in made.points]
    colours, points = np.concatenate(found), np.concatenate(made.points)
    size = float(np.ptp(points, axis=0).max())
    for _ in range(int(rng.integers(0, 5))):
        ink, what = colour(), rng.random()
        way = np.array([0.0, 1.0, 0.0]) if even else rng.normal(size=3) * [1, 1.5, 1]
        along = points @ (way / np.linalg.norm(way)) / size
        if even:
            what = 0.0 if what < 0.5 else 1.0
        if what < 0.3:
            colours[along % rng.uniform(0.05, 0.5) < rng.uniform(0.01, 0.2)] = ink
        elif what < 0.55:  # a patch
            centre = points[int(rng.integers(len(points)))]
            colours[(np.abs(points - centre) < rng.uniform(0.03, 0.35, 3) * size).all(axis=1)] = ink
        elif what < 0.8:  # spots
            cells = np.floor(points / size * rng.uniform(2, 9)).astype(int) @ np.array([73, 19, 37])
            colours[(cells * 2654435761 % 97) / 97 < rng.uniform(0.1, 0.5)] = ink
        else:  # a smooth change
            share = np.clip(0.5 + 0.5 * np.sin(along * rng.uniform(2, 12)), 0, 1)[:, None]
            colours = colours * share + ink * (1 - share)
    return (colours + rng.normal(0, rng.uniform(0, 8), (len(points), 1))).astype(np.float32)


def _drawn(points: Floats, normals: Floats, colours: Floats, rng: np.random.Generator) -> list[CutOut]:
    tilt = np.radians(rng.choice([rng.uniform(0, 8), rng.uniform(8, 40)]))
    reach = max(2 * float(np.linalg.norm(points[:, [0, 2]], axis=1).max()), float(points[:, 1].max()))
    scale = _LONGEST_PX / (1.1 * reach)
    lamp = np.array([rng.normal(0, 0.6), 1.0, rng.uniform(0.3, 1.2)])
    lamp /= np.linalg.norm(lamp)
    half = lamp + np.array([0, 0, 1])
    half /= np.linalg.norm(half)
    ambient, gloss = rng.uniform(0.35, 0.8), rng.choice([0, rng.uniform(20, 160)])
    found = []
    for n in range(SIDES):
        angle = 2 * np.pi * n / SIDES
        rotation = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
        seen, normal = points @ rotation.T, normals @ rotation.T
        light = ambient + (1 - ambient) * np.clip(normal @ lamp, 0, 1)
        shine = gloss * np.clip(normal @ half, 0, 1) ** 20
        depth = seen[:, 2] * np.cos(tilt) + seen[:, 1] * np.sin(tilt)
        across = seen[:, 0] * scale
        down = (seen[:, 2] * np.sin(tilt) - seen[:, 1] * np.cos(tilt)) * scale
        left, top = int(np.floor(across.min())) - 2, int(np.floor(down.min())) - 2
        size = int(np.ceil(down.max())) - top + 3, int(np.ceil(across.max())) - left + 3
        order = np.argsort(depth)
        x, y = np.rint(across - left).astype(int)[order], np.rint(down - top).astype(int)[order]
        image = np.zeros((*size, 3), np.float32)
        share = np.zeros(size, np.uint8)
        shown = (colours * light[:, None] + shine[:, None])[order]
        image[y, x], share[y, x] = shown, 1
        closed = cv2.morphologyEx(share, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
        closed |= cv2.medianBlur(closed, 5)
        blurred = cv2.blur(image, (5, 5)) / np.maximum(cv2.blur(share.astype(np.float32), (5, 5)), 1e-3)[:, :, None]
        image = np.where((share > 0)[:, :, None], image, blurred)
        image = cv2.GaussianBlur(image, (0, 0), 0.6)
        soft = cv2.GaussianBlur(closed.astype(np.float32), (0, 0), 0.6)
        weight = cv2.GaussianBlur(((share > 0) | (blurred.max(axis=2) > 0)).astype(np.float32), (0, 0), 0.6)
        image = np.where((soft > 0.05)[:, :, None], image / np.maximum(weight, 0.05)[:, :, None], blurred)
        found.append(CutOut(np.clip(image, 0, 255).astype(np.float32), soft, float(-left)))
    return found


def simulated() -> list[list[CutOut]]:
    """Return cut-outs of each of the simulator's objects from `SIDES` sides."""
    found = []
    for solid_ in shelf().values():
        whole = []
        for k in range(SIDES):
            drawn = []
            for level in (0, 255):
                image = np.full((480, 640, 3), level, np.uint8)
                solid_.draw(image, 360.0 * k / SIDES)
                drawn.append(image.astype(np.float32))
            # the shadow multiplies the ground, the object replaces it: black ground keeps the object alone
            share = 1 - (drawn[1] - drawn[0]).max(axis=2) / 255
            whole.append((drawn[0], ((drawn[0].max(axis=2) > 0) | (share > 0.99)).astype(np.float32)))
        rows, columns = np.nonzero(sum(share for _, share in whole))
        left, top = columns.min(), rows.min()
        part = np.s_[top : rows.max() + 1, left : columns.max() + 1]
        scale = _LONGEST_PX / max(whole[0][1][part].shape)
        size = [max(2, round(side * scale)) for side in whole[0][1][part].shape[::-1]]
        own = []
        for image, share in whole:
            image, share = (cv2.resize(one[part], size, interpolation=cv2.INTER_AREA) for one in (image, share))
            image = np.where(share[:, :, None] > 0.02, image / np.maximum(share, 0.02)[:, :, None], 0)
            own.append(CutOut(image.astype(np.float32), share, float((320 - left) * scale)))
        found.append(own)
    return found


def _ground(rng: np.random.Generator, strength: float) -> Floats:
    """Return a wall or a table of any pattern: from plain to strong."""
    grey = rng.uniform(15, 235) if rng.random() < 0.85 else rng.uniform(0, 25)
    colour = np.clip(grey + rng.normal(0, 25, 3) * rng.choice([0.3, 1, 2]), 0, 250)
    picture = np.full((HEIGHT, WIDTH, 3), colour, np.float32)
    if rng.random() < 0.5:  # folds of a cloth, and uneven light
        cells = int(rng.integers(2, 7))
        folds = cv2.resize(
            rng.normal(0, rng.uniform(0.02, 0.2), (cells, cells)).astype(np.float32),
            (WIDTH, HEIGHT),
            interpolation=cv2.INTER_CUBIC,
        )
        picture *= np.exp(folds)[:, :, None]
    for cells in (2, 4, 8, 16, 32, 64):
        if strength and rng.random() < 0.75:
            scale = strength * rng.uniform(3, 32) / np.sqrt(cells / 2)
            shape = cells, cells + cells // 3
            grain = rng.normal(0, scale, (*shape, 1)) + rng.normal(0, 0.4 * scale, (*shape, 3))
            way = cv2.INTER_CUBIC if rng.random() < 0.7 else cv2.INTER_NEAREST
            picture += cv2.resize(grain.astype(np.float32), (WIDTH, HEIGHT), interpolation=way)
    for _ in range(int(rng.integers(0, 3)) if strength else 0):
        relief = strength * rng.uniform(-45, 45) * rng.uniform(0.5, 1, 3)
        x, y = np.arange(WIDTH), np.arange(HEIGHT)[:, None]
        angle, period = rng.uniform(0, np.pi), rng.uniform(5, 60)
        phase = (x * np.cos(angle) + y * np.sin(angle)) / period
        kind = rng.random()
        if kind < 0.35:
            wave = (phase % 1 < rng.uniform(0.05, 0.6)).astype(np.float32)
        elif kind < 0.6:
            wave = np.sin(2 * np.pi * phase + rng.uniform(0, 6) * np.sin(y / 30)).astype(np.float32)
        else:
            across = (x * np.sin(angle) - y * np.cos(angle)) / (period * rng.uniform(0.5, 2))
            wave = ((phase.astype(int) + across.astype(int)) % 2).astype(np.float32)
        picture += wave[:, :, None] * relief.astype(np.float32)
    return picture


def scene(
    rng: np.random.Generator, sides: list[CutOut], clutter: list[CutOut], views: int, *, cloth: bool = False
) -> Scene:
    """Draw an object near the middle from one side and ``views`` others; ``clutter`` is around the platter.

    On ``cloth``, objects are larger, and most of them stand on a plain ground without a platter.
    """
    chances = [0.5, 0.35, 0.1, 0.05] if cloth else [0.22, 0.18, 0.35, 0.25]
    strength = float(rng.choice([0.0, 0.3, 1.0, 1.6], p=chances))
    empty, orbit = rng.random() < 0.05, rng.random() < 0.06
    picture = _ground(rng, strength)
    if rng.random() < 0.75:
        horizon = int(rng.uniform(0.4, 0.85) * HEIGHT)
        table = _ground(rng, strength) if rng.random() < 0.8 else picture * rng.uniform(0.6, 1.4)
        picture[horizon:] = table[horizon:]
        picture = cv2.GaussianBlur(picture, (0, 0), rng.uniform(0.4, 2))
    for other in clutter[: int(rng.integers(0, 5)) if rng.random() < 0.15 + 0.8 * min(1, strength) else 0]:
        if rng.random() < 0.75:
            sideways = rng.choice([rng.uniform(-0.05, 0.27), rng.uniform(0.73, 1.05)])
            x, y = sideways * WIDTH, rng.uniform(0.2, 1.0) * HEIGHT
        else:
            x, y = rng.uniform(0.2, 0.8) * WIDTH, rng.uniform(0.1, 0.6) * HEIGHT
        place(picture, other, rng.uniform(0.2, 0.7), x, y)
    # the angles of a search, or of an enrollment
    total = views + 1
    steps = np.arange(total) / total if rng.random() < 0.6 else np.cumsum(rng.uniform(0.05, 0.3, total))
    numbers = _numbers(steps, int(rng.integers(SIDES)))
    angles = [2 * np.pi * n / SIDES for n in numbers]
    x, y = WIDTH * rng.uniform(0.42, 0.58), HEIGHT * rng.uniform(0.62, 0.93)
    across = WIDTH * rng.uniform(0.16, 0.46)
    flat = rng.uniform(0.12, 0.5)
    pictures = [picture.copy() for _ in range(total + 1)]
    if orbit:  # the camera moves around the object, so that the background moves
        way = rng.uniform(10, 70) * rng.choice([-1, 1])
        pictures = [np.roll(one, int(way * n * rng.uniform(0.8, 1.2)), axis=1) for n, one in enumerate(pictures)]
    platter = np.zeros((HEIGHT, WIDTH), np.float32)
    if rng.random() < (0.4 if cloth else 0.75):
        platter = _platter(pictures, [*angles, rng.uniform(0, 6.28)], (x, y), across, flat, rng)
    centred = all(side is sides[0] for side in sides) and rng.random() < 0.7
    away, start = 0.0 if centred else abs(rng.normal(0, 0.12)) * across, rng.uniform(0, 2 * np.pi)
    size = np.exp(rng.uniform(*np.log([0.5, 1.4] if cloth else [0.35, 1.25])))
    shadow, shares = _Shadow(rng), []
    for number, angle, one in zip(numbers, angles, pictures, strict=False):
        side = sides[number]
        if empty:
            shares.append(np.zeros((HEIGHT, WIDTH), np.float32))
            continue
        foot = x + away * np.cos(start - angle), y + away * flat * np.sin(start - angle)
        shadow.onto(one, _cover(side, size, *foot)[1])
        shares.append(place(one, side, size, *foot))
        if rng.random() < 0.3:
            _highlights(one, shares[-1], rng)
    share = shares[0]
    if rng.random() < 0.25:  # a holder or an arm in front, which may have been put there later
        hidden = np.zeros((HEIGHT, WIDTH), np.float32)
        low = int(rng.uniform(0.2, 0.8) * WIDTH), HEIGHT
        if rng.random() < 0.2:
            low = (0 if rng.random() < 0.5 else WIDTH, int(rng.uniform(0.3, 1) * HEIGHT))
        tip = int(WIDTH * rng.uniform(0.35, 0.65)), int(HEIGHT * rng.uniform(0.4, 0.85))
        cv2.line(hidden, low, tip, 1.0, int(rng.integers(2, 9)), cv2.LINE_AA)
        colour = np.float32(rng.uniform(5, 245, 3))
        for one in pictures[: len(pictures) - int(rng.integers(0, 2))]:
            one[:] = one * (1 - hidden[:, :, None]) + colour * hidden[:, :, None]
        share *= 1 - hidden
        platter *= 1 - hidden
    platter *= 1 - share
    images = photographed(pictures, rng)
    masks = (np.rint(255 * np.clip(part, 0, 1)).astype(np.uint8) for part in (share, platter))
    return Scene(images[0], images[1:-1], images[-1], *masks)


def _platter(
    pictures: list[Floats], angles: list[float], at: tuple[float, float], across: float, flat: float,
    rng: np.random.Generator,
) -> Floats:  # fmt: skip
    """Draw the platter, whose marks rotate between the pictures; return the share of each pixel that it covers."""
    x, y = at
    colour = rng.uniform(15, 235) + rng.normal(0, 14, 3)
    thick, rim = int(rng.integers(0, 7)), rng.uniform(0.4, 0.9)
    rings = np.arange(0.15, 1, rng.uniform(0.1, 0.4)) if rng.random() < 0.3 else ()
    ring_colour = (colour * rng.uniform(0.6, 1.4)).tolist()
    marks = [
        (rng.uniform(-1, 1, (2, 2)), rng.uniform(10, 245, 3).tolist(), int(rng.integers(1, 4)))
        for _ in range(int(rng.integers(1, 8)) if rng.random() < 0.4 else 0)
    ]
    grain = _ground(rng, 1.0) if rng.random() < 0.25 else None
    covered = np.zeros((HEIGHT, WIDTH), np.float32)
    for angle, picture in zip(angles, pictures, strict=True):
        rotation = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        for down, share in ((thick, rim), (0, 1.0)):
            shown = np.zeros((HEIGHT, WIDTH), np.float32)
            centre = int(x), int(y) + down
            cv2.ellipse(shown, centre, (int(across), int(across * flat)), 0, 0, 360, 1, -1, cv2.LINE_AA)
            face = np.full((HEIGHT, WIDTH, 3), share * colour, np.float32)
            if down == 0:
                for part in rings:
                    axes = int(across * part), int(across * flat * part)
                    cv2.ellipse(face, centre, axes, 0, 0, 360, ring_colour, 1)
                for ends, ink, wide in marks:
                    line = (ends @ rotation.T) * across * np.array([1, flat]) + np.array([x, y])
                    cv2.line(face, line[0].astype(int).tolist(), line[1].astype(int).tolist(), ink, wide)
                if grain is not None:
                    face = 0.6 * face + 0.4 * grain
            picture[:] = picture * (1 - shown[:, :, None]) + face * shown[:, :, None]
            covered = np.maximum(covered, shown)
    return covered


def _cover(cut: CutOut, size: float, x: float, y: float) -> tuple[Floats, Floats]:
    height = len(cut.share) - 2
    move = np.array([[size, 0, x - size * cut.axis_px], [0, size, y - size * height]])
    # a cut-out that shrinks is averaged, or else its grain is too strong
    image = cv2.GaussianBlur(cut.image, (0, 0), 0.35 / size) if size < 0.8 else cut.image
    image = cv2.warpAffine(image, move, (WIDTH, HEIGHT), borderMode=cv2.BORDER_REPLICATE)
    return image, cv2.warpAffine(cut.share, move, (WIDTH, HEIGHT))


def place(picture: Floats, cut: CutOut, size: float, x: float, y: float) -> Floats:
    """Draw a cut-out with its axis at x and its foot at y; return the share of each pixel that it covers."""
    image, share = _cover(cut, size, x, y)
    picture[:] = picture * (1 - share[:, :, None]) + image * share[:, :, None]
    return share


class _Shadow:
    """The shadow of one lamp."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._foot, self._soft = rng.uniform(0, 0.6), rng.uniform(1, 4)
        self._lean, self._length = rng.uniform(-1.2, 1.2), rng.uniform(0.1, 0.6)
        self._cast, self._blur = rng.uniform(0, 0.75), rng.uniform(1, 6)

    def onto(self, picture: Floats, cover: Floats) -> None:
        left, top, width, height = cv2.boundingRect((cover > 0.5).astype(np.uint8))
        foot = np.zeros_like(cover)
        cv2.ellipse(foot, (left + width // 2, top + height - 2), (int(0.55 * width) + 3, 6), 0, 0, 360, 1, -1)
        shade = 1 - self._foot * cv2.GaussianBlur(foot, (0, 0), self._soft)
        bottom = top + height
        fallen = np.array([[1, self._lean, -self._lean * bottom], [0, self._length, bottom * (1 - self._length)]])
        cast = cv2.GaussianBlur(cv2.warpAffine(cover, fallen, (WIDTH, HEIGHT)), (0, 0), self._blur)
        picture *= (shade * (1 - self._cast * cast))[:, :, None]


def _highlights(picture: Floats, share: Floats, rng: np.random.Generator) -> None:
    rows, columns = np.nonzero(share > 0.5)
    for _ in range(int(rng.integers(0, 4)) if len(rows) else 0):
        i = int(rng.integers(len(rows)))
        spot = np.zeros_like(share)
        axes = int(rng.integers(1, 9)), int(rng.integers(1, 9))
        cv2.ellipse(spot, (int(columns[i]), int(rows[i])), axes, float(rng.uniform(0, 180)), 0, 360, 1, -1)
        picture += (cv2.GaussianBlur(spot, (0, 0), 1.5) * share * rng.uniform(20, 220))[:, :, None]


def photographed(pictures: list[Floats], rng: np.random.Generator) -> list[NDArray[np.uint8]]:
    """Return pictures in one random light, which changes a little, through one lens and sensor; the last is empty."""
    height, width = pictures[0].shape[:2]
    channels = rng.uniform(0.55, 1.4) * (1 + rng.uniform(-0.3, 0.3, 3) * rng.random())
    direction, slope = rng.uniform(0, 2 * np.pi), rng.uniform(0, 0.5)
    x, y = np.arange(width) / width - 0.5, np.arange(height)[:, None] / height - 0.5
    light = (1 + slope * (x * np.cos(direction) + y * np.sin(direction)))[:, :, None] * channels
    exponent, blur = np.exp(rng.uniform(-0.35, 0.35)), rng.uniform(0.3, 1.5) if rng.random() < 0.7 else 0
    noise, images = rng.uniform(0, 6) * rng.random(), []
    other = rng.random() < 0.4
    drift = rng.uniform(0, 0.12) if rng.random() < 0.3 else 0.0  # automatic exposure
    shake = rng.uniform(0, 1.5) if rng.random() < 0.2 else 0.0  # the camera or the cloth has moved
    for n, picture in enumerate(pictures):
        own = light * np.exp(rng.normal(0, drift)) if drift else light
        if n == len(pictures) - 1 and other:  # another light on the picture of the empty table
            own = own * rng.uniform(0.75, 1.3) * (1 + rng.uniform(-0.1, 0.1, 3))
        if n and shake:
            move = np.array([[1, 0, rng.normal(0, shake)], [0, 1, rng.normal(0, shake)]])
            picture = cv2.warpAffine(picture, move, (width, height), borderMode=cv2.BORDER_REPLICATE)
        image = (np.clip(picture * own, 0, 255) * np.float32(1 / 255)).astype(np.float32)
        image = 255 * cv2.pow(image, exponent)
        if blur:
            image = cv2.GaussianBlur(image, (0, 0), blur)
        image = image + rng.standard_normal(image.shape, np.float32) * np.float32(noise)
        images.append(np.clip(np.rint(image), 0, 255).astype(np.uint8))
    return images


def bench_scene(rng: np.random.Generator, sides: list[CutOut], views: int) -> Scene:
    """Draw an object on a drawn bench of the package, 320 x 240, from one side and ``views`` others."""
    seed = int(rng.integers(1000, 10**9))  # the benchmarks use smaller ones
    bench = DrawnBench.drawn(
        np.random.default_rng(seed),
        plain=rng.random() < 0.35,
        textured=float(rng.choice([0.35, 1.0, 1.0])),
        clutter=int(rng.integers(2, 8)),
    )
    kind = rng.random()
    if kind < 0.6:
        top = np.full_like(bench.top, np.median(bench.top, axis=(0, 1)))
        if kind < 0.3:
            top += cv2.resize(rng.normal(0, 5, (48, 48, 1)).astype(np.float32), (192, 192))[:, :, None]
            for _ in range(int(rng.integers(1, 8))):
                ends = (96 + 96 * rng.uniform(-1, 1, 4)).astype(int).tolist()
                ink = rng.uniform(20, 230, 3).tolist()
                cv2.line(top, tuple(ends[:2]), tuple(ends[2:]), ink, int(rng.integers(1, 5)))
        bench = replace(bench, top=top)
    visit = Visit(bench, (ENROLLMENT, MILD, HARD)[int(rng.choice(3, p=[0.4, 0.2, 0.4]))], rng)
    total = views + 1
    steps = np.arange(total) / total if rng.random() < 0.7 else np.cumsum(rng.uniform(0.05, 0.3, total))
    size = 150 / 128 * np.exp(rng.uniform(np.log(0.5), np.log(1.25)))
    empty = rng.random() < 0.05
    images, masks = [], []
    for number in _numbers(steps, int(rng.integers(SIDES))):
        angle_deg = 360 * number / SIDES
        if empty:
            images.append(visit.empty(angle_deg))
            masks.append(np.zeros((240, 320), np.bool_))
            continue
        side = sides[number]
        shown = np.clip(side.image, 0, 255).astype(np.uint8)
        foot = side.axis_px, len(side.share) - 2.0
        frame = visit.photograph(shown, _whole(side.share > 0.5), angle_deg, foot_px=foot, px_per_px=size)
        images.append(frame.image)
        masks.append(frame.mask)
    disc = np.zeros((240, 320), np.uint8)
    for down in (-6, 0):
        cv2.ellipse(disc, (FOOT_PX[0], FOOT_PX[1] + down), (96, 27), 0, 0, 360, 255, -1)
    disc[masks[0]] = 0
    return Scene(images[0], images[1:], visit.empty(), masks[0].astype(np.uint8) * 255, disc)


def _whole(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return a mask without the small holes between points."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats((~mask).astype(np.uint8))
    few = np.flatnonzero(stats[:, cv2.CC_STAT_AREA] < 60)
    return mask | np.isin(labels, few[few > 0])


def _numbers(steps: NDArray[np.float64], first: int) -> list[int]:
    """Return the number of the side after each part of a revolution, never the same one again."""
    numbers: list[int] = []
    for step in steps:
        number = (first + round(step * SIDES)) % SIDES
        while number in numbers:
            number = (number + 1) % SIDES
        numbers.append(number)
    return numbers
