"""CEDD, the Color and Edge Directivity Descriptor, equal to the LIRE reference at all 144 levels.

Source: Chatzichristofis and Boutalis, "CEDD: Color and Edge Directivity Descriptor. A Compact Descriptor for Image
Indexing and Retrieval", ICVS 2008, in the reading of LIRE's ``features.global.CEDD``.

Vectors over the blocks are laid out component first, ``(k, blocks)``, so that every operation runs along memory.
"""

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from hbr._cedd_tables import (
    HUE_COLOUR,
    HUE_WEIGHT,
    LOW_HIGH,
    REPRESENTATIVES,
    SATURATION,
    VALUE,
    FloatArray,
)

ImageArray = NDArray[np.uint8]
LevelArray = NDArray[np.uint8]

#: Bins of the descriptor: 6 texture classes of 24 colours, bin = 24 * texture + colour.
BINS: Final = 144
#: The sides that the block grid covers completely are multiples of this many pixels.
GRID: Final = 80
#: `describe` brings no image to a longer side than this.
LONGEST_SIDE: Final = 640

_EDGE_THRESHOLD: Final = 14.0
_CLASS_THRESHOLDS: Final = np.array([[0.68], [0.98], [0.98], [0.98], [0.98]])
_LUMINANCE: Final = np.array([114.0, 587.0, 299.0])  # thousandths of B, G, R
_SQRT2: Final = np.sqrt(2.0)
_NO_EDGE: Final = 0
_HSV_OFFSET: Final = np.array([0.0, 119.0, 239.0])  # not 120 and 240: the fuzzy sets are tuned to these


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
    _check_image(image_bgr)
    grid = _grid(*image_bgr.shape[:2])
    if 0 in grid[:2]:
        return np.zeros(BINS, np.uint8)
    quarter_sums = _quarter_sums(image_bgr, grid)
    colours, outputs = _colour_outputs(quarter_sums, grid)
    blocks, textures = _texture_classes(image_bgr, quarter_sums, grid)
    # bincount adds in the order given: raster order in every bin, so the sums equal the reference's to the last bit
    bins = colours[:, blocks] + 24 * textures
    histogram = np.bincount(bins.T.ravel(), weights=outputs[:, blocks].T.ravel(), minlength=BINS)
    shares = histogram / histogram.cumsum()[-1]
    levels: NDArray[np.intp] = np.abs(shares[:, None] - REPRESENTATIVES).argmin(axis=1)
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
    _check_image(image_bgr)
    if size is not None and any(side <= 0 or side % GRID for side in size):
        raise ValueError(f"size is {size}; both sides must be positive multiples of {GRID}, e.g. (640, 480)")
    height, width = image_bgr.shape[:2]
    return cedd(_resize(image_bgr, *(size or _covered_size(width, height))))


def _check_image(image: object) -> None:
    if not isinstance(image, np.ndarray):
        raise TypeError(
            f"the image is a {type(image).__name__}, not an array; cv2.imread returns None if it cannot read the file"
        )
    if image.dtype != np.uint8:
        raise TypeError(f"the image is of {image.dtype}; scale it to 0..255 and convert it with .astype(np.uint8)")
    if image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 1):
        raise ValueError(f"the image is grey, shape {image.shape}; use cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)")
    if image.ndim == 3 and image.shape[2] == 4:
        raise ValueError(f"the image has alpha, shape {image.shape}; composite it, or use cv2.COLOR_BGRA2BGR")
    if image.ndim != 3 or image.shape[2] != 3:
        raise ValueError(f"the image has shape {image.shape}; one BGR image of shape (H, W, 3) is needed")
    if image.size == 0:
        raise ValueError(f"the image is empty, shape {image.shape}; check the capture or the crop")


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
    """Sums of B, G, R over each quarter of each block, (3, 2 * rows, 2 * columns); whole numbers, exact."""
    rows, columns, quarter_height, quarter_width = grid
    covered = image[: 2 * rows * quarter_height, : 2 * columns * quarter_width]
    if quarter_height > 1:
        strips = covered.reshape(2 * rows, quarter_height, -1)
        narrow = np.uint16 if quarter_height <= 257 else np.uint32  # 257 * 255 still fits 16 bits
        covered = np.add.reduce(strips, axis=1, dtype=narrow)
    pixels = covered.reshape(-1, 3 * quarter_width).astype(np.float64)
    channel_of = np.tile(np.eye(3), (1, quarter_width))
    return (channel_of @ pixels.T).reshape(3, 2 * rows, 2 * columns)


def _areas(image: ImageArray, quarter_sums: FloatArray, grid: _Grid) -> FloatArray:
    """Luminance of each quarter, (2 * rows, 2 * columns), whole numbers 0..255 cut as the reference cuts them.

    The reference sums ``0.114 B + 0.587 G + 0.299 R`` pixel by pixel in double and truncates. Exact arithmetic gives
    the same, except where the true mean is a whole number: there the rounding errors decide, and have to be repeated.
    """
    rows, columns, height, width = grid
    mean = np.tensordot(_LUMINANCE, quarter_sums, 1) / (1000.0 * height * width)
    area = np.floor(mean)
    undecided = np.nonzero((mean == area) & (area > 0))
    if undecided[0].size:
        covered = image[: 2 * rows * height, : 2 * columns * width]
        pixels = covered.reshape(2 * rows, height, 2 * columns, width, 3)[undecided[0], :, undecided[1]]
        blue, green, red = np.moveaxis(pixels, -1, 0).reshape(3, len(pixels), -1).astype(np.float64)
        luminance = (0.114 * blue + 0.587 * green) + 0.299 * red
        total = luminance.cumsum(axis=1)[:, -1]  # cumsum adds in order, sum would add in pairs
        area[undecided] = np.trunc(total * (4.0 / (4 * height * width)))
    return area


def _texture_classes(
    image: ImageArray, quarter_sums: FloatArray, grid: _Grid
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Block and texture class of every vote, blocks in raster order; a block may be of several classes."""
    area = _areas(image, quarter_sums, grid)
    a, b, c, d = (area[i::2, j::2].ravel() for i in (0, 1) for j in (0, 1))
    magnitudes = np.abs(
        [
            2 * a - 2 * b - 2 * c + 2 * d,
            a + b - c - d,
            a - b + c - d,
            a * _SQRT2 - d * _SQRT2,
            b * _SQRT2 - c * _SQRT2,
        ]
    )
    strongest = magnitudes.max(axis=0)
    is_edge = strongest >= _EDGE_THRESHOLD
    votes = np.empty((6, strongest.size), np.bool_)
    votes[_NO_EDGE] = ~is_edge
    np.greater(magnitudes / np.maximum(strongest, _EDGE_THRESHOLD), _CLASS_THRESHOLDS, out=votes[1:])
    votes[1:] &= is_edge
    blocks, textures = np.nonzero(votes.T)
    return blocks, textures


def _hsv(blue: FloatArray, green: FloatArray, red: FloatArray) -> NDArray[np.intp]:
    """Hue 0..358, saturation 0..255, value 0..255 of whole-number colours, (3, blocks)."""
    rgb = np.stack([red, green, blue])
    value = rgb.max(axis=0)
    spread = value - rgb.min(axis=0)
    saturation = 255 * spread / np.maximum(value, 1)
    case = rgb.argmax(axis=0)  # the first of equals, as in the reference: red, green, blue
    difference = np.choose(case, [green - blue, blue - red, red - green])
    hue = np.where(difference < 0, np.choose(case, [359.0, 119.0, 239.0]), _HSV_OFFSET[case])
    hue += 60 * difference / np.maximum(spread, 1)
    return np.stack([hue, saturation, value]).astype(np.intp)


def _colour_outputs(quarter_sums: FloatArray, grid: _Grid) -> tuple[NDArray[np.intp], FloatArray]:
    """Outputs of the two fuzzy systems: colours 0..23 and their votes, (9, blocks) each.

    At most two hue classes are active, so nine of the 24 outputs can differ from 0: white, grey, black, and the light,
    pure and dark shade of two colours.
    """
    rows, columns, height, width = grid
    sums = quarter_sums.reshape(3, rows, 2, columns, 2).sum(axis=(2, 4)).reshape(3, -1)
    hue, saturation, value = _hsv(*np.floor(sums / (4 * height * width)))

    # rules of the first system: hue class (2), saturation (2), value (3)
    rules = np.minimum(SATURATION[:, None, saturation], VALUE[None, :, value])
    active = np.minimum(HUE_WEIGHT[:, None, None, hue], rules)
    black = ((active[0, 0, 0] + active[0, 1, 0]) + active[1, 0, 0]) + active[1, 1, 0]
    grey, white = active[0, 0, 1:] + active[1, 0, 1:]
    coloured = active[:, 1, 1] + active[:, 1, 2]

    # the second system: saturation (2), value (2)
    shade = np.minimum(LOW_HIGH[:, None, saturation], LOW_HIGH[None, :, value])
    shades = np.stack([shade[0, 1], shade[1, 1], shade[0, 0] + shade[1, 0]])

    outputs = np.concatenate([np.stack([white, grey, black]), (coloured[:, None] * shades).reshape(6, -1)])
    colours = np.empty(outputs.shape, np.intp)
    colours[:3] = np.arange(3)[:, None]
    colours[3:] = (3 + 3 * HUE_COLOUR[:, None, hue] + np.arange(3)[:, None]).reshape(6, -1)
    return colours, outputs
