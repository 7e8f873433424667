"""CEDD, the Color and Edge Directivity Descriptor, equal to the LIRE reference at all 144 levels.

Source: Chatzichristofis and Boutalis, "CEDD: Color and Edge Directivity Descriptor. A Compact Descriptor for Image
Indexing and Retrieval", ICVS 2008, in the reading of LIRE's ``features.global.CEDD``.

Vectors over the blocks are laid out component first, ``(k, blocks)``, so that every operation runs along memory.
"""

from typing import Final

import cv2
import numpy as np

from hbr._cedd_tables import HUE_BINS, HUE_WEIGHT, LOW_HIGH, REPRESENTATIVES, SATURATION, VALUE
from hbr.arrays import FloatArray, ImageArray, IndexArray, LevelArray
from hbr.checks import check_image

#: Bins of the descriptor: 6 texture classes of 24 colours, bin = 24 * texture + colour.
BINS: Final = 144
#: The sides that the block grid covers completely are multiples of this many pixels.
GRID: Final = 80
#: `describe` brings no image to a longer side than this.
LONGEST_SIDE: Final = 640

_EDGE_THRESHOLD: Final = 14.0
_CLASS_THRESHOLDS: Final = np.array([[0.68], [0.98], [0.98], [0.98], [0.98]])
#: Of a pixel B, G, R: the three channels, and the luminance in thousandths.
_CHANNELS: Final = np.column_stack([np.eye(3), [114.0, 587.0, 299.0]])
_SQRT2: Final = np.sqrt(2.0)
#: Non-directional, horizontal and vertical edge, of the quarters a, b, c, d.
_FILTERS: Final = np.array([[2.0, -2.0, -2.0, 2.0], [1.0, 1.0, -1.0, -1.0], [1.0, -1.0, 1.0, -1.0]])


def cedd(image_bgr: ImageArray) -> LevelArray:
    """Describe an image by CEDD, to the letter of the reference.

    The reference lays a grid of equal blocks over the top left of the image and ignores what remains on the right and
    at the bottom (61 % of a 128 x 128 image). `describe` is the call that looks at the whole image.

    Parameters
    ----------
    image_bgr : uint8 array (H, W, 3)
        Any size, in OpenCV's channel order; slices and flipped views are welcome.

    Returns
    -------
    uint8 array (144,)
        Levels 0..7, bin = 24 * texture + colour. All zero where a side is shorter than 2 pixels.

    Raises
    ------
    TypeError, ValueError
        The image is no uint8 array, or is not of shape (H, W, 3).
    """
    check_image(image_bgr)
    image = np.ascontiguousarray(image_bgr)
    grid = _grid(*image.shape[:2])
    if 0 in grid[:2]:
        return np.zeros(BINS, np.uint8)
    quarter_sums = _quarter_sums(image, grid)
    textures, blocks = _texture_votes(_areas(image, quarter_sums, grid))
    bins, outputs = _colour_outputs(*_block_colours(quarter_sums, grid))
    # bincount adds in the order given: raster order in every bin, so the sums equal the reference's to the last bit
    histogram = np.bincount(
        (bins.take(blocks, axis=0) + 24 * textures[:, None]).ravel(),
        weights=outputs.take(blocks, axis=0).ravel(),
        minlength=BINS,
    )
    shares = histogram / histogram.cumsum()[-1]
    levels: IndexArray = np.abs(shares[:, None] - REPRESENTATIVES).argmin(axis=1)
    return levels.astype(np.uint8)


def describe(image_bgr: ImageArray, *, size: tuple[int, int] | None = None) -> LevelArray:
    """Describe the whole image: bring it to a size that the block grid covers, then apply `cedd`.

    Without `size`, an image with a side above 640 pixels is scaled down to that side; then each side becomes the
    nearest multiple of 80 (half-way up), at least 80: 640 x 480 stays, 128 x 128 becomes 160 x 160, 1920 x 1080 becomes
    640 x 400. Views that are to be compared should come from frames of one size.

    Parameters
    ----------
    image_bgr : uint8 array (H, W, 3)
        As for `cedd`; no side may be 0.
    size : (int, int), optional
        Width and height to use instead, multiples of 80.

    Returns
    -------
    uint8 array (144,)
        Levels 0..7.

    Raises
    ------
    TypeError, ValueError
        As for `cedd`, or `size` is not of positive multiples of 80.
    """
    check_image(image_bgr)
    if size is not None and any(side <= 0 or side % GRID for side in size):
        raise ValueError(f"size is {size}; both sides must be positive multiples of {GRID}, e.g. (640, 480)")
    height, width = image_bgr.shape[:2]
    return cedd(_resize(image_bgr, *(size or _covered_size(width, height))))


def covered(image_bgr: ImageArray) -> ImageArray:
    """The image at the size that `describe` brings it to."""
    check_image(image_bgr)
    height, width = image_bgr.shape[:2]
    return _resize(image_bgr, *_covered_size(width, height))


def _covered_size(width: int, height: int) -> tuple[int, int]:
    scale = min(1.0, LONGEST_SIDE / max(width, height))

    def covered(side: int) -> int:
        return max(1, int(side * scale / GRID + 0.5)) * GRID

    return covered(width), covered(height)


def _resize(image: ImageArray, width: int, height: int) -> ImageArray:
    """Shrink by area, then enlarge linearly (the bit-exact kind: the same bytes on every machine)."""
    shrunk = (min(width, image.shape[1]), min(height, image.shape[0]))
    for size, method in ((shrunk, cv2.INTER_AREA), ((width, height), cv2.INTER_LINEAR_EXACT)):
        if (image.shape[1], image.shape[0]) != size:
            image = cv2.resize(image, size, interpolation=method).astype(np.uint8, copy=False)
    return image


_Grid = tuple[int, int, int, int]


def _grid(height: int, width: int) -> _Grid:
    """Rows and columns of blocks, then rows and columns of pixels in a quarter of a block."""
    shortest = min(height, width)
    if shortest < 40:
        return height // 2, width // 2, 1, 1
    blocks = 40 if shortest >= 80 else 20
    return blocks, blocks, height // blocks // 2, width // blocks // 2


def _quarter_sums(image: ImageArray, grid: _Grid) -> FloatArray:
    """Sums of B, G, R and luminance in thousandths over the quarters of the blocks, exact whole numbers.

    Of shape (4, 2 * rows, 2 * columns).
    """
    rows, columns, height, width = grid
    strips = image[: 2 * rows * height, : 2 * columns * width].reshape(2 * rows, height, -1)
    if height > 1:
        # 257 * 255 still fits 16 bits
        strips = np.add.reduce(strips, axis=1, dtype=np.uint16 if height <= 257 else np.uint32)
    pixels = strips.reshape(-1, 3 * width).astype(np.float64)
    sums: FloatArray = np.ascontiguousarray((pixels @ np.tile(_CHANNELS, (width, 1))).T)
    return sums.reshape(4, 2 * rows, 2 * columns)


def _areas(image: ImageArray, quarter_sums: FloatArray, grid: _Grid) -> FloatArray:
    """Luminance of the quarters (a top left, b top right, c, d) of the blocks, (4, blocks), whole numbers 0..255.

    The reference sums ``0.114 B + 0.587 G + 0.299 R`` pixel by pixel in double and truncates the mean. Exact arithmetic
    gives the same, except where the true mean is a whole number: there the rounding errors decide and are repeated.
    """
    rows, columns, height, width = grid
    count = height * width
    mean = quarter_sums[3].ravel() / (1000.0 * count)
    area = np.floor(mean)
    area[mean == 255] = np.trunc(255.0 * count * (4.0 / (4 * count)))  # white adds up without rounding; 254 at times
    undecided = np.flatnonzero((mean == area) & (mean > 0) & (mean < 255))
    if len(undecided):
        i, j = np.divmod(undecided, 2 * columns)
        pixels, stride = image.reshape(-1, 3), image.shape[1]
        total = np.zeros(len(undecided))
        for offset in (y * stride + x for y in range(height) for x in range(width)):
            blue, green, red = pixels.take(i * height * stride + j * width + offset, axis=0).T
            total += (0.114 * blue + 0.587 * green) + 0.299 * red
        area[undecided] = np.trunc(total * (4.0 / (4 * count)))
    by_quarter: FloatArray = area.reshape(rows, 2, columns, 2).transpose(1, 3, 0, 2).reshape(4, -1)
    return by_quarter


def _texture_votes(areas: FloatArray) -> tuple[IndexArray, IndexArray]:
    """Texture class and block of every vote, blocks ascending in each class; a block may be of several classes."""
    scaled = areas * _SQRT2
    magnitudes = np.concatenate([_FILTERS @ areas, scaled[:2] - scaled[:1:-1]])  # the diagonals: a - d, b - c
    np.abs(magnitudes, out=magnitudes)
    strongest = magnitudes.max(axis=0)
    is_edge = strongest >= _EDGE_THRESHOLD
    votes = np.empty((6, areas.shape[1]), np.bool_)
    np.logical_not(is_edge, out=votes[0])
    np.greater(magnitudes / np.maximum(strongest, _EDGE_THRESHOLD), _CLASS_THRESHOLDS, out=votes[1:])
    votes[1:] &= is_edge
    textures, blocks = np.divmod(np.flatnonzero(votes), areas.shape[1])
    return textures, blocks


def _block_colours(quarter_sums: FloatArray, grid: _Grid) -> FloatArray:
    """Mean B, G, R of the blocks, cut to whole numbers, (3, blocks)."""
    *_, height, width = grid
    halves = quarter_sums[:3, ::2] + quarter_sums[:3, 1::2]
    sums = halves[:, :, ::2] + halves[:, :, 1::2]
    return np.floor(sums / (4 * height * width)).reshape(3, -1)


def _hsv(blue: FloatArray, green: FloatArray, red: FloatArray) -> tuple[IndexArray, ...]:
    """Hue 0..358, saturation 0..255 and value 0..255 of whole-number colours."""
    value = np.maximum(np.maximum(red, green), blue)
    spread = value - np.minimum(np.minimum(red, green), blue)
    saturation = 255 * spread / np.maximum(value, 1)
    is_red, is_green = red == value, green == value
    difference = np.where(is_red, green - blue, np.where(is_green, blue - red, red - green))
    # 359, 119, 239 and not 360, 120, 240: the fuzzy sets are tuned to these
    offset = np.where(is_red, 359.0 * (difference < 0), np.where(is_green, 119.0, 239.0))
    hue = offset + 60 * difference / np.maximum(spread, 1)
    return hue.astype(np.intp), saturation.astype(np.intp), value.astype(np.intp)


def _colour_outputs(blue: FloatArray, green: FloatArray, red: FloatArray) -> tuple[IndexArray, FloatArray]:
    """Votes of the two fuzzy systems: the bins 0..23 each block votes for and the weights, (blocks, 9) each.

    At most two hue classes are active, so nine of the 24 outputs can differ from 0: white, grey, black, and the light,
    pure and dark shade of two colours.
    """
    hue, saturation, value = _hsv(blue, green, red)

    # rules of the first system: saturation (2), value (3); then with the hue class (2)
    rules = np.minimum(SATURATION.take(saturation, axis=1)[:, None], VALUE.take(value, axis=1))
    active = np.minimum(HUE_WEIGHT.take(hue, axis=1)[:, None, None], rules)
    black = ((active[0, 0, 0] + active[0, 1, 0]) + active[1, 0, 0]) + active[1, 1, 0]
    grey, white = active[0, 0, 1:] + active[1, 0, 1:]
    coloured = active[:, 1, 1] + active[:, 1, 2]

    # the second system: saturation (2), value (2), each low and high
    shade = np.minimum(LOW_HIGH.take(saturation, axis=1)[:, None], LOW_HIGH.take(value, axis=1))
    shades = np.stack([shade[0, 1], shade[1, 1], shade[0, 0] + shade[1, 0]])

    outputs = np.concatenate([[white, grey, black], *(coloured[:, None] * shades)])
    return HUE_BINS.take(hue, axis=0), np.ascontiguousarray(outputs.T)
