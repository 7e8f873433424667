"""Searches in motion: frames that pass on the way are evidence, and an arc is chosen instead of a view.

Frames a few degrees apart show nearly the same. If the correlation of what they show falls off as exp(-d / L) with
their distance d, a frame adds the share 1 - exp(-2 d / L) of a new one (the part of a Markov process that the frame
before does not determine). With this weight, the evidence of an arc does not depend on the number of its frames.

The stopping rule decides each time the frames have covered another step of the circle. Its limits come from
leave-one-out searches along such arcs, with as many decisions and the same weights: `calibrate_arc_rule`.

Decision: docs/decisions/0047.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import exp
from typing import Final

import numpy as np

from hbr.core.angles import size_deg
from hbr.core.arrays import FloatArray, LevelArray
from hbr.dense.filter import Belief
from hbr.dense.index import DenseIndex
from hbr.dense.leave_one_out import leave_one_out
from hbr.dense.next_view import expected_similarity, strongest
from hbr.dense.session import DenseSession
from hbr.dense.stopping import (
    FEWEST_OBJECTS,
    StopDecision,
    StoppingRule,
    calibrate_stopping_rule,
    fit_stopping_rule,
)

STEP_DEG: Final = 15.0
"""The rule decides whenever the frames have covered so much more of the circle."""
ARC_DEG: Final = 210.0
"""An object that is not found on so long an arc is unknown."""
DECISIONS: Final = round(ARC_DEG / STEP_DEG) + 1
CORRELATION_DEG: Final = 90.0
"""L: views of a search at rest are so far apart."""
FRAME_DEG: Final = 3.0
"""Usual distance of frames in motion: 30 frames/s at 90 °/s."""
LEAST_ARC_DEG: Final = 45.0
"""A goal is so far ahead that the table does not slow down before the next decision."""
MOST_SEARCHES: Final = 160
_SHARPNESS: Final = 100.0


def frame_weight(apart_deg: float) -> float:
    """Return how much a frame counts whose distance to the nearest earlier one is ``apart_deg``."""
    return 1.0 - exp(-2.0 * max(apart_deg, 0.0) / CORRELATION_DEG)


STEP_WEIGHT: Final = STEP_DEG / FRAME_DEG * frame_weight(FRAME_DEG)
"""What the frames between two decisions count together."""


def calibrate_arc_rule(
    index: DenseIndex, *, error_rate: float = 0.01, false_reject: float = 0.02, most_searches: int = MOST_SEARCHES
) -> StoppingRule:
    """Return the rule of searches in motion, from leave-one-out searches along arcs of `ARC_DEG`.

    A catalog without candidates or with single views has the rule of searches at rest.
    """
    if len(index) < 2 or int(np.median((~index.left_out).sum(axis=1))) < 2:
        return calibrate_stopping_rule(index, error_rate=error_rate, false_reject=false_reject).rule
    searches = leave_one_out(
        index,
        views=DECISIONS,
        searches=max(1, min(most_searches // len(index), int(index.rows.shape[1]))),
        step_deg=STEP_DEG,
        weight=STEP_WEIGHT,
    )
    objects = len(index) if len(index) >= FEWEST_OBJECTS else None
    return fit_stopping_rule(searches, error_rate=error_rate, false_reject=false_reject, objects=objects)


class ArcSession(DenseSession):
    """A search in motion, the same for the bench and for replay.

    Attributes
    ----------
    decisions
        Decisions so far; the first view is the first one.
    is_new_decision
        Whether the last view led to a decision.
    """

    def __init__(self, index: DenseIndex, rule: StoppingRule) -> None:
        super().__init__(index, rule, max_views=DECISIONS)
        self.decisions = 0
        self.is_new_decision = False
        self._covered_deg = 0.0

    def add(
        self, levels: LevelArray, orientation_deg: float, *, earlier: Sequence[LevelArray] | None = None
    ) -> StopDecision:
        """Add the next frame and return the rule's last decision; `is_new_decision` says whether it is a new one."""
        if self._queries:
            self._covered_deg += min(self._apart_deg(orientation_deg), STEP_DEG)
        decisions = 1 + int(self._covered_deg / STEP_DEG + 1e-9)
        self.is_new_decision = decisions > self.decisions
        self.decisions = decisions
        before = self.decision if self.decisions > 1 or self._queries else None
        decision = super().add(levels, orientation_deg, earlier=earlier)
        if not self.is_new_decision and before is not None:
            self.decision = before
        return self.decision if before is not None else decision

    def _apart_deg(self, orientation_deg: float) -> float:
        return float(size_deg(self.belief.orientation_deg - orientation_deg).min())

    def _weight(self, orientation_deg: float) -> float | None:
        return frame_weight(self._apart_deg(orientation_deg)) if self._queries else None

    def _decide(self, belief: Belief, *, last: bool = False) -> StopDecision:
        return self.rule.decide(
            belief, max_views=min(self.decisions, DECISIONS) if last else DECISIONS, decisions=self.decisions
        )


@dataclass(frozen=True, eq=False)
class NextArc:
    """An arc, and what it was decided on; as `hbr.dense.next_view.NextBestView`."""

    rotation_deg: float
    pair: tuple[int, int] | None
    rotations_deg: FloatArray
    confusion: FloatArray
    cost: FloatArray


def next_arc(
    belief: Belief, *, beta: float, rotations_deg: FloatArray, seconds: FloatArray, second_costs: float = 1.0
) -> NextArc:
    """Choose the arc with the lowest sum of expected confusion and cost.

    All that is seen on the way counts: the exponents of `hbr.dense.next_view.next_best_view` are added up from here to
    the end of the arc, each with the weight of its frames.

    Parameters
    ----------
    rotations_deg
        Ends of the possible arcs, multiples of `STEP_DEG` to both sides, float64 (a,); the nearest ones included.
    seconds
        Time to each.
    """
    here_deg = float(belief.orientation_deg[-1])
    apart_deg = size_deg(here_deg + rotations_deg[:, None] - belief.orientation_deg).min(axis=1)
    new = np.minimum(apart_deg / STEP_DEG, 1.0) * STEP_WEIGHT
    probability, place, bin_of = strongest(belief.posterior(beta))
    cost = second_costs * seconds
    pairs = probability[:, None] * probability * (place[:, None] != place)
    confusion = np.zeros(len(rotations_deg))
    pair = None
    if pairs.any():
        similar, known = expected_similarity(belief, place, bin_of, rotations_deg)
        exponent = new[:, None, None] * np.sqrt(known[:, :, None] * known[:, None, :]) * (1 - similar)
    for side in (1.0, -1.0):
        way = np.flatnonzero(np.sign(rotations_deg) == side)
        way = way[np.argsort(np.abs(rotations_deg[way]))]
        if not len(way):
            continue
        if pairs.any():
            remaining = pairs * np.exp(-_SHARPNESS * np.cumsum(exponent[way], axis=0))
            confusion[way] = np.log(np.maximum(remaining.sum(axis=(1, 2)), 1e-300))
        else:  # one object alone: a new side helps to find its azimuth
            confusion[way] = -_SHARPNESS * np.cumsum(new[way])
    sums = np.where(np.abs(rotations_deg) >= LEAST_ARC_DEG, confusion + cost, np.inf)
    chosen = int((sums if np.isfinite(sums).any() else confusion + cost).argmin())
    if pairs.any():
        first, second = np.unravel_index(int(pairs.argmax()), pairs.shape)
        objects = belief.index.object_index
        pair = int(objects[place[first]]), int(objects[place[second]])
    return NextArc(float(rotations_deg[chosen]), pair, rotations_deg, confusion, cost)
