"""Margin of the best object over all enrolled objects, not only over those on the retrieval lists.

Decision: docs/decisions/0007.
"""

import numpy as np
from numpy.typing import ArrayLike

from hbr.core.arrays import LevelArray
from hbr.descriptors.tanimoto import tanimoto
from hbr.paper.hough import Ranking


def score_margin(ranking: Ranking, queries: LevelArray | ArrayLike) -> float:
    """Return the best object's score minus the largest score that any other enrolled object can have.

    A score is a sum of similarities minus a penalty that is never negative (Eq. 3). Therefore no path of an object j
    has a score above Σ_i max_k T(q_i, c_jk). `Ranking.margin` knows only the listed objects: if the many similar views
    of a round object fill all lists, its twin is on none of them, and that margin is the whole score.

    Parameters
    ----------
    ranking : Ranking
        A result of `hbr.retrieve`.
    queries : uint8 array (N, 144)
        The descriptors of that retrieval.

    Returns
    -------
    float
        Lower bound of the margin, in units of the score (at most N). Negative if another object may be the best one;
        the whole score if no other object has views.

    Raises
    ------
    ValueError
        The ranking has another number of queries.
    """
    levels = np.asarray(queries)
    if len(levels) != len(ranking.lists):
        raise ValueError(
            f"{len(levels)} queries for a ranking of {len(ranking.lists)}; pass the queries of that retrieval"
        )
    views = ranking.views
    others = np.setdiff1d(views.object_index, ranking.object_index[:1])
    best = float(ranking.scores[0])
    if not len(others):
        return best
    rows, begin = views.of_each(others)
    reach = np.zeros(len(others))
    for query in levels:  # one query at a time, so that a million views take 8 MB and not N times as much
        reach += np.maximum.reduceat(tanimoto(query, views.descriptors)[0][rows], begin)
    return best - float(reach.max())
