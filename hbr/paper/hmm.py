"""A hidden Markov model over poses: the successor of the paper's voting, and its next view.

Source: L. Czúni and A. M. Nagy, Signal, Image and Video Processing 2020, doi 10.1007/s11760-020-01743-y. Its open
abstract and introduction say: each object is a hidden Markov model whose states are poses, the IMU's rotation gives the
transition probabilities, and the next view has the least risk of misclassification. The rest is ours: the emission from
the Tanimoto similarity, the normal distribution around the measured rotation, and the risk as the expected probability
of all other objects.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from hbr.core.angles import wrap180
from hbr.core.arrays import FloatArray, IndexArray
from hbr.descriptors.similarity import tanimoto
from hbr.model.views import Views

#: An emission is proportional to exp(similarity / TEMPERATURE).
TEMPERATURE: Final = 0.02
#: Standard deviation of a measured rotation: the difference of two orientations with errors of 2° each.
SIGMA_DEG: Final = 2 * 2**0.5
#: Likeliest states that the next view distinguishes.
_STATES: Final = 32
#: Rotations that the next view weighs, and the smallest distance from the views so far, as in `hbr.paper.next_view`.
_ROTATIONS_DEG: Final = np.arange(-175.0, 185.0, 5.0)
_REVISIT_DEG: Final = 10.0
_REVOLUTIONS: Final = 360.0 * np.arange(-2, 3)  # of the wrapped normal distribution: more change nothing up to 180°


@dataclass(frozen=True, eq=False)
class PoseBelief:
    """The probabilities of all enrolled poses of all objects at the last view.

    Attributes
    ----------
    views : Views
        The enrolled views. Each is a state of its object's model.
    log_state : float64 array (n,)
        Logarithm of the probability of each state: exp of all of them sums to 1.
    orientation_deg : float64 array (N,)
        Orientations of the queries, as passed.
    temperature : float
        That of the emissions.
    """

    views: Views
    log_state: FloatArray
    orientation_deg: FloatArray
    temperature: float

    def ranking(self) -> tuple[IndexArray, FloatArray, FloatArray]:
        """Return the objects with a view, likeliest first, the logarithms of their probabilities, and their poses."""
        rows, begin = _by_object(self.views)
        log_object = np.logaddexp.reduceat(self.log_state[rows], begin)
        best = np.array([part[np.argmax(self.log_state[part])] for part in np.split(rows, begin[1:])])
        order = np.argsort(-log_object, kind="stable")
        best = best[order]
        return self.views.object_index[best], log_object[order], self.views.azimuth_deg[best]

    def next_rotation_deg(self) -> float:
        """Return the rotation of the camera whose view has the least expected risk of misclassification.

        If state h is true, the view after a rotation is the enrolled one nearest to h's azimuth after it. The risk is
        the probability that this view then leaves to all objects but that of h, weighed by the probability of h. It is
        computed among the 32 likeliest states. Of rotations with equal risks, the smallest is taken, then the one to
        the left.
        """
        leading = np.argsort(-self.log_state, kind="stable")[:_STATES]
        weight = np.exp(self.log_state[leading] - self.log_state[leading[0]])
        weight /= weight.sum()
        objects = self.views.object_index[leading]
        to_deg = self.orientation_deg[-1] + _ROTATIONS_DEG
        new = (np.abs(wrap180(to_deg[:, None] - self.orientation_deg)) > _REVISIT_DEG).all(axis=1)
        rotations_deg = _ROTATIONS_DEG[new] if new.any() else _ROTATIONS_DEG
        # the view that each state leads to after each rotation, (states, rotations)
        seen = np.empty((len(leading), len(rotations_deg)), np.intp)
        for k, row in enumerate(leading.tolist()):
            own = self.views.of(int(self.views.object_index[row]))
            after_deg = self.views.azimuth_deg[row] + rotations_deg
            seen[k] = own[np.abs(wrap180(self.views.azimuth_deg[own][:, None] - after_deg)).argmin(axis=0)]
        rows, place = np.unique(seen, return_inverse=True)
        place = place.reshape(seen.shape)
        levels = self.views.levels(rows)
        similar = tanimoto(levels, levels)
        other = objects[:, None] != objects
        risks = []
        for at in place.T:
            posterior = weight * np.exp((similar[np.ix_(at, at)] - 1) / self.temperature)
            posterior /= posterior.sum(axis=1, keepdims=True)
            risks.append(float(weight @ (posterior * other).sum(axis=1)))
        order = np.lexsort((-rotations_deg, np.abs(rotations_deg), np.round(risks, 12)))
        return float(rotations_deg[order[0]])


def pose_belief(
    similar: ArrayLike,
    orientation_deg: ArrayLike,
    views: Views,
    *,
    sigma_deg: float = SIGMA_DEG,
    temperature: float = TEMPERATURE,
) -> PoseBelief:
    """Return the probabilities of all enrolled poses after all queries so far, by the forward algorithm.

    All objects are equally likely before the first query, and so are all poses of an object. From one query to the
    next, a pose moves to the poses around the measured rotation, by a normal distribution that is wrapped around the
    circle and normalised over the object's enrolled poses. A query has the likelihood exp(T / temperature).

    Parameters
    ----------
    similar : array (N, n)
        Similarity of each query to each enrolled view (`hbr.tanimoto`). N is at least 1.
    orientation_deg : array (N,)
        Orientation of the camera around the object at each query, in degrees, with any zero.
    views : Views
        The enrolled views.
    sigma_deg : float
        Standard deviation of a measured rotation, in degrees.
    temperature : float
        Scale of the similarities.

    Raises
    ------
    ValueError
        A shape does not fit, a value is not finite, or a setting is not above 0.
    """
    similar, orientation = np.asarray(similar, np.float64), np.array(orientation_deg, np.float64)
    if similar.ndim != 2 or not similar.size or similar.shape != (len(orientation), len(views)):
        raise ValueError(f"similarities of shape {similar.shape} for {len(orientation)} queries and {len(views)} views")
    if not (np.isfinite(similar).all() and np.isfinite(orientation).all()):
        raise ValueError("a similarity or an orientation is not a finite number")
    if not (0 < sigma_deg < np.inf and 0 < temperature < np.inf):
        raise ValueError(f"sigma_deg is {sigma_deg}, temperature {temperature}; both are above 0")
    groups = _equal_azimuths(views)
    log_state = np.empty(len(views))
    for rows in groups:
        log_state[rows] = -np.log(rows.shape[1])
    log_state += similar[0] / temperature
    for i in range(1, len(orientation)):
        rotation_deg = float(orientation[i] - orientation[i - 1])
        for rows in groups:
            moved = _transition(views.azimuth_deg[rows[0]], rotation_deg, sigma_deg)
            log_state[rows] = _moved(log_state[rows], moved)
        log_state += similar[i] / temperature
    log_state -= np.logaddexp.reduce(log_state)
    return PoseBelief(views, log_state, orientation, temperature)


def _by_object(views: Views) -> tuple[IndexArray, IndexArray]:
    """Return the indices of all views, one object after the other, and where each object with views begins."""
    rows, start = views.by_object
    return rows, start[:-1][np.diff(start) > 0]


def _equal_azimuths(views: Views) -> list[IndexArray]:
    """Return the views of the objects with equal azimuths together, (objects, states): they share one transition."""
    rows, begin = _by_object(views)
    groups: dict[bytes, list[IndexArray]] = {}
    for own in np.split(rows, begin[1:]):
        groups.setdefault(views.azimuth_deg[own].tobytes(), []).append(own)
    return [np.stack(group) for group in groups.values()]


def _transition(azimuth_deg: FloatArray, rotation_deg: float, sigma_deg: float) -> FloatArray:
    """Return the logarithm of the probability of each pose (column) after a rotation from each pose (row)."""
    off_deg = wrap180(azimuth_deg - azimuth_deg[:, None] - rotation_deg)
    density = np.logaddexp.reduce(-0.5 * ((off_deg[:, :, None] + _REVOLUTIONS) / sigma_deg) ** 2, axis=2)
    normalised: FloatArray = density - np.logaddexp.reduce(density, axis=1, keepdims=True)
    return normalised


def _moved(log_state: FloatArray, log_transition: FloatArray) -> FloatArray:
    """Return the logarithms of the states (objects, states) after a transition.

    The sums are those of scaled values, which is exact: what is lost is below 1e-300 of an object's largest state. If
    all of a sum is lost, it is computed from the logarithms.
    """
    top = log_state.max(axis=1, keepdims=True)
    with np.errstate(divide="ignore"):
        moved: FloatArray = np.log(np.exp(log_state - top) @ np.exp(log_transition)) + top
    for at in np.flatnonzero(~np.isfinite(moved).all(axis=1)).tolist():
        moved[at] = np.logaddexp.reduce(log_state[at][:, None] + log_transition, axis=0)
    return moved
