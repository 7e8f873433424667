"""When a search by the dense filter ends, and when an object is unknown: at error rates that were measured.

The catalog itself is the sample: each of its views is looked for as if it were not enrolled, and once more as if its
whole object were not.
"""

from dataclasses import dataclass
from math import ceil, floor, inf
from typing import Final, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hbr.arrays import FloatArray, LevelArray
from hbr.dense import Belief, DenseIndex, believe

#: What the lead over the second object counts beside the score.
LEAD: Final = 0.5
#: The views of a rehearsed search are this far apart.
_STEP_DEG: Final = 90.0


@dataclass(frozen=True, eq=False)
class Rehearsal:
    """Searches for every object, by its own enrolled views; arrays of (searches, views).

    Attributes
    ----------
    known : float64 array
        Familiarity (`familiarity`), its own object among the enrolled ones.
    stranger : float64 array
        Familiarity, had its own object not been enrolled.
    posterior : float64 array
        Probability of the best object.
    correct : bool array
        Whether that is its own.
    beta : float
        As for `Belief.posterior`.
    """

    known: FloatArray
    stranger: FloatArray
    posterior: FloatArray
    correct: NDArray[np.bool_]
    beta: float


@dataclass(frozen=True)
class Rules:
    """When to stop and what to call unknown.

    Attributes
    ----------
    beta : float
        As for `Belief.posterior`.
    certainty : float
        Probability of the best object that ends a search; above 1 where no search may end early.
    familiar : tuple of float
        Familiarity after 1, 2, ... views below which the object is unknown; the last holds for all further views. -inf
        where nothing may be called unknown.
    error_rate, false_reject : float
        What was asked for: wrong objects among those named, and enrolled objects called unknown.
    false_accept : float
        Strangers that were not called unknown after the last of these numbers of views, when objects were left out.
    searches : int
        Rehearsed searches that these come from.
    promises : tuple of str
        What cannot be promised, and how much more data it takes; empty where all can.
    """

    beta: float
    certainty: float
    familiar: tuple[float, ...]
    error_rate: float
    false_reject: float
    false_accept: float
    searches: int
    promises: tuple[str, ...] = ()


@dataclass(frozen=True)
class Verdict:
    """What to do after a view.

    Attributes
    ----------
    kind : {"look", "found", "unknown"}
        Look on, or end.
    object_index : int
        The best object, whatever the kind.
    probability, familiarity : float
        Its probability among the enrolled objects, and how much it looks like one of them.
    words : str
        The reason, for people.
    """

    kind: Literal["look", "found", "unknown"]
    object_index: int
    probability: float
    familiarity: float
    words: str


def rehearse(
    index: DenseIndex, *, beta: float, views: int = 4, seen: LevelArray | None = None, searches: int = 4
) -> Rehearsal:
    """Look for every object by its own enrolled views, a quarter of a turn apart, with those views left out.

    Parameters
    ----------
    index : DenseIndex
        Of at least two objects. Objects with fewer than ``views + 1`` views are not looked for.
    beta : float
        As for `Belief.posterior`.
    views : int
        Views of a search.
    seen : uint8 array (n, length), optional
        Each enrolled view as a search would see it: from a second sitting, or described once more under the bench's
        noise and blur. The enrolled views themselves otherwise.
    searches : int
        Of each object, from first views spread around it.

    Raises
    ------
    ValueError
        There are fewer than two objects, or none with enough views.
    """
    if len(index) < 2:
        raise ValueError(f"{len(index)} object; at least two are needed to learn what a stranger looks like")
    levels = index.views.descriptors if seen is None else seen
    if levels.shape != index.views.descriptors.shape:
        raise ValueError(f"seen has shape {levels.shape}; the catalog's views have {index.views.descriptors.shape}")
    known, stranger, posterior, correct = [], [], [], []
    for place, object_index in enumerate(index.object_index.tolist()):
        rows = index.views.of(object_index)
        azimuth_deg = index.views.azimuth_deg[rows]
        if len(rows) <= views:
            continue
        for start in np.unique(np.arange(searches) * len(rows) // searches).tolist():
            queries = _spread(azimuth_deg, start, views)
            without = index.without(rows[queries])
            so_far: DenseIndex | Belief = without
            for i in queries:
                so_far = belief = believe(levels[rows[i]], float(azimuth_deg[i]), so_far, kept=len(index))
                scores, odds = belief.scores(), belief.posterior(beta).sum(axis=1)
                known.append(familiarity(scores))
                stranger.append(familiarity(np.delete(scores, place)))
                posterior.append(odds.max())
                correct.append(odds.argmax() == place)
    if not known:
        raise ValueError(f"no object has more than {views} views; enroll more of each, or rehearse fewer views")
    shape = -1, views
    return Rehearsal(
        np.reshape(known, shape),
        np.reshape(stranger, shape),
        np.reshape(posterior, shape),
        np.reshape(correct, shape),
        beta,
    )


def familiarity(scores: FloatArray) -> float:
    """Return how much a search looks like one for an enrolled object, of the scores of all objects that are considered.

    The best score, and half of its lead over the second: a stranger is a little like several objects, a known object
    much like one.
    """
    best = float(scores.max())
    return best + LEAD * (best - float(np.partition(scores, -2)[-2])) if len(scores) > 1 else best


def conformal_threshold(scores: ArrayLike, false_reject: float) -> float:
    """Return the score below which no more than this share of further scores of the same kind fall.

    The ⌊α(n + 1)⌋-th smallest of n scores; -inf where n is too small for any: fewer than 1/α - 1. The promise holds on
    average for scores that are exchangeable with these, whatever their distribution.

    Source: V. Vovk, A. Gammerman and G. Shafer, "Algorithmic Learning in a Random World", Springer 2005.

    Raises
    ------
    ValueError
        The share is not between 0 and 1, or a score is not finite.
    """
    ordered = np.sort(np.asarray(scores, np.float64).ravel())
    if not 0 < false_reject < 1:
        raise ValueError(f"false_reject is {false_reject}; a share between 0 and 1 is needed, e.g. 0.02")
    if not np.isfinite(ordered).all():
        raise ValueError("a score is not finite; leave such searches out")
    place = floor(false_reject * (len(ordered) + 1) + 1e-9)
    return float(ordered[place - 1]) if place else -inf


def certainty_for(posterior: FloatArray, correct: NDArray[np.bool_], error_rate: float) -> float:
    """Return the smallest probability that ends searches with no more than this share of wrong ones.

    A search, a row, ends at the first view whose best object has at least this probability; those that never reach it
    end at the last view and do not count. Counted with one error more than there were, so that few searches promise
    little: below ``1 / error_rate`` of them the result is above 1, and no search ends early.
    """
    for certainty in np.unique(np.concatenate([[0.5], posterior[posterior > 0.5]])).tolist():
        ends = posterior >= certainty
        at = np.flatnonzero(ends.any(axis=1))
        wrong = int((~correct[at, ends[at].argmax(axis=1)]).sum())
        if len(at) and (wrong + 1) / (len(at) + 1) <= error_rate:
            return float(certainty)
    return inf


def rules(rehearsal: Rehearsal, *, error_rate: float = 0.01, false_reject: float = 0.02) -> Rules:
    """Find the rules that keep the stated error rates in the rehearsed searches."""
    searches, views = rehearsal.known.shape
    familiar = tuple(conformal_threshold(rehearsal.known[:, n], false_reject) for n in range(views))
    certainty = certainty_for(rehearsal.posterior, rehearsal.correct, error_rate)
    promises = []
    if familiar[-1] == -inf:
        promises.append(
            f"{searches} rehearsed searches are too few for a false-reject rate of {false_reject:.1%}: nothing will be "
            f"called unknown; {ceil(1 / false_reject) - 1} are needed"
        )
    if certainty > 1:
        promises.append(
            f"{searches} rehearsed searches cannot show an error rate of {error_rate:.2%}: no search ends early; at "
            f"least {ceil(1 / error_rate)} are needed, and objects that can be told apart"
        )
    accepted = float((rehearsal.stranger[:, -1] >= familiar[-1]).mean())
    return Rules(rehearsal.beta, certainty, familiar, error_rate, false_reject, accepted, searches, tuple(promises))


def judge(belief: Belief, by: Rules, *, max_views: int = 8) -> Verdict:
    """Say whether the search may end, and with what.

    An object is found when its probability reaches the rules' certainty and it is familiar; after the last view the
    best object is found if it is familiar, and otherwise unknown.
    """
    odds = belief.posterior(by.beta).sum(axis=1)
    best = int(odds.argmax())
    probability, known = float(odds[best]), familiarity(belief.scores())
    object_index = int(belief.index.object_index[best])
    name = belief.index.views.object_names[object_index]
    least = by.familiar[min(belief.queries, len(by.familiar)) - 1]
    says = f"{name} with a probability of {probability:.3f} and a familiarity of {known:.3f}"
    if known >= least and probability >= by.certainty:
        return Verdict("found", object_index, probability, known, f"{says}: sure enough")
    if belief.queries < max_views:
        reason = "not sure yet" if known >= least else f"below {least:.3f}, which enrolled objects reach"
        return Verdict("look", object_index, probability, known, f"{says}: {reason}")
    if known >= least:
        return Verdict("found", object_index, probability, known, f"{says}: the best after {max_views} views")
    return Verdict("unknown", object_index, probability, known, f"{says}: below {least:.3f}, so none of those enrolled")


def _spread(azimuth_deg: FloatArray, start: int, count: int) -> list[int]:
    """Indices of so many different views, a step apart, the first at `start`."""
    chosen = [start]
    for n in range(1, count):
        away = np.abs((azimuth_deg - azimuth_deg[start] - n * _STEP_DEG + 180) % 360 - 180)
        away[chosen] = np.inf
        chosen.append(int(away.argmin()))
    return chosen
