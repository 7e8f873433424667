"""Drawn scenes for training: cut-outs of drawn objects on drawn benches, with the object's and the platter's pixels.

Nothing comes from photographs: the objects are those of the simulator, and random shapes with random textures.
"""

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from sim.objects.shelf import shelf

Floats = NDArray[np.float32]
WIDTH, HEIGHT = 192, 144


class CutOut(NamedTuple):
    """A drawn object: float32 (h, w, 3), and the share of each pixel that it covers, float32 (h, w)."""

    image: Floats
    share: Floats


class Scene(NamedTuple):
    """A frame, three frames of the rotated table and one of the empty table, uint8 (144, 192, 3), and the true masks.

    The masks are the shares of object and platter in each pixel, uint8 (144, 192).
    """

    image: NDArray[np.uint8]
    rotated: list[NDArray[np.uint8]]
    empty: NDArray[np.uint8]
    object: NDArray[np.uint8]
    platter: NDArray[np.uint8]


def simulated(azimuths: int) -> list[list[CutOut]]:
    """Return cut-outs of each of the simulator's objects, from a number of sides."""
    found = []
    for solid in shelf().values():
        own = []
        for k in range(azimuths):
            drawn = []
            for level in (0, 255):
                image = np.full((480, 640, 3), level, np.uint8)
                solid.draw(image, 360.0 * k / azimuths)
                drawn.append(image.astype(np.float32))
            # the shadow multiplies the ground, the object replaces it: black ground keeps the object alone
            share = 1 - (drawn[1] - drawn[0]).max(axis=2) / 255
            object_share = ((drawn[0].max(axis=2) > 0) | (share > 0.99)).astype(np.float32)
            rows, columns = np.nonzero(object_share)
            part = np.s_[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
            own.append(_small(CutOut(drawn[0][part], object_share[part])))
        found.append(own)
    return found


def _small(cut: CutOut, longest: int = 140) -> CutOut:
    scale = longest / max(cut.share.shape)
    if scale >= 1:
        return cut
    size = max(2, round(cut.share.shape[1] * scale)), max(2, round(cut.share.shape[0] * scale))
    image, share = (cv2.resize(part, size, interpolation=cv2.INTER_AREA) for part in cut)
    return CutOut(image, share)


def shape(rng: np.random.Generator) -> CutOut:
    """Draw a random object: a body of revolution, a box, or a union of rounded parts, with random texture."""
    height, width = int(rng.integers(60, 141)), int(rng.integers(50, 141))
    mask = np.zeros((height, width), np.uint8)
    light = np.ones((height, width), np.float32)
    x = np.linspace(-1, 1, width, dtype=np.float32)[None]
    kind = rng.random()
    if kind < 0.35:  # lathe
        knots = np.clip(np.cumsum(rng.normal(0, 0.25, 7)) + rng.uniform(0.4, 0.9), 0.12, 1)
        if rng.random() < 0.5:
            knots[:] = np.where(np.arange(7) < rng.integers(0, 4), rng.uniform(0.3, 0.8), rng.uniform(0.6, 1))
        radius = np.interp(np.linspace(0, 6, height), np.arange(7), knots)[:, None].astype(np.float32)
        radius = cv2.blur(radius, (1, 9)).reshape(-1, 1)
        mask[:] = np.abs(x) <= radius
        bottom = int(0.06 * height) + 1
        cv2.ellipse(mask, (width // 2, height - bottom), (int(radius[-1, 0] * width / 2), bottom), 0, 0, 360, 1, -1)
        light = 0.55 + 0.55 * np.sqrt(np.clip(1 - (x / np.maximum(radius, 0.05) - rng.uniform(-0.5, 0.5)) ** 2, 0, 1))
    elif kind < 0.65:  # box, seen at an edge
        edge = rng.uniform(0.1, 0.9) * width
        slant, top = rng.uniform(0, 0.12) * height, rng.uniform(0, 0.2) * height
        left = np.array([[0, top + slant], [edge, top + 2 * slant], [edge, height], [0, height - slant]])
        right = np.array([[edge, top + 2 * slant], [width, top + slant], [width, height - slant], [edge, height]])
        lid = np.array([[0, top + slant], [edge, top + 2 * slant], [width, top + slant], [width - edge, top]])
        light = np.zeros((height, width), np.float32)
        for face, level in zip((left, right, lid), rng.uniform(0.55, 1.1, 3), strict=True):
            cv2.fillPoly(light, [face.astype(np.int32)], float(level))
        mask[:] = light > 0
        light = np.where(mask > 0, light, 1)
    else:  # parts
        for _ in range(int(rng.integers(1, 7))):
            centre = int(rng.uniform(0.2, 0.8) * width), int(rng.uniform(0.2, 0.85) * height)
            axes = int(rng.uniform(0.08, 0.5) * width) + 2, int(rng.uniform(0.08, 0.5) * height) + 2
            if rng.random() < 0.6:
                cv2.ellipse(mask, centre, axes, float(rng.uniform(0, 180)), 0, 360, 1, -1)
            else:
                box = cv2.boxPoints((centre, (1.4 * axes[0], 1.4 * axes[1]), float(rng.uniform(0, 180))))
                cv2.fillConvexPoly(mask, box.astype(np.int32), 1)
        _, labels, stats, _ = cv2.connectedComponentsWithStats(mask)
        mask = (labels == 1 + stats[1:, cv2.CC_STAT_AREA].argmax()).astype(np.uint8)
        depth = cv2.distanceTransform(mask, cv2.DIST_L2, 3)
        light = 0.6 + 0.5 * np.minimum(1, depth / (0.25 * min(height, width))) + 0.15 * rng.normal() * x
    colours = _texture(rng, height, width) * np.asarray(light, np.float32)[:, :, None]
    rows, columns = np.nonzero(mask)
    part = np.s_[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    return CutOut(np.clip(colours[part], 0, 255).astype(np.float32), mask[part].astype(np.float32))


def _texture(rng: np.random.Generator, height: int, width: int) -> Floats:
    """Return a random texture of an object: few colours, panels, stripes, print, and a little grain."""
    vivid = rng.random() < 0.6

    def colour() -> NDArray[np.float64]:
        return rng.uniform(10, 245, 3) if vivid else rng.uniform(15, 240) + rng.normal(0, 14, 3)

    picture = np.full((height, width, 3), colour(), np.float32)
    for _ in range(int(rng.integers(0, 6))):
        kind, ink = rng.random(), colour().tolist()
        x0, y0 = int(rng.uniform(-0.1, 0.9) * width), int(rng.uniform(-0.1, 0.9) * height)
        x1, y1 = x0 + int(rng.uniform(0.1, 0.9) * width), y0 + int(rng.uniform(0.08, 0.6) * height)
        if kind < 0.35:
            cv2.rectangle(picture, (x0, y0), (x1, y1), ink, -1)
        elif kind < 0.5:
            cv2.rectangle(picture, (-1, y0), (width, y0 + int(rng.uniform(0.03, 0.4) * height)), ink, -1)
        elif kind < 0.65:
            cv2.circle(picture, (x0, y0), int(rng.uniform(0.05, 0.4) * width), ink, -1)
        elif kind < 0.85:
            words = "".join(chr(c) for c in rng.integers(65, 91, int(rng.integers(2, 8))))
            print_ = np.zeros((height, width), np.uint8)
            cv2.putText(print_, words, (x0, y1), 0, float(rng.uniform(0.3, 1.4)), 255, int(rng.integers(1, 4)))
            picture[print_ > 127] = ink
        else:
            step = int(rng.integers(3, 14))
            picture[:, (np.arange(width) // step) % 2 == 0] = ink
    if rng.random() < 0.5:
        cells = int(rng.integers(3, 24))
        grain = rng.normal(0, rng.uniform(2, 25), (cells, cells, 1)) + rng.normal(0, 4, (cells, cells, 3))
        picture += cv2.resize(grain.astype(np.float32), (width, height), interpolation=cv2.INTER_CUBIC)
    return picture


def _ground(rng: np.random.Generator) -> Floats:
    """Return a wall or a table of any pattern: from plain to strong."""
    strength = rng.choice([0.0, 0.3, 1.0, 1.6], p=[0.15, 0.25, 0.4, 0.2])
    colour = rng.uniform(15, 235) + rng.normal(0, 25, 3)
    picture = np.full((HEIGHT, WIDTH, 3), colour, np.float32)
    for cells in (2, 4, 8, 16, 32, 64):
        if rng.random() < 0.75:
            scale = strength * rng.uniform(3, 32) / np.sqrt(cells / 2)
            grain = rng.normal(0, scale, (cells, cells + cells // 3, 1)) + rng.normal(
                0, 0.4 * scale, (cells, cells + cells // 3, 3)
            )
            way = cv2.INTER_CUBIC if rng.random() < 0.7 else cv2.INTER_NEAREST
            picture += cv2.resize(grain.astype(np.float32), (WIDTH, HEIGHT), interpolation=way)
    for _ in range(int(rng.integers(0, 3))):
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


def scene(rng: np.random.Generator, sides: list[CutOut], clutter: list[CutOut]) -> Scene:
    """Draw an object near the middle from four sides; ``clutter`` is beside and behind the platter."""
    picture = _ground(rng)
    if rng.random() < 0.9:
        horizon = int(rng.uniform(0.4, 0.8) * HEIGHT)
        table = _ground(rng)
        if rng.random() < 0.4:
            table = cv2.resize(table, (WIDTH, 2 * HEIGHT))[HEIGHT::2][: HEIGHT - horizon].repeat(2, axis=0)[
                : HEIGHT - horizon
            ]
            picture[horizon : horizon + len(table)] = table
        else:
            picture[horizon:] = table[horizon:]
    for other in clutter[: int(rng.integers(0, 5))]:
        if rng.random() < 0.75:
            x, y = (
                rng.choice([rng.uniform(-0.05, 0.27), rng.uniform(0.73, 1.05)]) * WIDTH,
                rng.uniform(0.2, 1.0) * HEIGHT,
            )
        else:
            x, y = rng.uniform(0.2, 0.8) * WIDTH, rng.uniform(0.1, 0.6) * HEIGHT
        place(picture, other, rng.uniform(0.15, 0.55), x, y)
    # the platter, rotated in the picture of the empty table
    x, y = WIDTH * rng.uniform(0.45, 0.55), HEIGHT * rng.uniform(0.68, 0.9)
    across = WIDTH * rng.uniform(0.18, 0.42)
    flat = rng.uniform(0.15, 0.5)
    pictures = [picture.copy() for _ in range(5)]
    platter = np.zeros((HEIGHT, WIDTH), np.float32)
    if rng.random() < 0.85:
        platter = _platter(pictures, (x, y), across, flat, rng)
    # the object and its shadow; it moves around the axis
    away, start = abs(rng.normal(0, 0.2)) * across, rng.uniform(0, 2 * np.pi)
    size = rng.uniform(0.6, 1.35) * (WIDTH / 256)
    shadow, shares = _Shadow(rng), []
    for n, (side, one) in enumerate(zip(sides, pictures, strict=False)):
        foot_x = x + away * np.cos(start + n * np.pi / 2)
        foot_y = y + away * flat * np.sin(start + n * np.pi / 2) + 2
        shadow.onto(one, _cover(side, size, foot_x, foot_y)[1])
        shares.append(place(one, side, size, foot_x, foot_y))
        _highlights(one, shares[-1], rng)
    share = shares[0]
    if rng.random() < 0.4:  # a holder or an arm in front, which may have been put there later
        hidden = np.zeros((HEIGHT, WIDTH), np.float32)
        low = int(rng.uniform(0.2, 0.8) * WIDTH), HEIGHT
        if rng.random() < 0.2:
            low = (0 if rng.random() < 0.5 else WIDTH, int(rng.uniform(0.3, 1) * HEIGHT))
        tip = int(WIDTH * rng.uniform(0.35, 0.65)), int(HEIGHT * rng.uniform(0.4, 0.85))
        cv2.line(hidden, low, tip, 1.0, int(rng.integers(2, 9)), cv2.LINE_AA)
        colour = np.float32(rng.uniform(5, 245, 3))
        for one in pictures[: int(rng.integers(4, 6))]:
            one[:] = one * (1 - hidden[:, :, None]) + colour * hidden[:, :, None]
        share *= 1 - hidden
        platter *= 1 - hidden
    platter *= 1 - share
    images = photographed(pictures, rng)
    return Scene(
        images[0], images[1:4], images[4], *(np.rint(255 * part).astype(np.uint8) for part in (share, platter))
    )


def _platter(
    pictures: list[Floats], at: tuple[float, float], across: float, flat: float, rng: np.random.Generator
) -> Floats:
    """Draw the platter, whose marks rotate between the pictures; return the share of each pixel that it covers."""
    x, y = at
    colour = rng.uniform(15, 225) + rng.normal(0, 14, 3)
    thick, rim = int(rng.integers(0, 7)), rng.uniform(0.4, 0.9)
    rings = np.arange(0.15, 1, rng.uniform(0.1, 0.4)) if rng.random() < 0.3 else ()
    ring_colour = (colour * rng.uniform(0.6, 1.4)).tolist()
    marks = [
        (rng.uniform(-1, 1, (2, 2)), rng.uniform(10, 245, 3).tolist(), int(rng.integers(1, 4)))
        for _ in range(int(rng.integers(1, 6)) if rng.random() < 0.35 else 0)
    ]
    grain = _ground(rng) if rng.random() < 0.3 else None
    covered = np.zeros((HEIGHT, WIDTH), np.float32)
    for n, picture in enumerate(pictures):
        angle = rng.uniform(0, 2 * np.pi) if n == 4 else n * np.pi / 2
        rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        for down, share in ((thick, rim), (0, 1.0)):
            shown = np.zeros((HEIGHT, WIDTH), np.float32)
            centre = int(x), int(y) + down
            cv2.ellipse(shown, centre, (int(across), int(across * flat)), 0, 0, 360, 1, -1, cv2.LINE_AA)
            face = np.full((HEIGHT, WIDTH, 3), share * colour, np.float32)
            if down == 0 and thick >= 0:
                for part in rings:
                    cv2.ellipse(
                        face, centre, (int(across * part), int(across * flat * part)), 0, 0, 360, ring_colour, 1
                    )
                for ends, ink, wide in marks:
                    line = (ends @ rotation.T) * across * np.array([1, flat]) + np.array([x, y])
                    cv2.line(face, line[0].astype(int).tolist(), line[1].astype(int).tolist(), ink, wide)
                if grain is not None:
                    face = 0.6 * face + 0.4 * grain
            picture[:] = picture * (1 - shown[:, :, None]) + face * shown[:, :, None]
            covered = np.maximum(covered, shown)
    return covered


def _cover(cut: CutOut, size: float, x: float, y: float) -> tuple[Floats, Floats]:
    height, width = cut.share.shape
    move = np.array([[size, 0, x - size * width / 2], [0, size, y - size * height]])
    image = cv2.warpAffine(cut.image, move, (WIDTH, HEIGHT), borderMode=cv2.BORDER_REPLICATE)
    return image, cv2.warpAffine(cut.share, move, (WIDTH, HEIGHT))


def place(picture: Floats, cut: CutOut, size: float, x: float, y: float) -> Floats:
    """Draw a cut-out with its foot at x, y; return the share of each pixel that it covers."""
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
    """Return pictures in one random light, which changes a little, through one lens and sensor."""
    height, width = pictures[0].shape[:2]
    channels = rng.uniform(0.55, 1.4) * (1 + rng.uniform(-0.3, 0.3, 3) * rng.random())
    direction, slope = rng.uniform(0, 2 * np.pi), rng.uniform(0, 0.5)
    x, y = np.arange(width) / width - 0.5, np.arange(height)[:, None] / height - 0.5
    light = (1 + slope * (x * np.cos(direction) + y * np.sin(direction)))[:, :, None] * channels
    exponent, blur = np.exp(rng.uniform(-0.35, 0.35)), rng.uniform(0.3, 1.5) if rng.random() < 0.7 else 0
    noise, images = rng.uniform(0, 6), []
    other = rng.random() < 0.4
    for n, picture in enumerate(pictures):
        if n == 4 and other:  # another light on the picture of the empty table
            light = light * rng.uniform(0.75, 1.3) * (1 + rng.uniform(-0.1, 0.1, 3))
        image = (np.clip(picture * light, 0, 255) * np.float32(1 / 255)).astype(np.float32)
        image = 255 * cv2.pow(image, exponent)
        if blur:
            image = cv2.GaussianBlur(image, (0, 0), blur)
        image = image + rng.standard_normal(image.shape, np.float32) * np.float32(noise)
        images.append(np.clip(np.rint(image), 0, 255).astype(np.uint8))
    return images
