"""Searches in motion: every frame is evidence, and the search chooses arcs instead of single views.

Frames a few degrees apart show nearly the same. If the correlation of what they show falls off as exp(-d / L) with
their distance d, a frame adds the share 1 - exp(-2 d / L) of a new one (the part of a Markov process that the frame
before does not determine). With this weight, the evidence of an arc does not depend on the number of its frames.

The search decides each time the frames have covered another step of the circle. The rule of searches at rest decides
after the first view. It also decides which objects are unknown, from a few frames that are far apart. The confidence
that ends a search later comes from leave-one-out searches along such arcs, with as many decisions and the same weights.

Decision: docs/decisions/0019.
"""

from collections.abc import Sequence
from dataclasses import replace
from math import exp
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from hbr.core.angles import size_deg, wrap360
from hbr.core.arrays import FloatArray, LevelArray
from hbr.dense.filter import Belief, update_belief
from hbr.dense.fitting import fit_min_confidence
from hbr.dense.index import DenseIndex
from hbr.dense.leave_one_out import LeaveOneOut, leave_one_out, searched_objects
from hbr.dense.next_view import SHARPNESS, NextBestView, log_confusion, pairs_after
from hbr.dense.session import MOST_CHANGES, DenseSession
from hbr.dense.stopping import Outcome, StopDecision, StoppingRule, StopReason, by_confidence

STEP_DEG: Final = 15.0
"""The rule decides each time the frames have covered this much more of the circle."""
ARC_DEG: Final = 210.0
"""An object that is not found on an arc of this length is unknown."""
DECISIONS: Final = round(ARC_DEG / STEP_DEG) + 1
CORRELATION_DEG: Final = 90.0
"""L: distance between the views of a search at rest."""
FRAME_DEG: Final = 3.0
"""Usual distance of frames in motion: 30 frames/s at 90 °/s."""
LEAST_ARC_DEG: Final = 45.0
"""Shortest arc to a goal, so that the table does not slow down before the next decision."""
SIDE_DEG: Final = 60.0
"""Frames at least this far apart count as views of a search at rest in the open-set score."""
MOTION_LOSS: Final = 0.007
"""Largest loss of similarity by smear and rolling shutter: 5 % quantile of views of COIL-100 in motion, compared with a
second enrollment at rest."""
MOST_SEARCHES: Final = 160  # fewer than at rest (400): a search along an arc has 15 decisions instead of 4 views


def frame_weight(apart_deg: float) -> float:
    """Return the weight of a frame, 0..1, from its distance to the nearest earlier frame in degrees."""
    return 1.0 - exp(-2.0 * max(apart_deg, 0.0) / CORRELATION_DEG)


STEP_WEIGHT: Final = STEP_DEG / FRAME_DEG * frame_weight(FRAME_DEG)
"""Sum of the weights of the frames between two decisions."""


def fit_arc_confidence(index: DenseIndex, rest: StoppingRule) -> float:
    """Return the confidence that ends a search in motion, from leave-one-out searches along arcs of `ARC_DEG`.

    Searches that end with the first view count, too, because ``rest.error_rate`` is the error rate of all named
    objects. If there are more objects than searches, a sample of the objects is searched for among each other. A
    catalog without candidates or with single views has the confidence of searches at rest, ``rest.min_confidence``.
    """
    chosen = searched_objects(index, MOST_SEARCHES, MOST_SEARCHES if len(index) > MOST_SEARCHES else None)
    if chosen is None:
        return rest.min_confidence
    some, each, _ = chosen
    searches = leave_one_out(
        some, beta=rest.beta, views=DECISIONS, searches=each, step_deg=STEP_DEG, weight=STEP_WEIGHT
    )
    return arc_confidence(searches, rest)


def arc_confidence(searches: LeaveOneOut, rest: StoppingRule) -> float:
    """Return the confidence that keeps ``rest.error_rate`` in searches along arcs, with a decision every `STEP_DEG`."""
    confidence = searches.confidence.copy()
    confidence[:, 0] = confidence[:, 0] >= rest.min_confidence  # after the first view, the rule at rest decides
    confidence[:, 1 : round(SIDE_DEG / STEP_DEG)] = 0.0  # no object is found this soon
    found, _ = fit_min_confidence(replace(searches, confidence=confidence), rest.error_rate)
    return max(found, rest.min_confidence)  # even if no confidence keeps the rate: not sooner than at rest


class ArcSession(DenseSession):
    """A search in motion.

    The rule of searches at rest decides after the first view, and decides which objects are unknown. All frames give
    the confidence. The open-set score comes from frames that are `SIDE_DEG` apart, because it was measured on such
    views.

    Parameters
    ----------
    index, rule, most_changes
        As for a search at rest.
    min_confidence : float
        Confidence that ends the search after the first view, from `fit_arc_confidence`.

    Attributes
    ----------
    decisions : int
        Number of decisions so far; the first view is the first one.
    """

    _NEWEST = 4  # 60°: the frames of fewer steps are hardly enough evidence of a change

    def __init__(
        self, index: DenseIndex, rule: StoppingRule, min_confidence: float, *, most_changes: int = MOST_CHANGES
    ) -> None:
        super().__init__(index, rule, max_views=DECISIONS, most_changes=most_changes)
        self.decisions = 0
        self._min_confidence = min_confidence
        self._covered_deg = 0.0
        self._sides: tuple[Belief, int] | None = None

    def _replace(self, queries: Sequence[LevelArray]) -> None:
        super()._replace(queries)
        self._sides = None  # these belief and views were described differently

    def _forget(self) -> None:
        super()._forget()
        self.decisions, self._covered_deg, self._sides = 0, 0.0, None

    def _begin_view(self, orientation_deg: float) -> None:
        if self._so_far is not self._index:
            self._covered_deg += min(self._apart_deg(orientation_deg), STEP_DEG)
        decisions = 1 + int(self._covered_deg / STEP_DEG + 1e-9)
        self.is_new_decision = decisions > self.decisions
        self.decisions = decisions

    def _apart_deg(self, orientation_deg: float) -> float:
        return float(size_deg(self.belief.orientation_deg - orientation_deg).min())

    def next_best_view(self, rotations_deg: ArrayLike | None = None, seconds: ArrayLike | None = None) -> NextBestView:
        """Return the rotation along the most informative arc, as `next_arc` does; rotations and times are needed."""
        ends_deg, times_s = np.asarray(rotations_deg, np.float64), np.asarray(seconds, np.float64)
        return next_arc(self.belief, beta=self.rule.beta, rotations_deg=ends_deg, seconds=times_s)

    def _weight(self, orientation_deg: float) -> float | None:
        return frame_weight(self._apart_deg(orientation_deg)) if isinstance(self._so_far, Belief) else None

    def _decide(self, *, last: bool = False) -> StopDecision:
        sides = self._frames_apart()
        last = last or self.decisions >= DECISIONS
        decision = self._by_rule(sides, sides.queries if last else self.max_views)
        if decision.outcome is Outcome.UNKNOWN and self.decisions > 1 and self._may_be_smeared(decision):
            return replace(decision, outcome=Outcome.AMBIGUOUS if last else Outcome.CONTINUE)
        if self.decisions == 1 or decision.reason is StopReason.BELOW_OPEN_SET_THRESHOLD:
            return decision
        best, probability = self.belief.likeliest(self.rule.beta)
        # as at rest: an object that is not found by its first view is found by two
        is_enough = sides.queries > 1 and probability >= self._min_confidence
        outcome, reason = by_confidence(is_enough, last=last, reliable=self._reliable)
        return replace(
            decision,
            outcome=outcome,
            reason=reason,
            object_index=int(self.belief.index.object_index[best]),
            probability=probability,
            min_confidence=self._min_confidence,
        )

    @property
    def is_doubtful(self) -> bool:
        """Never: a search in motion is not verified, because its frames are smeared, and mostly segmented only once."""
        return False

    def _may_be_smeared(self, decision: StopDecision) -> bool:
        """Return whether an enrolled object could have missed the threshold because it was in motion.

        A fitted open-set score has other units; its rule has a doubtful range of its own.
        """
        missing = decision.open_set_threshold - decision.open_set_score
        return self.rule.open_set is None and missing <= MOTION_LOSS

    def _frames_apart(self) -> Belief:
        """Return the belief from the frames that are at least `SIDE_DEG` apart from each other."""
        belief = self.belief
        sides, seen = self._sides if self._sides and self._sides[0].index is belief.index else (None, 0)
        for levels, orientation_deg in zip(belief.levels[seen:], belief.orientation_deg[seen:].tolist(), strict=True):
            if sides is None or size_deg(sides.orientation_deg - orientation_deg).min() >= SIDE_DEG:
                sides = update_belief(levels, orientation_deg, sides or belief.index, kept=len(belief.index))
        assert sides is not None
        self._sides = sides, belief.queries
        return sides


def next_arc(belief: Belief, *, beta: float, rotations_deg: FloatArray, seconds: FloatArray) -> NextBestView:
    """Choose the arc with the lowest sum of expected confusion and cost.

    All frames on the way count: the exponents of `hbr.dense.next_view.next_best_view` are added up from the last view
    to the end of the arc, each with the weight of its frames.
    """
    here_deg = float(belief.orientation_deg[-1])
    apart_deg = size_deg(here_deg + rotations_deg[:, None] - belief.orientation_deg).min(axis=1)
    new = np.minimum(apart_deg / STEP_DEG, 1.0) * STEP_WEIGHT
    pairs = pairs_after(belief, beta, rotations_deg)
    is_one = not pairs.probability.any()  # one object alone: a new side helps to find its azimuth
    exponent = np.zeros_like(pairs.similar) if is_one else new[:, None] * pairs.known * (1 - pairs.similar)
    confusion = np.zeros(len(rotations_deg))
    for side in (1.0, -1.0):
        way = np.flatnonzero(np.sign(rotations_deg) == side)
        way = way[np.argsort(np.abs(rotations_deg[way]))]
        if is_one:
            confusion[way] = -SHARPNESS * np.cumsum(new[way])
        else:
            remaining = pairs.probability * np.exp(-SHARPNESS * np.cumsum(exponent[way], axis=0))
            confusion[way] = log_confusion(remaining)
    sums = np.where(np.abs(rotations_deg) >= LEAST_ARC_DEG, confusion + seconds, np.inf)
    chosen = int((sums if np.isfinite(sums).any() else confusion + seconds).argmin())
    rotation_deg = float(rotations_deg[chosen])
    pair = None if is_one else pairs.named(int(pairs.probability.argmax()))
    return NextBestView(rotation_deg, wrap360(here_deg + rotation_deg), pair, rotations_deg, confusion, seconds, None)
