"""The open-set scores of the dense search: high for enrolled objects, low for unknown ones.

`open_set_score` is for a bench that has not changed. An absolute similarity means little after a change of the bench:
it falls for an enrolled object, too. Therefore `OpenSetModel.score`, a log-odds, weighs several numbers (`evidence`),
each of which compares the leading candidate with the other candidates under the same conditions. Half of them come from
whitened descriptions: properties that all enrolled views share count little there, and properties that distinguish them
count much. The weights for the rig's own descriptor come from searches on drawn benches
(`hbr.evaluation.changed_bench`); for other descriptors they are fitted on leave-one-out searches of the catalog, under
changes of the bench of several strengths (`hbr.descriptors.shift`). The thresholds always come from the catalog.

Sources: B. Hariharan, J. Malik and D. Ramanan, "Discriminative decorrelation for clustering and classification", ECCV
2012 (whitening); R. Auckenthaler, M. Carey and H. Lloyd-Thomas, "Score normalization for text-independent speaker
verification systems", Digital Signal Processing 10, 2000 (comparison with a cohort).

Decisions: docs/decisions/0049, docs/decisions/0059.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from hbr.core.arrays import FloatArray, IndexArray
from hbr.dense.filter import Belief
from hbr.dense.index import BIN_DEG

#: Weight of the margin in the open-set score without fitted weights, and of the leader's usual score.
_MARGIN_WEIGHT: Final = 0.5
_USUAL_WEIGHT: Final = 1.0
#: Candidates that the leader is compared with.
COHORT: Final = 10
#: Enrolled views next to the estimated pose that are compared.
_NEXT: Final = 3
#: Strength of the regularisation, which draws weights to 0.
_RIDGE: Final = 1e-3
_STEPS: Final = 60

#: The numbers that the score weighs: score of the leader, its margin, its lead over the cohort; the same of whitened
#: descriptions, and the cohort's mean.
NUMBERS: Final = ("score", "margin", "lead", "whitened", "whitened_margin", "whitened_lead", "whitened_cohort")

Scores = TypeVar("Scores", float, FloatArray)


@dataclass(frozen=True, eq=False)
class Leaders:
    """The leading candidate after each view of each search, arrays (searches, views).

    Attributes
    ----------
    object_index : integer array
        The leading candidate.
    score, margin : float64 array
        Its score per view, and that score minus the second one.
    """

    object_index: IndexArray
    score: FloatArray
    margin: FloatArray

    @classmethod
    def of(cls, found: FloatArray) -> "Leaders":
        """Return the leading candidates from what `leader` returned after each view, float64 (searches, views, 3)."""
        return cls(found[..., 0].astype(np.intp), found[..., 1], found[..., 2])

    def open_set_score(self, usual_scores: FloatArray) -> FloatArray:
        """Return the open-set score after each view of each search, (searches, views), from all `usual_scores`."""
        usual = usual_scores[self.object_index, np.arange(self.score.shape[1])]
        return open_set_score(self.score, self.margin, usual, np.median(usual_scores, axis=0))


def leader(object_index: IndexArray, scores: FloatArray) -> tuple[int, float, float]:
    """Return the leading candidate, its score and its margin: the whole score without a second candidate."""
    best = int(scores.argmax())
    margin = scores[best] - np.partition(scores, -2)[-2] if len(scores) > 1 else scores[best]
    return int(object_index[best]), float(scores[best]), float(margin)


def usual_scores(leaders: Leaders, correct: NDArray[np.bool_], objects: int) -> FloatArray:
    """Return each object's median score in the searches that found it, (objects, views); else the median of all."""
    usual = np.full((objects, leaders.score.shape[1]), np.nan)
    for n in range(usual.shape[1]):
        for j in np.unique(leaders.object_index[correct[:, n], n]).tolist():
            usual[j, n] = np.median(leaders.score[correct[:, n] & (leaders.object_index[:, n] == j), n])
        found = usual[~np.isnan(usual[:, n]), n]
        usual[np.isnan(usual[:, n]), n] = np.median(found) if len(found) else 0.0
    return usual


def open_set_score(score: Scores, margin: Scores, usual: Scores, typical: Scores) -> Scores:
    """Return the open-set score of a leading candidate without weights.

    It is the score plus half of the margin, minus the amount by which the leader usually scores more than other
    objects. An unknown object resembles several enrolled objects a little; an enrolled object resembles one of them
    closely. An object that looks the same from all sides usually scores more, so it must match better. ``usual`` is
    the usual score of the leader (`usual_scores`), and ``typical`` the median of those of all objects.
    """
    return score + _MARGIN_WEIGHT * margin - _USUAL_WEIGHT * (usual - typical)


def evidence(
    belief: Belief,
    units: Sequence[FloatArray],
    enrolled: Callable[[IndexArray], FloatArray],
    without: int | None = None,
) -> tuple[int, FloatArray]:
    """Return the place of the leading candidate, and the numbers of `NUMBERS`.

    Parameters
    ----------
    belief : Belief
        After n queries without weights.
    units : sequence of n float64 arrays (h, d)
        The whitened descriptions of each query, of unit length, a row for each segmentation.
    enrolled : callable
        Returns those of enrolled views, (m, d), from their rows.
    without : int, optional
        Place of an object that does not count, as if it were not enrolled.
    """
    scores = belief.scores()
    if without is not None:
        scores[without] = -1.0
    order = np.argsort(-scores, kind="stable")[: COHORT + 1]
    order = order[scores[order] >= 0]
    best = int(order[0])
    pose_deg = belief.support[order].argmax(axis=1) * BIN_DEG
    rotated_deg = belief.orientation_deg - belief.orientation_deg[0]
    rows = belief.index.nearest_views(order, pose_deg[:, None] + rotated_deg, _NEXT)
    near = enrolled(rows.ravel()).reshape(*rows.shape, -1)
    white = np.zeros(len(order))
    for n, unit in enumerate(units):
        white += (near[:, n] @ unit.T).max(axis=(1, 2)) / belief.queries
    numbers: list[float] = []
    for one in (scores[order], white):
        first, others = one[0], one[1:]
        numbers += [first, first - others.max(), first - others.mean()] if len(others) else [first] * 3
    return best, np.array([*numbers, white[1:].mean() if len(order) > 1 else 0.0])


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
        fits = []
        for n in range(known.shape[1]):
            numbers = np.concatenate([known[:, n], unknown[:, n]])
            wanted = np.concatenate([np.where(correct[:, n], 1.0, -1.0), -np.ones(len(unknown))])
            middle, spread = numbers.mean(axis=0), np.maximum(numbers.std(axis=0), 1e-6)
            found = _logistic((numbers - middle) / spread, wanted)
            fits.append((middle, spread, found[:-1], found[-1]))
        return cls(*map(np.array, zip(*fits, strict=True)))


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
