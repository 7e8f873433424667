"""One search by the dense filter: views in; belief, decision and next best view out. It reads no image itself.

When it ends, it takes two last steps. `DenseSession.verify` and `DenseSession.compare` ask for enrolled views
(`NeedEnrolledViews`) and compare them with the views, pixel by pixel. `DenseSession.end` is the decision after them.

Decisions: docs/decisions/0054, docs/decisions/0057, docs/decisions/0059, docs/decisions/0064.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from hbr.core.arrays import LevelArray
from hbr.dense.filter import KEPT, Belief, completed, update_belief
from hbr.dense.index import DenseIndex
from hbr.dense.last_steps import (
    FOUND_FROM,
    FOUND_FROM_SAME_BENCH,
    Asking,
    LeaderComparison,
    Queries,
    Verification,
    compare_leaders,
    is_doubtful,
    verify,
)
from hbr.dense.next_view import NextBestView, next_best_view
from hbr.dense.stopping import Outcome, StopDecision, StoppingRule
from hbr.descriptors.together import like_enrollment

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
        The rule's last decision: at rest, after the last view.
    present : StopDecision
        What the rule would decide after the last view, if it decided after each one.
    is_new_decision : bool
        Whether the last view led to a decision.
    verification : Verification, optional
        The verification of the leader after the last view, if there was one.
    comparison : LeaderComparison, optional
        The comparison of the two leaders after the last view, if there was one.
    """

    belief: Belief
    decision: StopDecision
    present: StopDecision
    is_new_decision = True
    verification: Verification | None = None
    comparison: LeaderComparison | None = None

    def __init__(self, index: DenseIndex, rule: StoppingRule, *, max_views: int = 8) -> None:
        self.rule = rule
        self.max_views = max_views
        # If a search ends after one or two views, an index of a part of the views costs more time than it saves.
        self._kept = KEPT if len(index) > _WORTH_REDUCING * KEPT else len(index)
        self._index = index
        self._so_far: DenseIndex | Belief = index
        self._reliable = True
        self._same_bench: bool | None = None
        self._like_enrollment: bool | None = None

    def add(
        self,
        levels: LevelArray,
        orientation_deg: float,
        *,
        earlier: Sequence[LevelArray] | None = None,
        reliable: bool = True,
        same_bench: bool | None = None,
        segmented_by: str | None = None,
    ) -> StopDecision:
        """Add the next view, as for `update_belief`, and return the rule's last decision.

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
        segmented_by : str, optional
            The `hbr.segmentation.Method` of the view. The rule considers the bench only with a method that segments
            like the enrollment (`hbr.descriptors.together.like_enrollment`).
        """
        self._reliable, self._same_bench = reliable, same_bench
        self._like_enrollment = same_bench if segmented_by is None else like_enrollment(segmented_by, same_bench)
        self.verification = self.comparison = None  # they were for the views before
        if earlier is not None:
            self._replace(earlier)
        self._begin_view(orientation_deg)
        self._extend(levels, orientation_deg)
        self.present = self._decide()
        if self.is_new_decision:
            self.decision = self.present
            if self.decision.outcome is not Outcome.CONTINUE:
                self._complete()
            self.present = self.decision
        return self.decision

    def _begin_view(self, orientation_deg: float) -> None:
        """Set ``is_new_decision`` for the next view."""

    def _extend(self, levels: LevelArray, orientation_deg: float) -> None:
        """Add a view to the belief."""
        self._so_far = self.belief = update_belief(
            levels, orientation_deg, self._so_far, kept=self._kept, weight=self._weight(orientation_deg)
        )

    def _replace(self, queries: Sequence[LevelArray]) -> None:
        """Compute the belief again from other descriptions of the same views."""
        before = self._so_far.levels if isinstance(self._so_far, Belief) else ()
        if len(queries) != len(before):
            raise ValueError(f"{len(queries)} earlier views; the search has {len(before)}")
        if all(np.array_equal(a, b) for a, b in zip(queries, before, strict=True)):
            return
        orientations_deg = self.belief.orientation_deg.tolist()
        self._so_far = self._index
        for query, orientation_deg in zip(queries, orientations_deg, strict=True):
            self._extend(query, orientation_deg)

    def next_best_view(self, rotations_deg: ArrayLike | None = None, seconds: ArrayLike | None = None) -> NextBestView:
        """Return the rotation to the next best view, as `hbr.next_best_view` does."""
        return next_best_view(self.belief, beta=self.rule.beta, rotations_deg=rotations_deg, seconds=seconds)

    def end(self) -> StopDecision:
        """Return the decision with which the search ends here, even if the rule would continue.

        The last steps that were taken after the last view count.
        """
        decision = self.decision
        if decision.outcome is Outcome.CONTINUE:
            self._complete()
            decision = self._decide(last=True)
        if self.verification is not None:
            decision = self.verification.decided(decision, self.found_from)
        return decision if self.comparison is None else self.comparison.decided(decision)

    @property
    def found_from(self) -> float:
        """Log-odds from which a verified leader is found."""
        return FOUND_FROM_SAME_BENCH if self._same_bench else FOUND_FROM

    @property
    def is_doubtful(self) -> bool:
        """Whether the search must verify its leader before it ends (`hbr.dense.last_steps.is_doubtful`)."""
        return is_doubtful(self.rule, self.end(), self.belief.queries, self.belief.index.views.descriptor)

    def verify(self, queries: Queries, measured: Verification | None = None) -> Asking[Verification | None]:
        """Verify a doubtful leader, pixel by pixel; None without doubt.

        A fit that was ``measured`` before is used instead of enrolled views.
        """
        self.verification = None
        if measured is None and self.is_doubtful:
            measured = yield from verify(self.belief, self.end().object_index, queries)
        self.verification = measured
        return measured

    def compare(self, queries: Queries) -> Asking[LeaderComparison | None]:
        """Compare the two leaders, pixel by pixel, if the search does not end with one object; else None."""
        self.comparison = None
        outcome, rule = self.end().outcome, self.rule
        self.comparison = yield from compare_leaders(
            self.belief, outcome, queries, beta=rule.beta, max_error=rule.error_rate
        )
        return self.comparison

    def _weight(self, orientation_deg: float) -> float | None:  # noqa: ARG002
        """Return the weight of the next view; None: 1."""
        return None

    def _decide(self, *, last: bool = False) -> StopDecision:
        return self._by_rule(self.belief, self.belief.queries if last else self.max_views)

    def _by_rule(self, belief: Belief, max_views: int) -> StopDecision:
        return self.rule.decide(belief, max_views=max_views, reliable=self._reliable, same_bench=self._like_enrollment)

    def _complete(self) -> None:
        """Decide again before an end if an object that was left out after the first view can be first or second."""
        if len(self.belief.index) == len(self._index):
            return
        found = completed(self.belief, self._index)
        if found is not self.belief:
            self._so_far = self.belief = found
            self.decision = self._decide()
