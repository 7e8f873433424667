"""Retrieval by enumeration of every path of every object and every pair of candidates, for comparison in tests."""

import itertools
import math
from collections.abc import Callable, Sequence

import numpy as np

from hbr import Views


def wrap(angle: float) -> float:
    return (angle + 180) % 360 - 180


def revolutions(a: float, b: float) -> float:
    return abs(wrap(a - b)) / 360


def similarity(a: Sequence[float], b: Sequence[float]) -> float:
    dot = sum(x * y for x, y in zip(a, b, strict=True))
    union = sum(x * x for x in a) + sum(y * y for y in b) - dot
    return dot / union if union else 0.0


SEVERAL = "cedd=0.3,cedd-blurred=0.7"


def similarity_of_several(a: Sequence[float], b: Sequence[float]) -> float:
    return 0.3 * similarity(a[:144], b[:144]) + 0.7 * similarity(a[144:], b[144:])


class Enumeration:
    """Return scores, poses and node sets of all candidates for some queries."""

    def __init__(
        self,
        queries: np.ndarray,
        orientations: Sequence[float],
        views: Views,
        omega: float,
        length: int,
        extension: str,
        alike: Callable[[Sequence[float], Sequence[float]], float] = similarity,
    ) -> None:
        self.rows = [row.tolist() for row in views.descriptors]
        self.azimuth = views.azimuth_deg.tolist()
        self.object_of = views.object_index.tolist()
        self.queries = [query.tolist() for query in queries]
        self.orientations, self.omega = orientations, omega
        self.steps = range(len(self.queries))
        self.similar = [[alike(query, row) for row in self.rows] for query in self.queries]
        self.lists = [sorted(range(len(views)), key=lambda v: (-self.similar[i][v], v))[:length] for i in self.steps]
        self.candidates = sorted({self.object_of[v] for rows in self.lists for v in rows})
        self.nodes = {j: getattr(self, extension)(j) for j in self.candidates}
        self.scores = {j: max(map(self.value, itertools.product(*self.nodes[j]))) for j in self.candidates}

    def of(self, j: int) -> list[int]:
        return [v for v, owner in enumerate(self.object_of) if owner == j]

    def listed(self, j: int) -> list[set[int]]:
        return [{v for v in rows if self.object_of[v] == j} for rows in self.lists]

    def rho(self, k: int, i: int, i_from: int) -> int:
        """Return the view of k's object that the camera sees at i if it saw k at i_from; the first of equals."""

        def miss(v: int) -> float:
            rotated = self.azimuth[v] - self.azimuth[k]
            return abs(wrap(rotated - (self.orientations[i] - self.orientations[i_from])))

        return min(self.of(self.object_of[k]), key=miss)

    def visual(self, j: int) -> list[set[int]]:
        return [own or {max(self.of(j), key=lambda v: self.similar[i][v])} for i, own in enumerate(self.listed(j))]

    def orient(self, j: int) -> list[set[int]]:
        nodes = self.listed(j)
        first = next(i for i in self.steps if nodes[i])
        for i in range(first + 1, len(nodes)):
            nodes[i] = nodes[i] or {self.rho(k, i, i - 1) for k in nodes[i - 1]}
        for i in range(first - 1, -1, -1):
            nodes[i] = {self.rho(k, i, i + 1) for k in nodes[i + 1]}
        return nodes

    def orient_all(self, j: int) -> list[set[int]]:
        listed = self.listed(j)
        return [
            listed[i] | {self.rho(k, i, other) for other in self.steps if other != i for k in listed[other]}
            for i in self.steps
        ]

    def value(self, path: Sequence[int]) -> float:
        similarity = sum(self.similar[i][v] for i, v in enumerate(path))
        penalty = sum(
            revolutions(
                self.orientations[i] - self.orientations[i + 1], self.azimuth[path[i]] - self.azimuth[path[i + 1]]
            )
            for i in range(len(path) - 1)
        )
        return similarity - self.omega * penalty


def next_view_reference(
    views: Views,
    ranked: Sequence[tuple[int, float]],
    last_list: Sequence[int],
    here: float,
    visited: Sequence[float],
    alike: Callable[[Sequence[float], Sequence[float]], float] = similarity,
) -> tuple[str, float, float, float]:
    """Return side, rotation, S_left and S_right from (object, pose) pairs, best first."""
    centres = [90 * s + 45 for s in range(4)]
    azimuth: list[float] = views.azimuth_deg.tolist()

    def average(j: int, s: int) -> list[float]:
        own = [v for v in range(len(views)) if views.object_index[v] == j]
        inside = [v for v in own if 90 * s <= azimuth[v] < 90 * s + 90]
        if not inside:
            inside = [min(own, key=lambda v: abs(wrap(azimuth[v] - centres[s])))]
        return [
            sum(int(views.descriptors[v][b]) for v in inside) / len(inside) for b in range(views.descriptors.shape[1])
        ]

    def step(pose: float, sign: int) -> tuple[int, float]:
        gaps = {s: (sign * (centres[s] - pose)) % 360 for s in range(4)}
        return min(((s, gap) for s, gap in gaps.items() if gap > 0), key=lambda item: item[1])

    pose_of = dict(ranked)
    compared = sorted({int(views.object_index[v]) for v in last_list})
    if len(compared) < 2:
        compared = sorted(j for j, _ in ranked[:10])
    sums = {
        sign: math.fsum(
            alike(average(j, step(pose_of[j], sign)[0]), average(other, step(pose_of[other], sign)[0]))
            for j, other in itertools.combinations(compared, 2)
        )
        for sign in (1, -1)
    }
    sign = 1 if sums[1] <= sums[-1] else -1
    rotate = step(ranked[0][1], sign)[1]
    for detour in (0, 90, 180, 270):
        if all(abs(wrap(here + sign * (rotate + detour) - seen)) > 10 for seen in visited):
            rotate += detour
            break
    return ("left" if sign == 1 else "right"), sign * rotate, sums[1], sums[-1]
