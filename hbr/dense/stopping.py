"""The stopping rule of the dense search: it ends searches and rejects unknown objects at measured error rates.

`hbr.dense.fitting` sets the thresholds, and `StoppingRule.decide` applies them after each view of a search. The
open-set score is high for enrolled objects and low for unknown ones. `open_set_score` is for a bench that has not
changed. An absolute similarity means little after a change of the bench: it falls for an enrolled object, too.
Therefore `OpenSetModel.score`, a log-odds, weighs several numbers (`evidence`), each of which compares the leading
candidate with the other candidates under the same conditions. Half of them come from whitened descriptions: properties
that all enrolled views share count little there, and properties that distinguish them count much. The weights for the
rig's own descriptor come from searches on drawn benches (`hbr.drawing.bench`); for other descriptors they
are fitted on leave-one-out searches of the catalog, under changes of the bench of several strengths
(`hbr.descriptors.base.Shift`). The thresholds always come from the catalog.

Sources: B. Hariharan, J. Malik and D. Ramanan, "Discriminative decorrelation for clustering and classification", ECCV
2012 (whitening); R. Auckenthaler, M. Carey and H. Lloyd-Thomas, "Score normalization for text-independent speaker
verification systems", Digital Signal Processing 10, 2000 (comparison with a cohort).

Decision: docs/decisions/0015.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import cached_property
from typing import Any, Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from hbr.core.arrays import FloatArray, IndexArray
from hbr.dense.filter import Belief
from hbr.dense.index import BIN_DEG

#: Weight of the margin in the open-set score without fitted weights, and of the leader's usual score.
# score or margin alone accept 4 to 21 % of unknown objects, both together about 2 % (decision 0015)
_MARGIN_WEIGHT: Final = 0.5
_USUAL_WEIGHT: Final = 1.0
#: Candidates that the leader is compared with.
COHORT: Final = 10  # more: less noise, and less similar objects, whose scores say less about the leader
#: Enrolled views next to the estimated pose that are compared.
_NEXT: Final = 3
#: Strength of the regularisation, which draws weights to 0.
_RIDGE: Final = 1e-3
_STEPS: Final = 60  # far more than Newton's method needs: only a bound, so that data without a minimum end too

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
        """Fit the weights by logistic regression."""
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


class Outcome(StrEnum):
    """What a search does after a view: continue, or end with one of three answers."""

    CONTINUE = "continue"
    FOUND = "found"
    AMBIGUOUS = "ambiguous"
    UNKNOWN = "unknown"


class StopReason(StrEnum):
    """The reason why a search continues or ends."""

    CONFIDENT = "confident"
    NOT_CONFIDENT = "not-confident"
    BELOW_OPEN_SET_THRESHOLD = "below-open-set-threshold"
    BADLY_SEGMENTED = "badly-segmented"
    MARGIN = "margin"
    MAX_VIEWS = "max-views"
    NO_ROTATION_LEFT = "no-rotation-left"
    LOCAL_DIFFERENCE = "local-difference"
    PIXEL_FIT = "pixel-fit"
    UNCHANGED_BENCH = "unchanged-bench"
    CUSTOM = "custom"


@dataclass(frozen=True, slots=True)
class StopDecision:
    """The decision of the stopping rule after a view, and the numbers that it compared.

    Attributes
    ----------
    outcome, reason
        What to do, and why.
    object_index : int
        The leading candidate, for every outcome.
    probability, min_confidence : float
        Its probability among the enrolled objects, and the probability that ends a search. It is the confidence of an
        answer only if the object is found.
    open_set_score, open_set_threshold : float
        A number that is high for enrolled objects, and the score below which an object is unknown; with a threshold of
        -inf no object is unknown.
    """

    outcome: Outcome
    reason: StopReason
    object_index: int
    probability: float
    min_confidence: float
    open_set_score: float
    open_set_threshold: float


class LimitationCode(StrEnum):
    """The kinds of limitations: each names something that a stopping rule does not guarantee."""

    SAMPLED = "sampled"
    FALSE_REJECT_RATE = "false-reject-rate"
    ERROR_RATE = "error-rate"
    FALSE_ACCEPT_RATE = "false-accept-rate"
    SIMILAR_OBJECTS = "similar-objects"
    UNKNOWN_NOT_MEASURED = "unknown-not-measured"
    ONE_OBJECT = "one-object"
    SINGLE_VIEWS = "single-views"


@dataclass(frozen=True, slots=True)
class Limitation:
    """A rate that a stopping rule does not guarantee, with the numbers that are the reason.

    Attributes
    ----------
    code
        What is not guaranteed.
    values
        ``sampled``: ``searched`` of ``objects``. ``false-reject-rate``: ``rate`` asked for, ``searches`` done and
        ``needed``, ``reached`` rate. ``error-rate`` and ``similar-objects``: ``rate``, ``searches``, ``needed``,
        ``min_confidence``, and ``wrong`` of ``ended`` searches. ``false-accept-rate``: ``rate``, and ``accepted`` of
        ``searches`` for left-out objects.
    """

    code: LimitationCode
    values: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class ShiftRates:
    """Rates in leave-one-out searches under a change of the bench.

    Attributes
    ----------
    strength : float
        Of the change; 1 is a hard one.
    searches : int
        Searches for enrolled objects, and as many for the same objects as if they were not enrolled.
    accepted, rejected : int
        Enrolled objects that were accepted after at most all views, and that were called unknown.
    false_accepts : int
        Objects that were not enrolled, and were accepted.
    """

    strength: float
    searches: int
    accepted: int
    rejected: int
    false_accepts: int


def by_confidence(is_enough: bool, *, last: bool, reliable: bool) -> tuple[Outcome, StopReason]:
    """Return what a search does whose open-set score is high enough, from whether its confidence is enough, too."""
    if is_enough and (reliable or last):
        return Outcome.FOUND, StopReason.CONFIDENT
    if last:
        return Outcome.AMBIGUOUS, StopReason.MAX_VIEWS
    return Outcome.CONTINUE, StopReason.BADLY_SEGMENTED if is_enough else StopReason.NOT_CONFIDENT


@dataclass(frozen=True, eq=False)
class StoppingRule:
    """A rule that ends a search and decides which objects are unknown.

    Attributes
    ----------
    beta : float
        As for `Belief.posterior`.
    min_confidence : float
        Confidence that ends a search.
    usual_scores : float64 array (objects, views)
        Usual score of each object when it is searched for, after 1, 2, ... views.
    open_set_thresholds : tuple of float
        Open-set scores after 1, 2, ... views below which an object is unknown; the last one is for all further views.
        With -inf no object is unknown.
    error_rate, false_reject : float
        The rates asked for: wrong objects among those named, and enrolled objects called unknown.
    false_accept : float
        Measured share of left-out objects that were not called unknown after all views; nan if not measured.
    searches : int
        Leave-one-out searches that the rule comes from.
    limitations : tuple of Limitation
        What the rule does not guarantee; empty if it guarantees both rates.
    open_set : OpenSetModel, optional
        The weights of the open-set score. Without them the score is that of `hbr.dense.stopping.open_set_score`.
    unknown_thresholds : tuple of float
        With weights: open-set scores after 1, 2, ... views below which an object is unknown. Between them and
        ``open_set_thresholds`` it is ambiguous. Without weights both thresholds are one.
    changed_bench_thresholds, same_bench_thresholds : tuple of float
        With weights: ``open_set_thresholds`` for a bench that is known to have changed since the enrollment, and for
        one that is known to be the same.
    leave_one_out_thresholds : tuple of float
        With weights: scores of `hbr.dense.stopping.open_set_score` after 1, 2, ... views. On an unchanged bench,
        few enrolled objects score less, and an object that reaches the highest of them is found.
    rates : tuple of ShiftRates
        Measured rates under changes of the bench.
    """

    beta: float
    min_confidence: float
    usual_scores: FloatArray
    open_set_thresholds: tuple[float, ...]
    error_rate: float
    false_reject: float
    false_accept: float
    searches: int
    limitations: tuple[Limitation, ...] = ()
    open_set: OpenSetModel | None = None
    unknown_thresholds: tuple[float, ...] = ()
    changed_bench_thresholds: tuple[float, ...] = ()
    same_bench_thresholds: tuple[float, ...] = ()
    leave_one_out_thresholds: tuple[float, ...] = ()
    rates: tuple[ShiftRates, ...] = ()

    def decide(
        self, belief: Belief, *, max_views: int = 8, reliable: bool = True, same_bench: bool | None = None
    ) -> StopDecision:
        """Decide whether a search ends after these views.

        An object is found if its confidence and its open-set score reach their thresholds. Before the last fitted view
        the highest of all open-set thresholds counts: an unknown object that passes the first threshold gets
        another view, which costs an enrolled object little. From the last fitted view on, an object below the
        threshold is unknown, even if views are left: no false-reject rate was measured for those. After ``max_views``
        an object with too little confidence is ambiguous. If the views were not segmented reliably, the search
        continues until ``max_views``: another view costs little, and the background is then known. ``same_bench`` is
        whether the bench is that of the enrollment; None: not known. On the same bench, an object with enough
        confidence is also found if it reaches all leave-one-out thresholds, which are for an unchanged bench.
        """
        best, probability = belief.likeliest(self.beta)
        known = {True: self.same_bench_thresholds, False: self.changed_bench_thresholds, None: ()}[same_bench]
        thresholds = known or self.open_set_thresholds
        fitted = len(thresholds)
        views = belief.queries
        n = min(views, fitted) - 1
        score = self._open_set_score(belief, n)
        early, last = views < min(fitted, max_views), views >= max_views
        threshold = max(thresholds) if early else thresholds[n]
        unknown_below = min(threshold, self.unknown_thresholds[n]) if self.unknown_thresholds else threshold
        if score >= threshold:
            outcome, reason = by_confidence(probability >= self.min_confidence, last=last, reliable=reliable)
        else:
            outcome, reason = Outcome.UNKNOWN, StopReason.BELOW_OPEN_SET_THRESHOLD
            if not early and score >= unknown_below:
                outcome = Outcome.AMBIGUOUS
            if early or (outcome is Outcome.AMBIGUOUS and not last):
                outcome = Outcome.CONTINUE
            elif not (reliable or last):
                outcome, reason = Outcome.CONTINUE, StopReason.BADLY_SEGMENTED
        object_index = int(belief.index.object_index[best])
        decision = StopDecision(outcome, reason, object_index, probability, self.min_confidence, score, threshold)
        if same_bench and reliable and score < threshold and views <= fitted:
            return self._found_on_same_bench(belief, n, decision)
        return decision

    def _found_on_same_bench(self, belief: Belief, n: int, decision: StopDecision) -> StopDecision:
        """Return the decision by the leave-one-out score, which is for an unchanged bench."""
        if not self.leave_one_out_thresholds or decision.probability < self.min_confidence:
            return decision
        leading, score = self._leave_one_out_score(belief, n)
        threshold = max(self.leave_one_out_thresholds)
        if leading != decision.object_index or score < threshold:
            return decision
        return replace(
            decision,
            outcome=Outcome.FOUND,
            reason=StopReason.UNCHANGED_BENCH,
            open_set_score=score,
            open_set_threshold=threshold,
        )

    def _open_set_score(self, belief: Belief, n: int) -> float:
        if self.open_set is not None:
            levels, unit = belief.index.views.levels, belief.index.whitening.unit
            units = [unit(np.atleast_2d(query)) for query in belief.levels]
            _, numbers = evidence(belief, units, lambda rows: unit(levels(rows)))
            return self.open_set.score(numbers, belief.queries)
        return self._leave_one_out_score(belief, n)[1]

    def _leave_one_out_score(self, belief: Belief, n: int) -> tuple[int, float]:
        """Return the object with the highest score, and its open-set score as in the leave-one-out searches."""
        best, score, margin = leader(belief.index.object_index, belief.scores())
        return best, open_set_score(score, margin, float(self.usual_scores[best, n]), self._typical_scores[n])

    @cached_property
    def _typical_scores(self) -> list[float]:
        typical: list[float] = np.median(self.usual_scores, axis=0).tolist()
        return typical
