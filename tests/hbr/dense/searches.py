"""Searches of several views, one after the other."""

from collections.abc import Iterable

from hbr import Belief, DenseIndex, update_belief


def belief_after(queries: Iterable, orientation_deg: Iterable[float], index: DenseIndex) -> Belief:
    """Return the belief after all these queries, in their order."""
    belief: DenseIndex | Belief = index
    for query, angle_deg in zip(queries, orientation_deg, strict=True):
        belief = update_belief(query, float(angle_deg), belief)
    return belief
