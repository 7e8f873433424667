"""One search by the dense filter: views in; belief, decision and next best view out.

Decision: docs/decisions/0054.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from hbr.core.arrays import LevelArray
from hbr.dense.filter import KEPT, Belief, completed, update_belief
from hbr.dense.index import DenseIndex
from hbr.dense.next_view import NextBestView, next_best_view
from hbr.dense.stopping import Outcome, StopDecision, StoppingRule

_WORTH_REDUCING: Final = 2


class DenseSession:
    """A search for one object, the same for the bench, for replay and for evaluation.

    Parameters
    ----------
    index : DenseIndex
        The enrolled views.
    rule : StoppingRule
        Decides when the search ends.
    max_views : int
        Views after which it ends in any case.

    Attributes
    ----------
    belief : Belief
        After at least one view.
    decision : StopDecision
        The rule's decision after the last view.
    """

    belief: Belief
    decision: StopDecision

    def __init__(self, index: DenseIndex, rule: StoppingRule, *, max_views: int = 8) -> None:
        self.rule = rule
        self.max_views = max_views
        # If a search ends after one or two views, an index of a part of the views costs more time than it saves.
        self._kept = KEPT if len(index) > _WORTH_REDUCING * KEPT else len(index)
        self._index = index
        self._so_far: DenseIndex | Belief = index
        self._queries: list[LevelArray] = []
        self._reliable = True
        self._same_bench: bool | None = None

    def add(
        self,
        levels: LevelArray,
        orientation_deg: float,
        *,
        earlier: Sequence[LevelArray] | None = None,
        reliable: bool = True,
        same_bench: bool | None = None,
    ) -> StopDecision:
        """Add the next view, as for `update_belief`, and return the rule's decision.

        Parameters
        ----------
        levels : uint8 array (length,) or (h, length)
            The view; a row for each of several segmentations.
        orientation_deg : float
            Orientation of the camera around the object, from any zero that all views share.
        earlier : sequence of uint8 arrays, optional
            New descriptions of the earlier views, because they were segmented again, and better.
        reliable : bool
            Whether the views were segmented reliably (`hbr.ViewsTogether.reliable`). If not, the search does not end
            while it may take more views.
        same_bench : bool, optional
            Whether the bench is that of the enrollment; None: not known.
        """
        self._reliable, self._same_bench = reliable, same_bench
        if earlier is not None:
            self._replace(earlier)
        self._extend(levels, orientation_deg)
        self.decision = self._decide(self.belief)
        if self.decision.outcome is not Outcome.CONTINUE:
            self._complete()
        return self.decision

    def _extend(self, levels: LevelArray, orientation_deg: float) -> None:
        """Add a view to the belief."""
        self._so_far = self.belief = update_belief(
            levels, orientation_deg, self._so_far, kept=self._kept, weight=self._weight(orientation_deg)
        )
        self._queries.append(levels)

    def _replace(self, queries: Sequence[LevelArray]) -> None:
        """Compute the belief again from other descriptions of the same views."""
        if len(queries) != len(self._queries):
            raise ValueError(f"{len(queries)} earlier views; the search has {len(self._queries)}")
        same = all(np.array_equal(a, b) for a, b in zip(queries, self._queries, strict=True))
        if same or not queries:
            return
        orientations_deg = self.belief.orientation_deg.tolist()
        self._so_far, self._queries = self._index, []
        for query, orientation_deg in zip(queries, orientations_deg, strict=True):
            self._extend(query, orientation_deg)

    def next_best_view(self, rotations_deg: ArrayLike | None = None, seconds: ArrayLike | None = None) -> NextBestView:
        """Return the rotation to the next best view, as `hbr.next_best_view` does."""
        return next_best_view(self.belief, beta=self.rule.beta, rotations_deg=rotations_deg, seconds=seconds)

    def end(self) -> StopDecision:
        """Return the decision with which the search ends here, even if the rule would continue."""
        if self.decision.outcome is Outcome.CONTINUE:
            self._complete()
            return self._decide(self.belief, last=True)
        return self.decision

    def _weight(self, orientation_deg: float) -> float | None:  # noqa: ARG002
        """Return the weight of the next view; None: 1."""
        return None

    def _decide(self, belief: Belief, *, last: bool = False) -> StopDecision:
        most = belief.queries if last else self.max_views
        return self.rule.decide(belief, max_views=most, reliable=self._reliable, same_bench=self._same_bench)

    def _complete(self) -> None:
        """Decide again before an end if an object that was left out after the first view can be first or second."""
        if len(self.belief.index) == len(self._index):
            return
        found = completed(self.belief, self._index, self._queries)
        if found is not self.belief:
            self._so_far = self.belief = found
            self.decision = self._decide(found)
