"""The object's silhouette: from the pixels that differ from the background, by its colours, or by a neural network.

A small network labels the object, the platter, and everything else. It sees a small frame and the colours of its border
and, where the background is known, the frame's difference from it. The background is known from the empty-table image,
or was learned while the table rotated: then the network also sees how much it changes from view to view, and whether
each pixel is as in other views. The weights are in the wheel. The model card says how they were made:
docs/explanation/segmentation-network.md.

Decision: docs/decisions/0013.
"""

from functools import cache, lru_cache
from importlib.resources import files
from io import BytesIO
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from hbr.core.arrays import ImageArray
from hbr.kernels.nets import Floats, Net, SharedNet
from hbr.segmentation.background import LEAST, Difference, Mask, SegmentedFrame

Binary = NDArray[np.uint8]

#: Another part belongs to the object if it has this share of the largest part's area.
_PART: Final = 0.08
#: and, if something may reach into the frame, is so near.
_NEAR_PX: Final = 5
#: The object is smaller than a part at the frame's border by at most this.
_OF_BORDER: Final = 0.6
#: Radii of the bars that are removed when something reaches into the frame, in pixels of the small image.
_BARS: Final = (0, 2, 3, 4, 5)
#: Rows at the foot that are narrower than this share of the median row are the rest of a removed bar.
_STUMP: Final = 0.35


def silhouette(certain: Mask, possible: Mask | None = None, *, framed: bool) -> Mask | None:
    """Return the object's silhouette without holes, bool (h, w); None if there is no object.

    Parameters
    ----------
    certain, possible : bool arrays (h, w)
        Pixels that are not background, and pixels that may be shadow; the latter count inside the object's hull.
    framed : bool
        Whether anything that touches the frame's border is not the object: a holder, a hand, a shelf.
    """
    everything = _cleaned(certain.astype(np.uint8))
    for radius in _BARS if framed else _BARS[:1]:
        kept = _main_parts(_opened(everything, radius), framed=framed)
        if kept is None:
            continue
        if radius:  # restore the corners that the opening rounded off
            kept = _without_stump(cv2.dilate(kept, _disc(1)).astype(np.uint8) & everything)
        if possible is not None:
            hull = np.zeros_like(kept)
            # the hull of the outlines equals that of all pixels, and takes a tenth of the time
            outlines, _ = cv2.findContours(kept, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
            cv2.fillConvexPoly(hull, cv2.convexHull(np.concatenate(outlines)), (1,))
            kept |= hull & possible
        return _filled(kept)
    return None


def _cleaned(mask: Binary) -> Binary:
    """Remove single pixels, and join what is separated by a few."""
    opened = cv2.morphologyEx(mask, cv2.MORPH_OPEN, _disc(1))
    return cv2.morphologyEx(opened, cv2.MORPH_CLOSE, _disc(3)).astype(np.uint8, copy=False)


def _without_stump(mask: Binary) -> Binary:
    """Remove the rest of a holder from below: objects stand on a wider base."""
    widths = np.count_nonzero(mask, axis=1)
    foot = np.flatnonzero(widths >= _STUMP * np.median(widths[widths > 0]))[-1]
    mask[foot + 1 :] = 0
    return mask


def _opened(mask: Binary, radius: int) -> Binary:
    return cv2.morphologyEx(mask, cv2.MORPH_OPEN, _disc(radius)).astype(np.uint8) if radius else mask


def _main_parts(mask: Binary, *, framed: bool) -> Binary | None:
    """Return the largest part and those close to it; None if a part that touches the border is much larger."""
    left, top, across, down = cv2.boundingRect(mask)
    if not across:
        return None
    within = np.s_[top : top + down, left : left + across]
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask[within])
    stats[:, :2] += left, top
    height, width = mask.shape
    x, y, w, h, area = stats[1:].T
    outside = framed & ((x == 0) | (y == 0) | (x + w == width) | (y + h == height))
    inner, outer = np.where(outside, 0, area), np.where(outside, area, 0)
    largest = int(inner.argmax())
    if inner[largest] < max(LEAST * mask.size, _OF_BORDER * outer.max()):
        return None
    keep = inner > _PART * inner[largest]
    if framed:
        keep &= _near(stats[1:], largest, _NEAR_PX)
    chosen = 1 + np.flatnonzero(keep)
    parts = np.zeros_like(mask)
    parts[within] = labels == chosen[0] if len(chosen) == 1 else np.isin(labels, chosen)
    return parts


def _near(stats: cv2.typing.MatLike, main: int, px: int) -> Mask:
    """Return which parts, by their boxes, are at most this far from one of them."""
    x, y, w, h, _ = stats.T
    across = (x < x[main] + w[main] + px) & (x[main] < x + w + px)
    near: Mask = across & (y < y[main] + h[main] + px) & (y[main] < y + h + px)
    return near


def _filled(mask: Binary) -> Mask:
    margin = 12  # so that closing does not see the frame's border as background
    height, width = mask.shape
    left, top, across, down = cv2.boundingRect(mask)
    part = mask[top : top + down, left : left + across]  # closing adds nothing outside the box
    closed = cv2.copyMakeBorder(part, margin, margin, margin, margin, cv2.BORDER_CONSTANT)
    closed = cv2.morphologyEx(closed, cv2.MORPH_CLOSE, _disc(8)).astype(np.uint8, copy=False)
    contours, _ = cv2.findContours(closed, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(closed, contours, -1, (1,), -1)
    filled = np.zeros((height, width), np.bool_)
    filled[top : top + down, left : left + across] = closed[margin:-margin, margin:-margin]
    return filled


@lru_cache
def _disc(radius: int) -> Binary:
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1)).astype(np.uint8)


#: Part of the frame that an object may be in: left, top, right, bottom.
_WITHIN: Final = (0.2, 0.12, 0.8, 0.9)
#: Where an object usually is in the image of a turntable: middle and widths of a bell-shaped weight (x, y).
_MIDDLE: Final = (0.5, 0.56)
# wider: clutter at the sides counts as the object; narrower: wide objects lose their sides
_SPREAD: Final = (0.16, 0.22)
#: GrabCut starts from the pixels whose weight is higher than this. If it returns nothing or everything, it starts again
#: with the next value.
_STARTS: Final = (0.5, 0.3, 0.7, 0.15)
#: Smallest and largest share of the frame that an object takes.
_GUESS_LEAST, _GUESS_MOST = 0.015, 0.45
#: Connections to clutter behind the object are cut if thinner than this radius, a share of the longer side.
_BRIDGE: Final = 0.024  # larger: thin parts such as handles are cut off; smaller: clutter stays connected
#: Another part belongs to the object if it has this share of the main part's area, and this mean weight.
_GUESS_PART: Final = 0.08
_PART_WEIGHT: Final = 0.35  # less: most of the part is away from the usual place of an object, where clutter is
_GUESS_NEAR_PX: Final = 3  # a part as near as this, such as a handle, was cut off by `_BRIDGE`


def guess_object(small: ImageArray) -> Mask | None:
    """Return a mask of the object in the middle, found by its colours, bool (h, w); None if there is no clear part.

    GrabCut separates colours of the middle from colours of the border. Parts away from the usual place of an object
    are clutter and are removed. The convex hull is returned, because a guess finds the object's outline more reliably
    than its holes.

    Source: C. Rother, V. Kolmogorov and A. Blake, "GrabCut", SIGGRAPH 2004. Takes several times as long as the other
    methods, and is correct less often.
    """
    height, width = small.shape[:2]
    size = max(32, width), max(32, height)  # GrabCut fits mixtures of five colours and needs enough pixels
    image = cv2.resize(small, size, interpolation=cv2.INTER_LINEAR) if size != (width, height) else small
    smooth = cv2.bilateralFilter(image, 5, 30, 3).astype(np.uint8, copy=False)
    prior = _prior(size[1], size[0])
    for start in _STARTS:
        part = _main_part(_cut(smooth, prior > start), prior)
        if part is not None and _GUESS_LEAST < part.mean() < _GUESS_MOST:
            hull = np.zeros_like(part)
            cv2.fillConvexPoly(hull, cv2.convexHull(cv2.findNonZero(part)), (1,))
            found: Mask = cv2.resize(hull, (width, height), interpolation=cv2.INTER_NEAREST) > 0
            return found
    return None


def _cut(image: ImageArray, start: Mask) -> Binary:
    height, width = start.shape
    left, top, right, bottom = (int(part * (width, height)[i % 2]) for i, part in enumerate(_WITHIN))
    labels = np.full((height, width), cv2.GC_BGD, np.uint8)
    inner = start[top:bottom, left:right]
    labels[top:bottom, left:right] = np.where(inner, cv2.GC_PR_FGD, cv2.GC_PR_BGD)
    cv2.setRNGSeed(0)  # GrabCut starts at random; equal frames must give equal masks
    cv2.grabCut(image, labels, None, np.zeros((1, 65)), np.zeros((1, 65)), 1, cv2.GC_INIT_WITH_MASK)  # type: ignore[call-overload]
    return np.isin(labels, (cv2.GC_FGD, cv2.GC_PR_FGD)).astype(np.uint8)


def _main_part(cut: Binary, prior: NDArray[np.float32]) -> Binary | None:
    """Return the part with the largest weight and the parts close to it, without thin connections to clutter."""
    radius = max(1, round(_BRIDGE * max(cut.shape)))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    opened = cv2.morphologyEx(cut, cv2.MORPH_OPEN, disc).astype(np.uint8, copy=False)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(opened)
    if count < 2:
        return None
    weight = np.bincount(labels.ravel(), prior.ravel(), count)[1:]
    area = stats[1:, cv2.CC_STAT_AREA]
    main = int(weight.argmax())
    keep = _near(stats[1:], main, _GUESS_NEAR_PX) & (area > _GUESS_PART * area[main]) & (weight > _PART_WEIGHT * area)
    keep[main] = True
    part = np.isin(labels, 1 + np.flatnonzero(keep)).astype(np.uint8)
    return cv2.dilate(part, np.ones((3, 3), np.uint8)).astype(np.uint8) & cut


@lru_cache
def _prior(height: int, width: int) -> NDArray[np.float32]:
    x = ((np.arange(width) + 0.5) / width - _MIDDLE[0]) / _SPREAD[0]
    y = ((np.arange(height) + 0.5) / height - _MIDDLE[1]) / _SPREAD[1]
    prior: NDArray[np.float32] = np.exp(-0.5 * (x * x + (y * y)[:, None])).astype(np.float32)
    return prior


#: Size of the network's input.
WIDTH: Final = 128
HEIGHT: Final = 96  # a change of the size needs another training of the network
#: Scales of the input's planes, in logarithms: brightness, colour, spread, and distance from the border's colours.
_EVENLY: Final = 1.0
_COLOURED: Final = 0.7  # smaller than `_EVENLY`, because shadows change the brightness more than the colour
_SPREAD_SCALE: Final = 0.5
_FROM_BORDER: Final = 1.0
#: Trust in a background for each view that it was learned from; 1 for an empty-table image.
_OF_A_VIEW: Final = 0.1


class Shares(NamedTuple):
    """The probability of each pixel of a small frame to show the object, and the platter; float32 (h, w)."""

    object: Floats
    platter: Floats


def shares(frame: SegmentedFrame, difference: Difference | None = None) -> Shares:
    """Return where the small image of a frame shows the object and the platter.

    ``difference`` is the frame's from its background, if that is known.
    """
    height, width = frame.small.shape[:2]
    logits = _interleaved(_NETWORK(_planes(frame, difference)))
    found = [1 / (1 + cv2.exp(-plane)) for plane in logits]
    if (height, width) != (HEIGHT, WIDTH):
        found = [cv2.resize(share, (width, height), interpolation=cv2.INTER_LINEAR) for share in found]
    return Shares(*(np.asarray(share, np.float32) for share in found))


def _interleaved(fourfold: Floats) -> Floats:
    """Return the planes (n, 2 h, 2 w), of whose pixels the network computes each fourth one: (h, w, 4 n).

    The last layer is a convolution: a transposed one, as it was trained, takes three times as long.
    """
    height, width, planes = fourfold.shape
    apart = fourfold.reshape(height, width, planes // 4, 2, 2)
    return apart.transpose(2, 0, 3, 1, 4).reshape(planes // 4, 2 * height, 2 * width)


def _planes(frame: SegmentedFrame, difference: Difference | None) -> Floats:
    """Return the network's input, float32 (HEIGHT, WIDTH, 13)."""
    planes = np.zeros((HEIGHT, WIDTH, 13), np.float32)
    planes[..., :3] = _sized(frame.small) * np.float32(1 / 255) - np.float32(0.5)
    planes[..., 3:5] = _places()
    planes[..., 5] = np.minimum(_sized(frame.from_border) * np.float32(1 / _FROM_BORDER), 1)
    if difference is not None:
        background = difference.background
        planes[..., 6] = np.clip(_sized(difference.evenly) * np.float32(1 / _EVENLY), -1, 1)
        planes[..., 7] = np.minimum(_sized(difference.coloured) * np.float32(1 / _COLOURED), 1)
        planes[..., 8] = np.minimum(_sized(background.spread) * np.float32(1 / _SPREAD_SCALE), 1)
        for plane, compared in enumerate(background.view_differences(difference), 9):
            planes[..., plane] = _sized(compared)
        planes[..., 12] = _OF_A_VIEW * background.views or 1.0
    return planes


def _sized(plane: NDArray[Any]) -> NDArray[Any]:
    if plane.shape[:2] == (HEIGHT, WIDTH):
        return plane
    return np.asarray(cv2.resize(plane, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA))


@cache
def _places() -> Floats:
    """Return each pixel's place from -1 to 1: across, and down."""
    y, x = np.meshgrid(np.linspace(-1, 1, HEIGHT), np.linspace(-1, 1, WIDTH), indexing="ij")
    return np.stack([x, y], axis=-1).astype(np.float32)


def _network() -> Net:
    """Return the network: an encoder, and a decoder that adds what the encoder found at the same size."""
    with np.load(BytesIO(files("hbr.segmentation").joinpath("network.npz").read_bytes())) as stored:
        weights = dict(stored)
    net = Net(HEIGHT, WIDTH, 13)

    def layer(image: Floats, name: str, stride: int = 1, dilation: int = 1) -> Floats:
        own = weights[f"{name}.weight"], weights[f"{name}.bias"]
        return net.convolve(image, *own, stride=stride, dilation=dilation, low=0.0)

    def doubled(image: Floats, name: str, added: Floats) -> Floats:
        return net.double(image, weights[f"{name}.weight"], weights[f"{name}.bias"], added)

    half = layer(net.input, "first", 2)
    quarter = layer(layer(half, "quarter.0", 2), "quarter.1")
    eighth = layer(layer(quarter, "eighth.0", 2), "eighth.1")
    deep = layer(layer(layer(eighth, "deep.0", 2), "deep.1"), "deep.2", dilation=2)
    eighth = layer(doubled(deep, "up_eighth", eighth), "to_eighth")
    quarter = layer(doubled(eighth, "up_quarter", quarter), "to_quarter")
    half = layer(doubled(quarter, "up_half", half), "to_half")
    # four pixels of the whole size in each pixel of half the size
    whole = net.convolve(net.input, weights["full.weight"], weights["full.bias"], stride=2, before=0)
    whole = net.convolve(half, weights["up.weight"], weights["up.bias"], added=whole, low=0.0)
    net.convolve(whole, weights["out.weight"], weights["out.bias"])
    return net


_NETWORK: Final = SharedNet(_network)
