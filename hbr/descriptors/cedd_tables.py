"""Constants of CEDD: fuzzy memberships as look-up tables, and the quantiser.

Source: Chatzichristofis and Boutalis, "CEDD: Color and Edge Directivity Descriptor", ICVS 2008, with the numbers
of the LIRE reference (``features.global.CEDD``), which defines what the paper does not.
"""

from typing import Final

import numpy as np

from hbr.core.arrays import FloatArray, IndexArray

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
