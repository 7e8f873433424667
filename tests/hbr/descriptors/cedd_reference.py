"""CEDD computed pixel by pixel in plain floats, exactly as defined: slow, for comparison in tests."""

import math

import numpy as np
from numpy.typing import NDArray

HUES = [
    (0, 0, 5, 10),
    (5, 10, 35, 50),
    (35, 50, 70, 85),
    (70, 85, 150, 165),
    (150, 165, 195, 205),
    (195, 205, 265, 280),
    (265, 280, 315, 330),
    (315, 330, 360, 360),
]
S0, S1 = (0, 0, 10, 75), (10, 75, 255, 255)
V0, V1, V2 = (0, 0, 10, 75), (10, 75, 180, 220), (180, 220, 255, 255)
LOW, HIGH = (0, 0, 68, 188), (68, 188, 255, 255)
TABLES = [
    "180.19686541079636 23730.024499150866 61457.152912541605 113918.55437576842"
    " 179122.46400035513 260980.3325940354 341795.93301552488 554729.98648386425",
    "209.25176965926232 22490.5872862417345 60250.8935141849988 120705.788057580583"
    " 181128.08709063051 234132.081356900555 325660.617733105708 520702.175858657472",
    "405.4642173212585 4877.9763319071481 10882.170090625908 18167.239081219657"
    " 27043.385568785292 38129.413201299016 52675.221316293857 79555.402607004813",
    "968.88475977695578 10725.159033657819 24161.205360376698 41555.917344385321"
    " 62895.628446402261 93066.271379694881 136976.13317822068 262897.86056221306",
]
TABLE_OF_CLASS = [[float(x) / 1000000 for x in TABLES[t].split()] for t in (0, 1, 2, 2, 3, 3)]


def membership(x: int, shape: tuple[int, int, int, int]) -> float:
    a, b, c, d = shape
    if b <= x <= c:
        return 1.0
    if a <= x < b:
        return (x - a) / (b - a)
    if c < x <= d:
        return (x - c) / (c - d) + 1
    return 0.0


def hsv(r: int, g: int, b: int) -> tuple[int, int, int]:
    high, low = max(r, g, b), min(r, g, b)
    saturation = 0 if high == 0 else math.trunc(255 - 255 * (low / high))
    if high == low:
        hue = 0
    elif high == r and g >= b:
        hue = math.trunc(60 * (g - b) / (high - low))
    elif high == r:
        hue = math.trunc(359 + 60 * (g - b) / (high - low))
    elif high == g:
        hue = math.trunc(119 + 60 * (b - r) / (high - low))
    else:
        hue = math.trunc(239 + 60 * (r - g) / (high - low))
    return hue, saturation, high


def colours(r: int, g: int, b: int) -> list[float]:
    """Return the 24 outputs of the two fuzzy systems."""
    h, s, v = hsv(r, g, b)
    ten = [0.0] * 10
    for index, shape in enumerate(HUES):
        hue = membership(h, shape)
        colour = 3 + index % 7
        for s_shape, v_shape, output in (
            (S0, V0, 2),
            (S1, V0, 2),
            (S0, V2, 0),
            (S0, V1, 1),
            (S1, V1, colour),
            (S1, V2, colour),
        ):
            members = (hue, membership(s, s_shape), membership(v, v_shape))
            if min(members) > 0:
                ten[output] += min(members)
    shades = [0.0, 0.0, 0.0]
    if sum(ten[3:]) > 0:
        for s_shape, v_shape, shade in ((HIGH, HIGH, 1), (LOW, LOW, 2), (LOW, HIGH, 0), (HIGH, LOW, 2)):
            shades[shade] += min(membership(s, s_shape), membership(v, v_shape))
    return ten[:3] + [weight * shade for weight in ten[3:] for shade in shades]


def texture_classes(a: int, b: int, c: int, d: int) -> list[int]:
    root = math.sqrt(2)
    strengths = [
        abs(2 * a - 2 * b - 2 * c + 2 * d),
        abs(a + b - c - d),
        abs(a - b + c - d),
        abs(a * root - d * root),
        abs(b * root - c * root),
    ]
    strongest = max(strengths)
    if strongest < 14:
        return [0]
    limits = (0.68, 0.98, 0.98, 0.98, 0.98)
    return [k + 1 for k, (m, limit) in enumerate(zip(strengths, limits, strict=True)) if m / strongest > limit]


def grid(width: int, height: int) -> tuple[int, int, int, int]:
    shortest = min(width, height)
    if shortest >= 80:
        return 40, 40, width // 40 // 2 * 2, height // 40 // 2 * 2
    if shortest >= 40:
        return 20, 20, width // 20 // 2 * 2, height // 20 // 2 * 2
    return width // 2, height // 2, 2, 2


def area(quarter: NDArray[np.uint8], step_x: int, step_y: int) -> int:
    total = 0.0
    for row in quarter.tolist():
        for blue, green, red in row:
            total += (0.114 * blue + 0.587 * green) + 0.299 * red
    return math.trunc(total * (4.0 / (step_x * step_y)))


def cedd_reference(image: NDArray[np.uint8]) -> list[int]:
    height, width = image.shape[:2]
    columns, rows, step_x, step_y = grid(width, height)
    histogram = [0.0] * 144
    for j in range(rows):
        for i in range(columns):
            block = image[j * step_y : (j + 1) * step_y, i * step_x : (i + 1) * step_x]
            x, y = step_x // 2, step_y // 2
            quarters = block[:y, :x], block[:y, x:], block[y:, :x], block[y:, x:]
            areas = [area(quarter, step_x, step_y) for quarter in quarters]
            blue, green, red = (int(block[:, :, k].sum()) // (step_x * step_y) for k in range(3))
            outputs = colours(red, green, blue)
            for texture in texture_classes(*areas):
                for k, output in enumerate(outputs):
                    histogram[24 * texture + k] += output
    total = 0.0
    for value in histogram:
        total += value
    if total == 0:
        return [0] * 144
    levels = []
    for k, value in enumerate(histogram):
        distances = [abs(value / total - representative) for representative in TABLE_OF_CLASS[k // 24]]
        levels.append(distances.index(min(distances)))
    return levels
