"""How safely the best object leads: over all enrolled objects, not only over those on the retrieval lists."""

import numpy as np
from numpy.typing import ArrayLike

from hbr.core.arrays import LevelArray
from hbr.descriptors.tanimoto import tanimoto
from hbr.paper.hough import Ranking


def score_margin(ranking: Ranking, queries: LevelArray | ArrayLike) -> float:
    """Return by how much the best object's score exceeds whatever score any other enrolled object can have.

    A score is a sum of similarities less a penalty that is never negative (Eq. 3), so no path of an object j scores
    above Σ_i max_k T(q_i, c_jk). The margin of a `Ranking` counts listed objects alone: where the many alike views of a
    round object fill the lists, its twin stands on none, and the margin is the whole score.

    Parameters
    ----------
    ranking : Ranking
        As `hbr.retrieve` returned it.
    queries : uint8 array (N, 144)
        The descriptors it was made from.

    Returns
    -------
    float
        Lower bound of the lead, in units of the score (at most N); negative where another object may well be the best.
        The whole score where no other object has views.

    Raises
    ------
    ValueError
        The number of queries is not the ranking's.
    """
    levels = np.asarray(queries)
    if len(levels) != len(ranking.lists):
        raise ValueError(f"{len(levels)} queries for a ranking of {len(ranking.lists)}; pass those it was made from")
    views = ranking.views
    others = np.setdiff1d(views.object_index, ranking.object_index[:1])
    best = float(ranking.scores[0])
    if not len(others):
        return best
    rows, begin = views.of_each(others)
    reach = np.zeros(len(others))
    for query in levels:  # one at a time: a million views take 8 MB, not N times as much
        reach += np.maximum.reduceat(tanimoto(query, views.descriptors)[0][rows], begin)
    return best - float(reach.max())
