"""CEDD, the Color and Edge Directivity Descriptor, equal to the reference implementation of LIRE at all 144 levels.

Source: Chatzichristofis and Boutalis, "CEDD: Color and Edge Directivity Descriptor. A Compact Descriptor for Image
Indexing and Retrieval", ICVS 2008, with the numbers of LIRE's ``features.global.CEDD``, which defines what the paper
does not.

Vectors over the blocks have the shape ``(k, blocks)``, so that every operation reads contiguous memory. 144 levels of 3
bits are packed into 54 bytes, bin 0 first, most significant bit first.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final, NamedTuple

import cv2
import numpy as np

from hbr.core.arrays import BoolArray, FloatArray, ImageArray, IndexArray, LevelArray, RealArray, check_image
from hbr.descriptors.base import Comparison, Descriptor
from hbr.descriptors.similarity import MANY, tanimoto, tanimoto_of_dots
from hbr.kernels import calls, library
from hbr.segmentation import Segmentation

Trapezoid = tuple[float, float, float, float]


def _membership(x: FloatArray, trapezoid: Trapezoid) -> FloatArray:
    """Return the fuzzy membership of values: 1 on [b, c], linear on [a, b) and (c, d], 0 elsewhere."""
    a, b, c, d = trapezoid
    with np.errstate(divide="ignore", invalid="ignore"):  # vertical edges (a = b, c = d) are never selected
        rising, falling = (x - a) / (b - a), (x - c) / (c - d) + 1
    return np.select([(b <= x) & (x <= c), (a <= x) & (x < b), (c < x) & (x <= d)], [np.ones_like(x), rising, falling])


_HUES: Final[tuple[Trapezoid, ...]] = (
    (0, 0, 5, 10),  # red
    (5, 10, 35, 50),  # orange
    (35, 50, 70, 85),  # yellow
    (70, 85, 150, 165),  # green
    (150, 165, 195, 205),  # cyan
    (195, 205, 265, 280),  # blue
    (265, 280, 315, 330),  # magenta
    (315, 330, 360, 360),  # red again
)
_LEVELS: Final = np.arange(256, dtype=np.float64)

_S0, _S1 = (_membership(_LEVELS, t) for t in ((0, 0, 10, 75), (10, 75, 255, 255)))
_V0, _V1, _V2 = (_membership(_LEVELS, t) for t in ((0, 0, 10, 75), (10, 75, 180, 220), (180, 220, 255, 255)))
_LOW, _HIGH = (_membership(_LEVELS, t) for t in ((0, 0, 68, 188), (68, 188, 255, 255)))

#: (256, 10) each: memberships of every saturation and of every value in the ten rules. Six rules belong to the first
#: fuzzy system (white, grey, black, black, colour, colour), four to the second (light, pure, dark, dark).
SATURATION: Final = np.stack([_S0, _S0, _S0, _S1, _S1, _S1, _LOW, _HIGH, _LOW, _HIGH], axis=1)
VALUE: Final = np.stack([_V2, _V1, _V0, _V0, _V1, _V2, _HIGH, _HIGH, _LOW, _LOW], axis=1)


def _hue_tables() -> tuple[FloatArray, IndexArray]:
    hues = np.arange(360)
    memberships = np.stack([_membership(hues.astype(np.float64), t) for t in _HUES])
    first = (memberships > 0).argmax(axis=0)
    second = np.minimum(first + 1, len(_HUES) - 1)
    weights = np.stack([memberships[first, hues], np.where(second > first, memberships[second, hues], 0.0)])
    shades = 3 + 3 * (np.stack([first, second], axis=1) % 7)[:, :, None] + np.arange(3)  # class 7 is red, like class 0
    neutrals = np.broadcast_to(np.arange(3), (hues.size, 3))
    bins = np.concatenate([neutrals, shades.reshape(-1, 6)], axis=1)
    return weights, np.concatenate([24 * texture + bins for texture in range(6)])


#: (2, 360): memberships of the two neighbouring hue classes that can be active at each hue.
#: (6 * 360, 9): bins of white, grey, black and of the light, pure and dark shade of these two classes' colours, in row
#: 360 * texture + hue.
HUE_WEIGHT, VOTE_BINS = _hue_tables()

_REPRESENTATIVES: Final = (
    # class 0 (no edge); class 1 (non-directional); classes 2, 3 (horizontal, vertical); classes 4, 5 (diagonals)
    (
        180.19686541079636, 23730.024499150866, 61457.152912541605, 113918.55437576842,
        179122.46400035513, 260980.3325940354, 341795.93301552488, 554729.98648386425,
    ),
    (
        209.25176965926232, 22490.5872862417345, 60250.8935141849988, 120705.788057580583,
        181128.08709063051, 234132.081356900555, 325660.617733105708, 520702.175858657472,
    ),
    (
        405.4642173212585, 4877.9763319071481, 10882.170090625908, 18167.239081219657,
        27043.385568785292, 38129.413201299016, 52675.221316293857, 79555.402607004813,
    ),
    (
        968.88475977695578, 10725.159033657819, 24161.205360376698, 41555.917344385321,
        62895.628446402261, 93066.271379694881, 136976.13317822068, 262897.86056221306,
    ),
)  # fmt: skip

#: (144, 8): histogram share that each level represents; one row for each bin.
REPRESENTATIVES: Final = (np.array(_REPRESENTATIVES) / 1_000_000)[[0, 1, 2, 2, 3, 3]].repeat(24, axis=0)


#: Bins of the descriptor: 6 texture classes of 24 colours, bin = 24 * texture + colour.
BINS: Final = 144
#: The block grid covers an image completely if both sides are multiples of this number of pixels.
GRID: Final = 80
#: Longest side to which `describe` scales an image.
LONGEST_SIDE: Final = 640

# The thresholds of the reference implementation. With any other value, the result is not CEDD.
_EDGE_THRESHOLD: Final = 14.0
_CLASS_THRESHOLDS: Final = np.array([[0.68], [0.98], [0.98], [0.98], [0.98]])
#: Weights of B, G, R in the luminance of a pixel, in thousandths.
_LUMINANCE: Final = np.array([114, 587, 299])
#: Luminance of a grey pixel, rounded like the reference.
_GREYS: Final = (0.114 * np.arange(256) + 0.587 * np.arange(256)) + 0.299 * np.arange(256)
_SQRT2: Final = np.sqrt(2.0)
#: Weights of the quarters a, b, c, d for a non-directional, a horizontal and a vertical edge.
_FILTERS: Final = np.array([[2.0, -2.0, -2.0, 2.0], [1.0, 1.0, -1.0, -1.0], [1.0, -1.0, 1.0, -1.0]])
#: For the kernel: the rules padded to the width of vectors, and the first bins of the two colours of each hue.
_TABLES: Final = calls.Addresses(
    HUE_WEIGHT,
    np.ascontiguousarray(VOTE_BINS[:360, 3::3].T, np.int64),
    np.pad(SATURATION, ((0, 0), (0, 2))),
    np.pad(VALUE, ((0, 0), (0, 2))),
    REPRESENTATIVES,
)


def cedd(image_bgr: ImageArray) -> LevelArray:
    """Return the CEDD levels of an image, exactly like the reference.

    The reference divides the top left part of the image into equal blocks and ignores the rest on the right and at the
    bottom (61 % of a 128 x 128 image). `describe` uses the whole image.

    Parameters
    ----------
    image_bgr : uint8 array (H, W, 3)
        Any size, in OpenCV's channel order. Slices and flipped views are possible.

    Returns
    -------
    uint8 array (144,)
        Levels 0..7, bin = 24 * texture + colour. All are zero if a side is shorter than 2 pixels.

    Raises
    ------
    TypeError, ValueError
        The image is not a uint8 array of shape (H, W, 3).
    """
    check_image(image_bgr)
    grid = _grid(*image_bgr.shape[:2])
    if 0 in grid[:2]:
        return np.zeros(BINS, np.uint8)
    compiled = calls.cedd(image_bgr, grid, _TABLES)
    if compiled is not None:
        return compiled
    image = np.ascontiguousarray(image_bgr)
    row_sums = _row_sums(image, grid)
    textures, blocks = _texture_votes(_areas(image, _luminance(row_sums, grid), grid))
    hue, outputs = _colour_outputs(_block_colours(row_sums, grid))
    # bincount adds in raster order in every bin, so that the sums equal those of the reference to the last bit
    histogram = np.bincount(
        VOTE_BINS.take(360 * textures + hue.take(blocks), axis=0).ravel(),
        weights=outputs.take(blocks, axis=0).ravel(),
        minlength=BINS,
    )
    shares = histogram / histogram.cumsum()[-1]
    levels: IndexArray = np.abs(shares[:, None] - REPRESENTATIVES).argmin(axis=1)
    return levels.astype(np.uint8)


def describe(image_bgr: ImageArray) -> LevelArray:
    """Return the CEDD levels of the whole image, scaled to a size that the block grid covers.

    An image with a side above 640 pixels is scaled down to that side; then each side becomes the nearest multiple of 80
    (half-way up), at least 80: 640 x 480 stays, 128 x 128 becomes 160 x 160, 1920 x 1080 becomes 640 x 400. Compare
    only views of frames of the same size.

    Parameters
    ----------
    image_bgr : uint8 array (H, W, 3)
        As for `cedd`; no side may be 0.

    Returns
    -------
    uint8 array (144,)
        Levels 0..7.

    Raises
    ------
    TypeError, ValueError
        As for `cedd`, or a side is 0.
    """
    return cedd(covered(image_bgr))


def covered(image_bgr: ImageArray) -> ImageArray:
    """Return the image at the size to which `describe` scales it."""
    check_image(image_bgr)
    height, width = image_bgr.shape[:2]
    return _resize(image_bgr, *_covered_size(width, height))


def _covered_size(width: int, height: int) -> tuple[int, int]:
    scale = min(1.0, LONGEST_SIDE / max(width, height))

    def covered(side: int) -> int:
        return max(1, int(side * scale / GRID + 0.5)) * GRID

    return covered(width), covered(height)


def _resize(image: ImageArray, width: int, height: int) -> ImageArray:
    """Return an image shrunk by area, then enlarged linearly (bit-exact: the same bytes on every machine)."""
    shrunk = (min(width, image.shape[1]), min(height, image.shape[0]))
    for size, method in ((shrunk, cv2.INTER_AREA), ((width, height), cv2.INTER_LINEAR_EXACT)):
        if (image.shape[1], image.shape[0]) != size:
            image = cv2.resize(image, size, interpolation=method).astype(np.uint8, copy=False)
    return image


class _Grid(NamedTuple):
    """Numbers of rows and columns of blocks, height and width of a quarter of a block in pixels."""

    rows: int
    columns: int
    height: int
    width: int


def _grid(height: int, width: int) -> _Grid:
    shortest = min(height, width)
    if shortest < 40:
        return _Grid(height // 2, width // 2, 1, 1)
    blocks = 40 if shortest >= 80 else 20
    return _Grid(blocks, blocks, height // blocks // 2, width // blocks // 2)


def _strips(image: ImageArray, grid: _Grid) -> ImageArray:
    """Return the rows of pixels of every row of quarters, (2 * rows, height of a quarter, 3 * pixels)."""
    rows, columns, height, width = grid
    return image[: 2 * rows * height, : 2 * columns * width].reshape(2 * rows, height, -1)


def _row_sums(image: ImageArray, grid: _Grid) -> RealArray:
    """Return the sums of the rows of pixels of every row of quarters: integers, (2 * rows, 3 * pixels)."""
    strips = _strips(image, grid)
    sums = np.zeros((2 * grid.rows, strips.shape[2]), _weights(grid)[0].dtype)
    for k in range(grid.height):
        cv2.accumulate(strips[:, k], sums)
    return sums


@lru_cache(maxsize=64)
def _weights(grid: _Grid) -> tuple[RealArray, RealArray]:
    """Return matrices from a row of pixels of a quarter to luminance, and from one of a block to B, G, R."""
    # float32 represents integers up to 2 ** 24
    dtype = np.float32 if 255_000 * grid.height * grid.width < 2**24 else np.float64
    return np.tile(_LUMINANCE, grid.width).astype(dtype), np.tile(np.eye(3), (2 * grid.width, 1)).astype(dtype)


def _luminance(row_sums: RealArray, grid: _Grid) -> RealArray:
    """Return the luminance of the quarters in thousandths, summed over their pixels, (2 * rows, 2 * columns)."""
    luminance: RealArray = row_sums.reshape(-1, 3 * grid.width) @ _weights(grid)[0]
    return luminance.reshape(2 * grid.rows, 2 * grid.columns)


def _block_colours(row_sums: RealArray, grid: _Grid) -> RealArray:
    """Return the mean B, G, R of the blocks, truncated to integers, (blocks, 3), float32."""
    sums = cv2.add(row_sums[::2], row_sums[1::2]).reshape(-1, 6 * grid.width) @ _weights(grid)[1]
    return np.floor(sums / (4 * grid.height * grid.width)).astype(np.float32, copy=False)


def _areas(image: ImageArray, luminance: RealArray, grid: _Grid) -> FloatArray:
    """Return the luminance of the quarters (a top left, b top right, c, d) of the blocks, (4, blocks), 0..255.

    The reference sums ``0.114 B + 0.587 G + 0.299 R`` pixel by pixel in double and truncates the mean. Exact arithmetic
    gives the same result, except if the true mean is an integer. Then the rounding errors decide, and are reproduced.
    """
    rows, columns, height, width = grid
    count = height * width
    mean = luminance / (1000 * count)
    area = np.floor(mean)
    white = np.trunc(255.0 * count * (4.0 / (4 * count)))
    if white < 255:  # the sum of white is exact, but the reciprocal of the number of pixels may be rounded down
        area[mean == 255] = white
    undecided = np.flatnonzero((mean == area) & (mean > 0) & (mean < 255))
    if len(undecided):
        area.put(undecided, _areas_as_rounded(image, luminance, undecided, grid))
    by_quarter = area.astype(np.float64).reshape(rows, 2, columns, 2).transpose(1, 3, 0, 2)
    return by_quarter.reshape(4, -1)


def _areas_as_rounded(image: ImageArray, luminance: RealArray, quarters: IndexArray, grid: _Grid) -> FloatArray:
    """Return the luminance of some quarters in raster order, with the rounding errors of the reference."""
    # in drawings and other flat images, most quarters equal the one on their left, which is then in the list too
    repeats = _repeats(image, luminance, grid).take(quarters)
    strips = _strips(image, grid).view(f"V{3 * grid.width}")
    i, j = np.divmod(quarters[~repeats], luminance.shape[1])
    count = grid.height * grid.width
    step = max(1, 50_000 // count)  # fits into the cache
    totals = []
    for some in (slice(k, k + step) for k in range(0, len(i), step)):
        pixels = strips[i[some], :, j[some]].view(np.uint8).reshape(-1, count, 3)
        blue, green, red = (cv2.transpose(channel) for channel in cv2.split(pixels))
        if (blue == green).all() and (green == red).all():
            each = cv2.LUT(blue, _GREYS)
        else:
            each = (0.114 * blue + 0.587 * green) + 0.299 * red
        total = np.zeros(len(pixels))
        for pixel in each:
            total += pixel
        totals.append(total)
    areas: FloatArray = np.trunc(np.concatenate(totals) * (4.0 / (4 * count))).take(np.cumsum(~repeats) - 1)
    return areas


def _repeats(image: ImageArray, luminance: RealArray, grid: _Grid) -> BoolArray:
    """Return which quarters equal the one on their left in every pixel, (4 * blocks,).

    The comparison is skipped if there cannot be many.
    """
    repeats = np.zeros(luminance.shape, np.bool_)
    np.equal(luminance[:, 1:], luminance[:, :-1], out=repeats[:, 1:])
    if 8 * np.count_nonzero(repeats) < repeats.size:
        return np.zeros(repeats.size, np.bool_)
    difference = np.empty_like(image)
    cv2.absdiff(image[:, grid.width :], image[:, : -grid.width], difference[:, grid.width :])
    repeats &= _luminance(_row_sums(difference, grid), grid) == 0
    return repeats.ravel()


def _texture_votes(areas: FloatArray) -> tuple[IndexArray, IndexArray]:
    """Return texture class and block of every vote, blocks ascending in each class. A block may have several."""
    scaled = areas * _SQRT2
    magnitudes = np.empty((5, areas.shape[1]))
    np.matmul(_FILTERS, areas, out=magnitudes[:3])
    np.subtract(scaled[:2], scaled[:1:-1], out=magnitudes[3:])  # the diagonals: a - d, b - c
    np.abs(magnitudes, out=magnitudes)
    strongest = magnitudes.max(axis=0)
    is_edge = strongest >= _EDGE_THRESHOLD
    magnitudes /= np.maximum(strongest, _EDGE_THRESHOLD)
    votes = np.empty((6, areas.shape[1]), np.bool_)
    np.logical_not(is_edge, out=votes[0])
    np.greater(magnitudes, _CLASS_THRESHOLDS, out=votes[1:])
    votes[1:] &= is_edge
    textures, blocks = np.divmod(np.flatnonzero(votes), areas.shape[1])
    return textures, blocks


def _hsv(colours: RealArray) -> IndexArray:
    """Return hue 0..358, saturation 0..255 and value 0..255, (3, blocks), of integers B, G, R, (blocks, 3) float32.

    The truncated fractions have denominators of at most 255. OpenCV's single precision can leave an integer slightly
    too small; adding 0.001 before truncation corrects that and changes no other value.
    """
    hsv = cv2.cvtColor(colours.reshape(1, -1, 3), cv2.COLOR_BGR2HSV)[0]
    hsv[:, 1] *= 255
    whole: IndexArray = (hsv + 0.001).T.astype(np.intp)
    # green, blue and the end of red start at 119, 239 and 359, not at 120, 240 and 360: the fuzzy sets expect it
    whole[0] -= hsv[:, 0] > 60.001
    return whole


def _colour_outputs(colours: RealArray) -> tuple[IndexArray, FloatArray]:
    """Return the hue of integer colours B, G, R, (blocks, 3), and the votes of the two fuzzy systems, (blocks, 9).

    At most two hue classes are active, so that only nine of the 24 outputs can differ from 0: white, grey, black, and
    the light, pure and dark shade of two colours. `VOTE_BINS` has their bins.
    """
    hue, saturation, value = _hsv(colours)
    rules = cv2.transpose(np.minimum(SATURATION.take(saturation, axis=0), VALUE.take(value, axis=0)))
    first, second = np.minimum(HUE_WEIGHT.take(hue, axis=1)[:, None], rules[:6])
    outputs = np.empty((9, len(hue)))
    np.add(first[:3], second[:3], out=outputs[:3])
    outputs[2] = ((first[2] + first[3]) + second[2]) + second[3]  # black
    shades = rules[6:9]
    shades[2] += rules[9]
    np.multiply(first[4] + first[5], shades, out=outputs[3:6])
    np.multiply(second[4] + second[5], shades, out=outputs[6:])
    return hue, cv2.transpose(outputs).astype(np.float64, copy=False)


BITS: Final = 3  # CEDD quantises each bin to 8 levels
PACKED_BYTES: Final = BINS * BITS // 8


def pack(levels: LevelArray) -> bytes:
    """Pack one descriptor into 54 bytes.

    Parameters
    ----------
    levels : integer array (144,)
        Levels 0..7.

    Returns
    -------
    bytes
        54 bytes. Several packed descriptors, joined, are a table of 54-byte rows.

    Raises
    ------
    TypeError, ValueError
        The levels are not integers, not of shape (144,), or outside 0..7.
    """
    levels = np.asarray(levels)
    if not np.issubdtype(levels.dtype, np.integer):
        raise TypeError(f"the levels are of {levels.dtype}; pass the integer levels that cedd or describe returns")
    if levels.shape != (BINS,):
        raise ValueError(f"the levels have shape {levels.shape}, not ({BINS},); pack one descriptor at a time")
    if levels.min() < 0 or levels.max() > 7:
        raise ValueError(
            f"the levels span {levels.min()}..{levels.max()}, not 0..7; pass a descriptor, not a histogram"
        )
    return _CEDD.pack(levels.astype(np.uint8))


def unpack(packed: bytes) -> LevelArray:
    """Return the levels of one packed descriptor, uint8 (144,); the inverse of `pack`.

    Raises
    ------
    ValueError
        There are not exactly 54 bytes.
    """
    return _CEDD.unpack(packed)


def unpack_rows(packed: bytes) -> LevelArray:
    """Return the levels of many packed descriptors, joined, uint8 (n, 144).

    Raises
    ------
    ValueError
        The number of bytes is not a multiple of 54.
    """
    return _CEDD.unpack_rows(packed)


#: Blocks of CEDD's grid along each side of an image.
_BLOCKS: Final = 40


@dataclass(frozen=True)
class Cedd(Descriptor):
    """CEDD of the whole image, compared by Tanimoto."""

    name: str = "cedd"
    version: int = 1
    size_bytes: int = PACKED_BYTES
    length: int = BINS
    max_level: int = 7
    whole_image: bool = True
    is_plain_cedd: bool = True
    blur: float = 0.0
    """Standard deviation of a Gaussian blur, in blocks of the grid; 0 is the paper's CEDD. Noise looks like an edge in
    blocks that are as small as its grain. A blur of about one block removes the noise and leaves the edges."""

    def describe(self, view: ImageArray | Segmentation, /) -> LevelArray:
        image = view.alone if isinstance(view, Segmentation) else view
        if not self.blur:
            return describe(image)
        image = covered(image)
        sigma = [self.blur * side / _BLOCKS for side in image.shape[:2]]
        blurred = cv2.GaussianBlur(image, (0, 0), sigma[1], sigmaY=sigma[0], borderType=cv2.BORDER_REPLICATE)
        return cedd(blurred.astype(np.uint8, copy=False))

    def prepared(self, rows: LevelArray, /) -> Comparison:
        self.check_rows(rows)
        return _Tanimoto(rows)

    def similarity(self, a: LevelArray, b: LevelArray) -> FloatArray:
        return tanimoto(a, b)

    def similarity_of_means(self, means: FloatArray) -> FloatArray:
        return tanimoto(means, means)

    def pack_rows(self, rows: LevelArray) -> LevelArray:
        self.check_levels(rows)
        bits = np.unpackbits(rows.reshape(len(rows), BINS, 1), axis=2)[:, :, -BITS:]
        return np.packbits(bits.reshape(len(rows), BITS * BINS), axis=1)

    def unpack_rows(self, packed: bytes) -> LevelArray:
        first, second, third = self.packed_rows(packed).reshape(-1, BINS // 8, BITS).T  # 3 bytes are 8 levels
        bits = first.T.astype(np.uint32) << 16 | second.T.astype(np.uint32) << 8 | third.T
        levels = np.empty((*bits.shape, 8), np.uint8)
        for place in range(8):
            levels[..., place] = bits >> (21 - BITS * place) & 7
        return levels.reshape(-1, BINS)


_CEDD: Final = Cedd()
#: Rotated by 45° counter-clockwise, a horizontal edge is one of 45°, then vertical, then of 135°.
_NEXT_DIRECTION: Final = {2: 4, 4: 3, 3: 5, 5: 2}


def _rotation_tables() -> tuple[IndexArray, ...]:
    """Return the bins that the bins get their levels from in rotations of the image by 0°, 45°, 90° and 135°."""
    once = np.arange(BINS).reshape(6, 24)
    once[list(_NEXT_DIRECTION.values())] = once[list(_NEXT_DIRECTION)]
    found = [np.arange(BINS)]
    for _ in range(3):
        found.append(once.ravel()[found[-1]])
    return tuple(found)


_ROTATIONS: Final = _rotation_tables()


@dataclass(frozen=True)
class RotatedCedd(Cedd):
    """CEDD with a similarity for objects that are rotated in the image plane: the largest over rotations by 45°.

    The four classes of directed edges change places. Colours, no edge and non-directional edges stay.
    """

    name: str = "cedd-rotated"
    is_plain_cedd: bool = False

    def prepared(self, rows: LevelArray, /) -> Comparison:
        self.check_rows(rows)
        return _Rotated(_Tanimoto(rows))

    def similarity(self, a: LevelArray, b: LevelArray) -> FloatArray:
        return _largest([tanimoto(a[..., places], b) for places in _ROTATIONS])

    def similarity_of_means(self, means: FloatArray) -> FloatArray:
        return _largest([tanimoto(means[:, places], means) for places in _ROTATIONS])


def _largest(similar: list[FloatArray]) -> FloatArray:
    largest: FloatArray = np.maximum.reduce(similar)
    return largest


class _Tanimoto:
    def __init__(self, rows: LevelArray) -> None:
        self._rows = rows
        self._compiled = None if library() is None else calls.ByteRows(rows)

    def similarity(self, queries: LevelArray, /) -> FloatArray:
        if self._compiled is None or len(queries) >= MANY:
            return tanimoto(queries, self._rows)
        _CEDD.check_rows(queries)
        return self._compiled.similarity(queries)

    def among(self, rows: IndexArray, /) -> FloatArray:
        return self.rotated_among(rows, (np.arange(BINS),))

    def rotated_among(self, rows: IndexArray, rotations: Sequence[IndexArray]) -> FloatArray:
        """Return the largest similarity of rows within groups, over rotations of the first row, (g, k, k)."""
        part = self._rows[rows].astype(np.float32)  # represents products of levels 0..7 exactly
        columns, lengths = part.transpose(0, 2, 1), np.einsum("gij,gij->gi", part, part).astype(np.float64)
        dots = np.maximum.reduce([part[:, :, places] @ columns for places in rotations]).astype(np.float64)
        return tanimoto_of_dots(dots, lengths[:, :, None], lengths[:, None, :])


class _Rotated:
    def __init__(self, plain: _Tanimoto) -> None:
        self._plain = plain

    def similarity(self, queries: LevelArray, /) -> FloatArray:
        return _largest([self._plain.similarity(queries[:, places]) for places in _ROTATIONS])

    def among(self, rows: IndexArray, /) -> FloatArray:
        return self._plain.rotated_among(rows, _ROTATIONS)
