"""The open-set score of the dense search: a log-odds that compares the leading candidate with all others.

An absolute similarity means little after a change of the bench: it falls for an enrolled object, too. Therefore the
score weighs several numbers (`Evidence`), each of which compares the leading candidate with the other candidates under
the same conditions. Half of them come from whitened descriptions: properties that all enrolled views share count little
there, and properties that distinguish them count much. The weights for the rig's own descriptor come from searches on
drawn benches (`hbr.evaluation.changed_bench`); for other descriptors they are fitted on leave-one-out searches of the
catalog, under changes of the bench of several strengths (`hbr.descriptors.shift`). The thresholds always come from the
catalog.

Sources: B. Hariharan, J. Malik and D. Ramanan, "Discriminative decorrelation for clustering and classification", ECCV
2012 (whitening); R. Auckenthaler, M. Carey and H. Lloyd-Thomas, "Score normalization for text-independent speaker
verification systems", Digital Signal Processing 10, 2000 (comparison with a cohort).

Decisions: docs/decisions/0049, docs/decisions/0059.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hbr.core.arrays import FloatArray, IndexArray, LevelArray
from hbr.dense.index import DenseIndex

#: Candidates that the leader is compared with.
COHORT: Final = 10
#: Enrolled views next to the estimated pose that are compared.
_NEXT: Final = 3
_BIN_DEG: Final = 5.0
#: Strength of the regularisation, which draws weights to 0.
_RIDGE: Final = 1e-3
_STEPS: Final = 60

#: The numbers that the score weighs: score of the leader, its margin, its lead over the cohort; the same of whitened
#: descriptions, and the cohort's mean.
NUMBERS: Final = ("score", "margin", "lead", "whitened", "whitened_margin", "whitened_lead", "whitened_cohort")


def evidence(
    index: DenseIndex,
    support: NDArray[np.float32],
    orientation_deg: FloatArray,
    queries: Sequence[LevelArray],
    *,
    units: Sequence[FloatArray] | None = None,
    enrolled: Callable[[IndexArray], FloatArray] | None = None,
    without: int | None = None,
) -> tuple[int, FloatArray]:
    """Return the place of the leading candidate, and the numbers of `NUMBERS`.

    Parameters
    ----------
    index : DenseIndex
        The enrolled views.
    support : float32 array (k, 72)
        As `Belief.support`.
    orientation_deg : float64 array (n,)
        Orientations of the camera at the queries.
    queries : sequence of uint8 arrays (length,) or (h, length)
        The queries.
    units : sequence of float64 arrays, optional
        Their whitened descriptions, if they are known.
    enrolled : callable, optional
        Returns whitened descriptions of enrolled views, (n, d), from their rows, if they are known.
    without : int, optional
        Place of an object that does not count, as if it were not enrolled.
    """
    count = len(queries)
    scores = np.maximum(support.max(axis=1).astype(np.float64) / count, 0) ** (1 / index.power)
    if without is not None:
        scores[without] = -1.0
    order = np.argsort(-scores, kind="stable")[: COHORT + 1]
    order = order[scores[order] >= 0]
    best = int(order[0])
    alone = np.zeros(len(NUMBERS))
    alone[[0, 1, 2]] = scores[best]
    if not queries:
        return best, alone
    if units is None:
        units = [index.whitening.unit(np.atleast_2d(query)) for query in queries]
    pose_deg = support[order].argmax(axis=1) * _BIN_DEG
    rotated_deg = orientation_deg - orientation_deg[0]
    rows = index.nearest_views(order, pose_deg[:, None] + rotated_deg, _NEXT)
    near = index.whitening.unit(index.views.levels(rows.ravel())) if enrolled is None else enrolled(rows.ravel())
    near = near.reshape(*rows.shape, -1)
    white = np.zeros(len(order))
    for n, unit in enumerate(units):
        white += (near[:, n] @ unit.T).max(axis=(1, 2)) / count
    if len(order) == 1:
        alone[3:6] = white[0]
        return best, alone
    others, white_others = scores[order[1:]], white[1:]
    found = [
        scores[best],
        scores[best] - others[0],
        scores[best] - others.mean(),
        white[0],
        white[0] - white_others.max(),
        white[0] - white_others.mean(),
        white_others.mean(),
    ]
    return best, np.array(found)


@dataclass(frozen=True, eq=False)
class OpenSetModel:
    """The weights of the open-set score after 1, 2, ... views; arrays (views, numbers).

    Attributes
    ----------
    middle, spread : float64 arrays
        Each number is reduced by its middle and divided by its spread.
    weights : float64 array
        Weights of the reduced numbers.
    offset : float64 array (views,)
        Added to their sum.
    """

    middle: FloatArray
    spread: FloatArray
    weights: FloatArray
    offset: FloatArray

    def score(self, numbers: FloatArray, views: int) -> float:
        """Return the open-set score of the numbers, (7,), after this many views."""
        n = min(views, len(self.offset)) - 1
        reduced = (numbers - self.middle[n]) / self.spread[n]
        return float(reduced @ self.weights[n] + self.offset[n])

    def scores(self, numbers: FloatArray) -> FloatArray:
        """Return the scores of searches, (searches, views), from their numbers, (searches, views, 7)."""
        found: FloatArray = ((numbers - self.middle) / self.spread * self.weights).sum(axis=2) + self.offset
        return found

    @classmethod
    def fitted(cls, known: FloatArray, correct: NDArray[np.bool_], unknown: FloatArray) -> "OpenSetModel":
        """Fit the weights by logistic regression.

        Parameters
        ----------
        known, unknown : float64 arrays (searches, views, 7)
            Numbers of searches for enrolled objects, and for the same objects as if they were not enrolled.
        correct : bool array (searches, views)
            Whether the leading candidate of `known` is right.
        """
        views = known.shape[1]
        middle, spread, weights, offset = [], [], [], []
        for n in range(views):
            numbers = np.concatenate([known[:, n], unknown[:, n]])
            wanted = np.concatenate([np.where(correct[:, n], 1.0, -1.0), -np.ones(len(unknown))])
            middle.append(numbers.mean(axis=0))
            spread.append(np.maximum(numbers.std(axis=0), 1e-6))
            found = _logistic((numbers - middle[-1]) / spread[-1], wanted)
            weights.append(found[:-1])
            offset.append(found[-1])
        return cls(np.array(middle), np.array(spread), np.array(weights), np.array(offset))


#: Weights of the numbers after 1, 2, 3 and 4 views, and offsets, by descriptor. They were fitted to searches for
#: objects 1–50 of COIL-100 after a hard change of the bench, with and without an empty-table image.
_FITTED: Final = {
    "edges+colours": (
        (
            (23.5, 26.93, 3.56, 3.76, 5.65, 4.2, -9.47),
            (15.88, 17.57, -0.86, 8.5, 8.35, 8.79, -8.87),
            (15.08, 12.21, 9.31, 7.9, 8.54, 8.02, -3.7),
            (17.66, 11.04, 7.94, 8.28, 8.74, 8.41, -3.97),
        ),
        (-23.302, -18.073, -18.337, -20.639),
    )
}


def fitted_before(descriptor: str, views: int) -> OpenSetModel | None:
    """Return the weights that come with the program for a descriptor and a number of views; None if there are none."""
    if descriptor not in _FITTED:
        return None
    weights, offset = (np.array(part, np.float64)[:views] for part in _FITTED[descriptor])
    if len(offset) < views:
        return None
    return OpenSetModel(np.zeros_like(weights), np.ones_like(weights), weights, offset)


def _logistic(numbers: FloatArray, wanted: FloatArray) -> FloatArray:
    """Return the weights and the offset that separate wanted values 1 and -1, by Newton's method."""
    columns = np.column_stack([numbers, np.ones(len(numbers))])
    found = np.zeros(columns.shape[1])
    ridge = 2 * _RIDGE * np.eye(len(found))
    for _ in range(_STEPS):
        margin = wanted * (columns @ found)
        doubt = 1 / (1 + np.exp(np.clip(margin, -30, 30)))
        gradient = -(columns * (wanted * doubt)[:, None]).mean(axis=0) + ridge @ found
        curvature = (columns * (doubt * (1 - doubt))[:, None]).T @ columns / len(columns) + ridge
        step = np.linalg.solve(curvature, gradient)
        found -= step
        if np.abs(step).max() < 1e-9:
            break
    return found
