"""A hidden Markov model over poses: the successor of the paper's voting, and its next view.

Source: L. Czúni and A. M. Nagy, Signal, Image and Video Processing 2020, doi 10.1007/s11760-020-01743-y. Its open
abstract and introduction say: each object is a hidden Markov model whose states are poses, the IMU's rotation gives the
transition probabilities, and the next view has the least risk of misclassification. The rest is ours: the emission from
the Tanimoto similarity, the distribution around the measured rotation, the risk as the expected probability of all
other objects, and the choice among rotations whose risks hardly differ.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from hbr.core.angles import wrap180
from hbr.core.arrays import FloatArray, IndexArray
from hbr.descriptors import Comparison
from hbr.model.views import Views

#: An emission is proportional to exp(similarity / TEMPERATURE).
TEMPERATURE: Final = 0.02
#: Standard deviation of a measured rotation: the difference of two orientations with errors of 2° each.
SIGMA_DEG: Final = 2 * 2**0.5
#: Probability of an object that ends a search.
CONFIDENT: Final = 0.98
#: Likeliest states that the next view distinguishes.
_STATES: Final = 32
#: Rotations that the next view weighs, and the smallest distance from the views so far, as in `hbr.paper.next_view`.
_ROTATIONS_DEG: Final = np.arange(-175.0, 185.0, 5.0)
_REVISIT_DEG: Final = 10.0
_LEAST: Final = 1e-300  # of the largest state of an object: a smaller one could only matter after dozens of views


class PoseModel:
    """The enrolled views as states: a hidden Markov model for each object, whose states are its views.

    Parameters
    ----------
    views : Views
        The enrolled views.
    sigma_deg : float
        Standard deviation of a measured rotation, in degrees.
    temperature : float
        Scale of the similarities.

    Raises
    ------
    ValueError
        A setting is not above 0.
    """

    def __init__(self, views: Views, *, sigma_deg: float = SIGMA_DEG, temperature: float = TEMPERATURE) -> None:
        if not (0 < sigma_deg < np.inf and 0 < temperature < np.inf):
            raise ValueError(f"sigma_deg is {sigma_deg}, temperature {temperature}; both are above 0")
        self.views = views
        self.temperature = temperature
        self._concentration = 1 / np.deg2rad(sigma_deg) ** 2
        rows, start = views.by_object
        self.begin: IndexArray = start[:-1][np.diff(start) > 0]
        """Where each object with views begins, if the views of one object come after those of the other."""
        # Objects with equal azimuths share one transition.
        groups: dict[bytes, list[IndexArray]] = {}
        for own in np.split(rows, self.begin[1:]) if len(rows) else ():
            groups.setdefault(views.azimuth_deg[own].tobytes(), []).append(own)
        self._groups = [np.stack(group) for group in groups.values()]

    @cached_property
    def compared(self) -> Comparison:
        """The views, prepared for comparison with queries and with each other."""
        return self.views.prepared()

    def first(self) -> FloatArray:
        """Return the logarithms of the states before the first query: all objects, and all poses of one, are alike."""
        log_state = np.empty(len(self.views))
        for rows in self._groups:
            log_state[rows] = -np.log(rows.shape[1])
        return log_state

    def moved(self, log_state: FloatArray, rotation_deg: float) -> FloatArray:
        """Return the logarithms of the states after a measured rotation of the camera.

        A pose moves to the poses around the rotation, by a von Mises distribution (the normal distribution of the
        circle) that is normalised over the object's enrolled poses.
        """
        after = np.empty_like(log_state)
        for rows in self._groups:
            azimuth = np.deg2rad(self.views.azimuth_deg[rows[0]])
            near = np.cos(azimuth - azimuth[:, None] - np.deg2rad(rotation_deg))
            transition = np.exp(self._concentration * (near - near.max(axis=1, keepdims=True)))
            transition /= transition.sum(axis=1, keepdims=True)
            own = log_state[rows]
            top = own.max(axis=1, keepdims=True)
            after[rows] = np.log(np.maximum(np.exp(own - top) @ transition, _LEAST)) + top
        return after


@dataclass(frozen=True, eq=False)
class RiskChoice:
    """The rotation to the next view, and all rotations that were weighed."""

    rotation_deg: float
    """Rotation of the camera around the object, positive to the left."""
    rotations_deg: FloatArray
    risk: FloatArray
    """float64 arrays (a,): the rotations that were weighed, and the expected risk of misclassification after each, 0 to
    1."""


@dataclass(frozen=True, eq=False)
class PoseBelief:
    """The probabilities of all enrolled poses of all objects at the last view."""

    model: PoseModel
    """The enrolled views. Each is a state of its object's model."""
    log_state: FloatArray
    """float64 array (n,): logarithm of the probability of each state: exp of all of them sums to 1."""
    orientation_deg: FloatArray
    """float64 array (N,): orientations of the queries, as passed."""

    def ranking(self) -> tuple[IndexArray, FloatArray, FloatArray]:
        """Return the objects with a view, likeliest first, the logarithms of their probabilities, and their poses."""
        views, begin = self.model.views, self.model.begin
        rows, _ = views.by_object
        log_object = np.logaddexp.reduceat(self.log_state[rows], begin)
        best = rows[np.lexsort((-self.log_state[rows], views.object_index[rows]))[begin]]
        order = np.argsort(-log_object, kind="stable")
        best = best[order]
        return views.object_index[best], log_object[order], views.azimuth_deg[best]

    def next_view(self, rotations_deg: ArrayLike = _ROTATIONS_DEG) -> RiskChoice:
        """Choose the rotation of the camera whose view has the least expected risk of misclassification.

        If state h is true, the view after a rotation is the enrolled one nearest to h's azimuth after it. The risk is
        the probability that this view then leaves to all objects but that of h, weighed by the probability of h. It is
        computed among the 32 likeliest states. Risks that exceed the least one by less than the error that ends a
        search allows (1 - CONFIDENT) are equal: of those rotations, the one farthest from all views so far is taken,
        then the smallest, then the one to the left.

        Parameters
        ----------
        rotations_deg : array (a,), optional
            The possible rotations, by default all, every 5°. Those that end within 10° of a view so far are not
            weighed, unless all do.
        """
        views, asked_deg = self.model.views, np.asarray(rotations_deg, np.float64)
        leading = np.argsort(-self.log_state, kind="stable")[:_STATES]
        weight = np.exp(self.log_state[leading] - self.log_state[leading[0]])
        weight /= weight.sum()
        to_deg = self.orientation_deg[-1] + asked_deg[:, None]
        away_deg = np.abs(wrap180(to_deg - self.orientation_deg)).min(axis=1)
        new = away_deg > _REVISIT_DEG
        if new.any():
            asked_deg, away_deg = asked_deg[new], away_deg[new]
        # The view that each state leads to after each rotation, (rotations, states).
        objects = views.object_index[leading]
        seen = np.empty((len(asked_deg), len(leading)), np.intp)
        for one in np.unique(objects).tolist():
            own, states = views.of(one), np.flatnonzero(objects == one)
            after_deg = asked_deg[:, None] + views.azimuth_deg[leading[states]]
            seen[:, states] = own[np.abs(wrap180(after_deg[:, :, None] - views.azimuth_deg[own])).argmin(axis=2)]
        # Rows are true states, columns the states that the view is compared with.
        evidence = self.model.compared.among(seen) / self.model.temperature
        posterior = weight * np.exp(evidence - evidence.max(axis=2, keepdims=True))
        posterior /= posterior.sum(axis=2, keepdims=True)
        risk = np.where(objects[:, None] != objects, posterior, 0.0).sum(axis=2) @ weight
        close = risk < risk.min() + (1 - CONFIDENT)
        order = np.lexsort((-asked_deg, np.abs(asked_deg), -np.round(away_deg, 9), ~close))
        return RiskChoice(float(asked_deg[order[0]]), asked_deg, risk)


def update_poses(similar: ArrayLike, orientation_deg: float, so_far: PoseModel | PoseBelief) -> PoseBelief:
    """Return the probabilities of all enrolled poses after the next query, by a step of the forward algorithm.

    Parameters
    ----------
    similar : array (n,)
        Similarity of the query to each enrolled view (`hbr.tanimoto`). A query has the likelihood
        exp(similarity / temperature).
    orientation_deg : float
        Orientation of the camera around the object, in degrees, from any zero that all queries share.
    so_far : PoseModel or PoseBelief
        The model before the first query, then the belief after the last one.

    Raises
    ------
    ValueError
        The shape does not fit, there are no views, or a value is not finite.
    """
    similar = np.asarray(similar, np.float64)
    model = so_far if isinstance(so_far, PoseModel) else so_far.model
    if not similar.size or similar.shape != (len(model.views),):
        raise ValueError(f"similarities of shape {similar.shape} for {len(model.views)} views")
    if not (np.isfinite(similar).all() and np.isfinite(orientation_deg)):
        raise ValueError("a similarity or an orientation is not a finite number")
    if isinstance(so_far, PoseModel):
        log_state, before = model.first(), np.empty(0)
    else:
        before = so_far.orientation_deg
        log_state = model.moved(so_far.log_state, orientation_deg - float(before[-1]))
    log_state += similar / model.temperature
    log_state -= np.logaddexp.reduce(log_state)
    return PoseBelief(model, log_state, np.append(before, orientation_deg))
