"""Searches in motion: every frame is evidence, and the search chooses arcs instead of single views.

Frames a few degrees apart show nearly the same. If the correlation of what they show falls off as exp(-d / L) with
their distance d, a frame adds the share 1 - exp(-2 d / L) of a new one (the part of a Markov process that the frame
before does not determine). With this weight, the evidence of an arc does not depend on the number of its frames.

The search decides as at rest (`hbr.dense.stopping`), each time the frames have covered another step of the circle.

Decision: docs/decisions/0019.
"""

from dataclasses import replace
from math import exp
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from hbr.core.angles import size_deg, wrap360
from hbr.core.arrays import FloatArray
from hbr.dense.filter import Belief
from hbr.dense.index import DenseIndex
from hbr.dense.next_view import SHARPNESS, NextBestView, log_confusion, pairs_after, strongest
from hbr.dense.session import MOST_CHANGES, DenseSession
from hbr.dense.stopping import Outcome, StopDecision, StopReason, decide

STEP_DEG: Final = 15.0
"""The search decides each time the frames have covered this much more of the circle."""
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
"""An object that is not found by the first frame is found by frames that are at least this far apart."""


def frame_weight(apart_deg: float) -> float:
    """Return the weight of a frame, 0..1, from its distance to the nearest earlier frame in degrees."""
    return 1.0 - exp(-2.0 * max(apart_deg, 0.0) / CORRELATION_DEG)


STEP_WEIGHT: Final = STEP_DEG / FRAME_DEG * frame_weight(FRAME_DEG)
"""Sum of the weights of the frames between two decisions."""


class ArcSession(DenseSession):
    """A search in motion."""

    _NEWEST = 4  # 60°: the frames of fewer steps are hardly enough evidence of a change

    def __init__(self, index: DenseIndex, *, most_changes: int = MOST_CHANGES) -> None:
        super().__init__(index, max_views=DECISIONS, most_changes=most_changes)
        self.decisions = 0
        """Number of decisions so far; the first view is the first one."""
        self._covered_deg = 0.0

    def _forget(self) -> None:
        super()._forget()
        self.decisions, self._covered_deg = 0, 0.0

    def _begin_view(self, orientation_deg: float) -> None:
        if isinstance(self._so_far, Belief):
            self._covered_deg += min(self._apart_deg(orientation_deg), STEP_DEG)
        decisions = 1 + int(self._covered_deg / STEP_DEG + 1e-9)
        self.is_new_decision = decisions > self.decisions
        self.decisions = decisions

    def _apart_deg(self, orientation_deg: float) -> float:
        return float(size_deg(self.belief.orientation_deg - orientation_deg).min())

    def next_best_view(self, rotations_deg: ArrayLike | None = None, seconds: ArrayLike | None = None) -> NextBestView:
        """Return the rotation along the most informative arc, as `next_arc` does; rotations and times are needed."""
        ends_deg, times_s = np.asarray(rotations_deg, np.float64), np.asarray(seconds, np.float64)
        return next_arc(self.belief, rotations_deg=ends_deg, seconds=times_s)

    def _weight(self, orientation_deg: float) -> float | None:
        return frame_weight(self._apart_deg(orientation_deg)) if isinstance(self._so_far, Belief) else None

    def _decide(self, *, last: bool = False) -> StopDecision:
        last = last or self.decisions >= DECISIONS
        decision = decide(self.belief, last=last, reliable=self._reliable, other_bench=self._other_bench)
        is_near = self.belief.queries > 1 and self.decisions <= SIDE_DEG / STEP_DEG
        if decision.outcome is Outcome.FOUND and is_near and not last:
            # frames this near show the same side: an object that is not found by the first one needs another side
            return replace(decision, outcome=Outcome.CONTINUE, reason=StopReason.NOT_CONFIDENT)
        return decision

    def _is_worth_a_fit(self) -> bool:
        return False  # frames in motion are smeared, and mostly segmented only once


def next_arc(belief: Belief, *, rotations_deg: FloatArray, seconds: FloatArray) -> NextBestView:
    """Choose the arc with the lowest sum of expected confusion and cost.

    All frames on the way count: the exponents of `hbr.dense.next_view.next_best_view` are added up from the last view
    to the end of the arc, each with the weight of its frames.
    """
    here_deg = float(belief.orientation_deg[-1])
    apart_deg = size_deg(here_deg + rotations_deg[:, None] - belief.orientation_deg).min(axis=1)
    new = np.minimum(apart_deg / STEP_DEG, 1.0) * STEP_WEIGHT
    pairs = pairs_after(belief, rotations_deg, strongest(belief.posterior))
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
            confusion[way] = log_confusion(2 * remaining.sum(axis=1))
    sums = np.where(np.abs(rotations_deg) >= LEAST_ARC_DEG, confusion + seconds, np.inf)
    chosen = int((sums if np.isfinite(sums).any() else confusion + seconds).argmin())
    rotation_deg = float(rotations_deg[chosen])
    pair = None if is_one else pairs.named(int(pairs.probability.argmax()))
    return NextBestView(rotation_deg, wrap360(here_deg + rotation_deg), pair, rotations_deg, confusion, seconds, None)
