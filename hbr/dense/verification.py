"""Comparison of a doubtful leader's enrolled views with the views of a search, pixel by pixel.

The open-set score compares descriptors of 8 x 8 cells. An unknown object may resemble an enrolled one at this coarse
scale, although its details do not fit. For each view, the enrolled views at the estimated pose are registered to it.
The fit is the share of the view's contrast that they explain, in colours that light hardly changes. The fit of the
leader, and its difference from the fit of the next candidates, are added to the open-set score with weights.

Decisions: docs/decisions/0059, docs/decisions/0060.
"""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from hbr.core.angles import size_deg, wrap360
from hbr.core.arrays import FloatArray
from hbr.dense.enrolled_views import Asking, NeedEnrolledViews, Queries
from hbr.dense.filter import Belief
from hbr.dense.open_set import fitted_before
from hbr.dense.pixel_fit import Pixels, fit
from hbr.dense.stopping import Outcome, StopDecision, StoppingRule, StopReason
from hbr.descriptors import descriptor

#: Numbers of compared candidates beside the leader, of enrolled views of each, and of segmentations of each view.
_OTHERS: Final = 3
_NEAREST: Final = 2
_SEGMENTATIONS: Final = 2
#: Weights of the open-set score, of the leader's fit, and of its difference from that of other candidates; an offset.
#: Fitted like `hbr.dense.open_set.fitted_before`: the result is a log-odds.
_WEIGHTS: Final = (0.714, 9.438, 4.995)
_OFFSET: Final = -5.416
#: Log-odds from which an object is found, and below which it is unknown: that of 1 in 100 enrolled objects.
FOUND_FROM: Final = 0.0
#: Log-odds from which an object is found on the bench of the enrollment, where an enrolled object fits much better. In
#: searches for objects 1–50 after a mild change, enrolled objects reach 5.6 or more, left-out objects 1.1 or less.
FOUND_FROM_SAME_BENCH: Final = 3.0
UNKNOWN_BELOW: Final = -1.3
#: With a smaller open-set score, an object is unknown at any fit.
_HOPELESS: Final = -7.0


@dataclass(frozen=True)
class Verification:
    """Fit of the leader's enrolled views to the views of a search.

    Attributes
    ----------
    object_index : int
        The leader.
    fit, others : float
        Mean fit of the leader and of the next candidates over the views, at most 1.
    """

    object_index: int
    fit: float
    others: float

    def score(self, open_set_score: float) -> float:
        """Return the log-odds that the leader is the object on the table, from the fits and the open-set score."""
        numbers = (open_set_score, self.fit, self.fit - self.others)
        return sum(weight * number for weight, number in zip(_WEIGHTS, numbers, strict=True)) + _OFFSET

    def decided(self, decision: StopDecision, least: float = FOUND_FROM) -> StopDecision:
        """Return the decision that replaces the given one; log-odds of at least ``least`` find the object."""
        score = self.score(decision.open_set_score)
        outcome = Outcome.UNKNOWN if score < UNKNOWN_BELOW else Outcome.AMBIGUOUS
        if score >= least and decision.probability >= decision.min_confidence:
            outcome = Outcome.FOUND
        return replace(decision, outcome=outcome, reason=StopReason.PIXEL_FIT)


def is_doubtful(rule: StoppingRule, decision: StopDecision, views: int, kind: str) -> bool:
    """Return whether a search must verify its leader before it ends.

    This is so if the open-set score is too low for an answer after fewer views. The weights are for the scores that
    come with the program. The rule has them if the catalog has enough objects.

    Parameters
    ----------
    rule
        Of the search.
    decision
        Decision with which it would end.
    views
        Views so far.
    kind
        The descriptor.
    """
    fitted = len(rule.open_set_thresholds)
    model = fitted_before(kind, fitted)
    if model is None or rule.open_set is None or not np.array_equal(model.weights, rule.open_set.weights):
        return False
    if decision.outcome is Outcome.CONTINUE or views < fitted or decision.reason is StopReason.UNCHANGED_BENCH:
        return False
    return _HOPELESS < decision.open_set_score < max(rule.open_set_thresholds)


def found_from(same_bench: bool | None) -> float:
    """Return the log-odds from which an object is found."""
    return FOUND_FROM_SAME_BENCH if same_bench else FOUND_FROM


def verify(belief: Belief, leader: int, queries: Queries) -> Asking[Verification | None]:
    """Compare the views of a search with the enrolled views of its leader and of the next candidates; None without.

    Parameters
    ----------
    belief
        After the last view.
    leader
        The leading candidate, as an index of the views' names.
    queries
        The views of the search, in the order of the belief's levels.
    """
    index, ranking = belief.index, belief.ranking()
    last_deg = float(belief.orientation_deg[-1])
    pose_deg = dict(zip(ranking.object_index.tolist(), ranking.pose_deg.tolist(), strict=True))
    candidates = [leader, *[one for one in ranking.object_index.tolist() if one != leader][:_OTHERS]]
    seen: list[list[Pixels]] = []
    similarity = descriptor(index.views.descriptor).similarity
    means = []
    for candidate in candidates:
        azimuths_deg = [wrap360(pose_deg[candidate] + o - last_deg) for o in belief.orientation_deg.tolist()]
        views = yield NeedEnrolledViews(candidate, tuple(azimuths_deg))
        if views is None:
            return None
        seen = seen or [[Pixels.of(one) for one in queries(n)] for n in range(belief.queries)]
        enrolled_deg = np.array([view.azimuth_deg for view in views])
        rows = index.views.of(candidate)
        prepared: dict[int, Pixels] = {}
        fits = []
        for n, azimuth_deg in enumerate(azimuths_deg):
            near = np.argsort(size_deg(enrolled_deg - azimuth_deg), kind="stable")[:_NEAREST].tolist()
            own = rows[np.argsort(size_deg(index.views.azimuth_deg[rows] - azimuth_deg), kind="stable")[:_NEAREST]]
            alike: FloatArray = similarity(np.atleast_2d(belief.levels[n]), index.views.levels(own)).max(axis=1)
            for place in near:
                if place not in prepared:
                    prepared[place] = Pixels.of(views[place])
            likeliest = np.argsort(-alike, kind="stable")[:_SEGMENTATIONS].tolist()
            fits.append(max(fit(seen[n][one], prepared[place]) for one in likeliest for place in near))
        means.append(float(np.mean(fits)))
    return Verification(leader, means[0], float(np.mean(means[1:])) if len(means) > 1 else 0.0)
