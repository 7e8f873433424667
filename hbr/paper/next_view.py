"""Active Hough-based retrieval (AHBR): the next best view.

Source: Czúni and Rashad, "Lightweight Active Object Retrieval with Weak Classifiers", Sensors 2018, 18, 801, Eq. 5-7.
"""

from dataclasses import dataclass
from typing import Final, Literal, get_args

import numpy as np

from hbr.core.angles import wrap180, wrap360
from hbr.core.arrays import FloatArray, IndexArray
from hbr.descriptors import descriptor
from hbr.model.views import Views
from hbr.paper.hough import Ranking

Side = Literal["left", "right"]

#: Average views of an object, N~M of Eq. 5: the paper's number.
SECTORS: Final = 4
_BEST: Final = 10  # the length of the paper's lists
#: A rotation that ends as close as this to a visited orientation is extended.
_REVISIT_DEG: Final = 10.0


@dataclass(frozen=True)
class Decision:
    """The side to rotate to, and the numbers of the decision."""

    side: Side
    """``left`` moves the camera counter-clockwise around the object, seen from above."""
    rotation_deg: float
    """Rotation of the camera around the object, positive to the left, including the detour."""
    s_left: float
    s_right: float
    """Similarity of the candidates on each side (Eq. 6), summed over their pairs. The side with the smaller sum
    separates them better."""
    candidates: tuple[int, ...]
    """Indices of the compared objects."""
    orientation_deg: float
    """Orientation after the rotation, with the same zero as those of the queries, in [0, 360)."""
    detour_deg: float
    """Part of the rotation, without sign, that avoids orientations that were visited before."""


def next_view(ranking: Ranking, *, side: Side | None = None, sectors: int = SECTORS) -> Decision:
    """Choose the side on which the candidates differ most, and the rotation to the next sector centre there.

    The views of an object are divided into equal sectors, each represented by an average view (Eq. 5). The sector
    centre is that of the best candidate. The candidates are the objects on the last retrieval list; if there are fewer
    than two, the ten best ones of the ranking. A rotation that ends within 10 degrees of an orientation that was
    visited before is extended by a sector, repeatedly until it is clear of all. If all ends are visited, the first one
    is used.

    Parameters
    ----------
    ranking : Ranking
        A ranking of at least two queries.
    side : {"left", "right"}, optional
        Rotate to this side by the same step, independently of the similarities: a control for measurements.
    sectors : int
        Number of sectors (N~M), 2 to 16.

    Returns
    -------
    Decision
        The side is left if both sums are equal.

    Raises
    ------
    ValueError
        The ranking has only one query, `sectors` is out of range, or `side` is unknown.
    """
    if len(ranking.orientation_deg) < 2:
        raise ValueError("a decision needs two queries; rotate to the second view by a fixed step such as +90 degrees")
    if not 2 <= sectors <= 16:  # the centres of more sectors are too close to each other to avoid a visited one
        raise ValueError(f"sectors is {sectors}; 2 to 16 are possible, {SECTORS} by default")
    if side not in (None, *get_args(Side)):
        raise ValueError(f"side {side!r} is unknown; use left or right, or None to decide by the candidates")

    candidates = np.unique(ranking.views.object_index[ranking.lists[-1]])
    if len(candidates) < 2:
        candidates = np.sort(ranking.object_index[:_BEST])
    pose_of = dict(zip(ranking.object_index.tolist(), ranking.pose_deg.tolist(), strict=True))
    poses = np.array([pose_of[j] for j in candidates.tolist()])
    centres_deg = (np.arange(sectors, dtype=np.float64) + 0.5) * (360 / sectors)
    s_left = _side_similarity(ranking.views, candidates, _next_sector(poses, +1, centres_deg)[0], centres_deg)
    s_right = _side_similarity(ranking.views, candidates, _next_sector(poses, -1, centres_deg)[0], centres_deg)

    if side is None:
        side = "left" if s_left <= s_right else "right"
    sign = 1 if side == "left" else -1
    step = float(_next_sector(ranking.pose_deg[:1], sign, centres_deg)[1][0])
    here = float(ranking.orientation_deg[-1])
    detour = _detour(here + sign * step, sign * 360 / sectors, ranking.orientation_deg)
    rotation = sign * (step + detour)
    return Decision(side, rotation, s_left, s_right, tuple(candidates.tolist()), wrap360(here + rotation), detour)


def _next_sector(pose_deg: FloatArray, sign: int, centres_deg: FloatArray) -> tuple[IndexArray, FloatArray]:
    """Return the sector whose centre is next on the left (+1) or right (-1), and the rotation to it, above 0."""
    gap_deg = wrap360(sign * (centres_deg - pose_deg[:, None]))
    gap_deg[gap_deg == 0] = 360.0
    return gap_deg.argmin(axis=1), gap_deg.min(axis=1)


def _side_similarity(views: Views, candidates: IndexArray, places: IndexArray, centres_deg: FloatArray) -> float:
    """Return the sum of the similarities of all pairs of candidates, each in the sector at its place (Eq. 6)."""
    half_deg = 180 / len(centres_deg)
    own = zip(candidates.tolist(), centres_deg[places].tolist(), strict=True)
    averages = np.stack([_average_view(views, j, centre_deg, half_deg) for j, centre_deg in own])
    return float(np.triu(descriptor(views.descriptor).similarity_of_means(averages), k=1).sum())


def _average_view(views: Views, object_index: int, centre_deg: float, half_deg: float) -> FloatArray:
    """Return the mean descriptor of an object's views in a sector (Eq. 5), or the nearest view if it is empty."""
    rows = views.of(object_index)
    offset_deg = wrap180(views.azimuth_deg[rows] - centre_deg)
    inside = rows[(offset_deg >= -half_deg) & (offset_deg < half_deg)]
    if not len(inside):
        inside = rows[[np.abs(offset_deg).argmin()]]
    mean: FloatArray = views.levels(inside).mean(axis=0)
    return mean


def _detour(landing_deg: float, sector_deg: float, visited_deg: FloatArray) -> float:
    """Return the multiple of a sector, without sign, that leads away from the visited orientations."""
    for count in range(round(360 / abs(sector_deg))):
        if np.all(np.abs(wrap180(landing_deg + count * sector_deg - visited_deg)) > _REVISIT_DEG):
            return count * abs(sector_deg)
    return 0.0
