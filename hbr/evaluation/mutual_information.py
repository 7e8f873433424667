"""The rotation by mutual information: a baseline for the next best view, which only evaluations use."""

import numpy as np
from numpy.typing import ArrayLike

from hbr.dense.filter import BETA, Belief
from hbr.dense.index import POWER
from hbr.dense.next_view import ALL_ROTATIONS_DEG, expected_views, strongest


def most_informative_rotation(belief: Belief, *, beta: float = BETA, rotations_deg: ArrayLike | None = None) -> float:
    """Choose the rotation whose view is expected to leave the least entropy: a baseline for `hbr.next_best_view`.

    If hypothesis h is true, the view after a rotation is the one that was enrolled there. The likelihood of hypothesis
    h' is then exp(β T(view_h, view_h')^p).

    Parameters
    ----------
    belief, beta, rotations_deg
        As for `hbr.next_best_view`.
    """
    angles_deg = ALL_ROTATIONS_DEG if rotations_deg is None else np.asarray(rotations_deg, np.float64)
    probability, place, bin_of = strongest(belief.posterior(beta))
    rows, _ = expected_views(belief, place, bin_of, angles_deg)
    similar = belief.index.compared.among(rows)
    weights = probability * np.exp(beta / np.sqrt(belief.queries + 1) * (np.maximum(similar, 0) ** POWER - 1))
    weights /= weights.sum(axis=2, keepdims=True)
    objects = (place[:, None] == np.unique(place)).astype(np.float64)
    shares = weights @ objects
    entropy = -(shares * np.log(np.maximum(shares, 1e-300))).sum(axis=2)
    return float(angles_deg[int((entropy @ probability).argmin())])
