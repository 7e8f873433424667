"""The steps with which a search at rest ends, as an evaluation takes them.

The bench takes the same two steps one by one, because each of them is an event (`rig.search.local_step`).

Decisions: docs/decisions/0057, docs/decisions/0059.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

from hbr.dense.filter import Belief
from hbr.dense.leaders import LeaderComparison, LeaderViews, compare_leaders
from hbr.dense.local_difference import LocalView
from hbr.dense.stopping import StopDecision, StoppingRule
from hbr.dense.verification import Verification, found_from, is_doubtful, verify


class LastSteps(NamedTuple):
    """The verification of a doubtful leader, the decision after it, and the comparison of the two leaders."""

    decision: StopDecision
    verification: Verification | None
    comparison: LeaderComparison | None


def last_steps(
    belief: Belief,
    decision: StopDecision,
    rule: StoppingRule,
    orientations_deg: Sequence[float],
    segmentations: Callable[[int], Sequence[LocalView]],
    leader_views: LeaderViews,
    *,
    same_bench: bool | None = None,
) -> LastSteps:
    """Verify a doubtful leader, and compare the two leaders of a search that names no object.

    Parameters
    ----------
    belief
        After the last view.
    decision, rule
        The decision with which the search would end, and the stopping rule.
    orientations_deg
        Orientation of each view of the search.
    segmentations
        Returns a view of the search by each of its segmentations, the likeliest first.
    leader_views
        Returns enrolled views.
    same_bench
        Whether the bench is that of the enrollment, for any segmentation of the views; None: not known.
    """
    verification = None
    if is_doubtful(rule, decision, belief.queries, belief.index.views.descriptor):
        verification = verify(belief, decision.object_index, segmentations, leader_views)
        decision = verification.decided(decision, found_from(same_bench))
    comparison = compare_leaders(
        belief,
        decision.outcome,
        orientations_deg,
        lambda n: segmentations(n)[0],
        leader_views,
        beta=rule.beta,
        max_error=rule.error_rate,
    )
    return LastSteps(decision, verification, comparison)
