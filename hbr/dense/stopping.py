"""When a search by the dense filter ends, and when an object is unknown: at error rates that were measured.

The catalog itself is the sample: its views are looked for as if they had been taken a little aside, and once more as if
their whole object were not enrolled.
"""

from dataclasses import dataclass
from math import ceil, floor, inf
from typing import Final, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hbr.core.arrays import FloatArray, IndexArray, LevelArray
from hbr.dense.filter import BETA, BINS, Belief, DenseIndex

#: What the lead over the second object counts beside the score, and what its leader's usual score.
_LEAD: Final = 0.5
_USUAL: Final = 1.0
#: No search ends at a smaller probability, however well the rehearsed ones went: what stands there may be less clear.
LEAST_CERTAINTY: Final = 0.9
#: Rehearsed views lie aside by shares of a step that are spread over 0..1 as multiples of this.
_GOLDEN: Final = 0.618034
#: The views of a rehearsed search are this far apart.
_STEP_DEG: Final = 90.0


@dataclass(frozen=True, eq=False)
class Leaders:
    """Who led after each view of each search, arrays (searches, views).

    Attributes
    ----------
    object_index : integer array
        The best object.
    score, lead : float64 array
        Its score a view, and by how much that is above the second's.
    """

    object_index: IndexArray
    score: FloatArray
    lead: FloatArray

    def familiarity(self, usual: FloatArray) -> FloatArray:
        """Return how much each search looks like one for an enrolled object, (searches, views).

        The score and half of the lead: a stranger is a little like several objects, a known object much like one. Less
        what its leader usually scores above others: what looks the same from all sides must be met better.

        Parameters
        ----------
        usual : float64 array (objects, views)
            As `usual_scores` returns it.
        """
        views = np.arange(self.score.shape[1])
        typical = np.median(usual, axis=0)
        return self.score + _LEAD * self.lead - _USUAL * (usual[self.object_index, views] - typical)


@dataclass(frozen=True, eq=False)
class Rehearsal:
    """Searches for every object, by its own enrolled views; arrays of (searches, views).

    Attributes
    ----------
    objects : int
        Names in the model set.
    known : Leaders
        Among all enrolled objects.
    stranger : Leaders
        Had the object that was looked for not been enrolled.
    posterior : float64 array
        Probability of the best of all objects.
    correct : bool array
        Whether that is the one that was looked for.
    beta : float
        As for `Belief.posterior`.
    """

    objects: int
    known: Leaders
    stranger: Leaders
    posterior: FloatArray
    correct: NDArray[np.bool_]
    beta: float


@dataclass(frozen=True, eq=False)
class Rules:
    """When to stop and what to call unknown.

    Attributes
    ----------
    beta : float
        As for `Belief.posterior`.
    certainty : float
        Probability of the best object that ends a search; above 1 where no search may end early.
    usual : float64 array (objects, views)
        What each object scores when it is looked for, after 1, 2, ... views.
    familiar : tuple of float
        Familiarity (`Leaders.familiarity`) after 1, 2, ... views below which the object is unknown; the last holds for
        all further views. -inf where nothing may be called unknown.
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
    usual: FloatArray
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
    index: DenseIndex, *, beta: float = BETA, views: int = 4, seen: LevelArray | None = None, searches: int = 4
) -> Rehearsal:
    """Look for every object by its own enrolled views, a quarter of a turn apart, as if they had been taken aside.

    A view at the share u of a step from where it was enrolled would look less like itself by u times what its neighbour
    does. Real queries are half a step away at most; here u is spread over 0..1, for light and noise make views differ,
    too.

    Parameters
    ----------
    index : DenseIndex
        Of at least two objects. Objects with fewer than ``views`` views, or with a single one, are not looked for.
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
    aside = 0.0
    for place, object_index in enumerate(index.object_index.tolist()):
        rows = index.views.of(object_index)
        if len(rows) < max(views, 2):
            continue
        rows = rows[np.argsort(index.views.azimuth_deg[rows], kind="stable")]
        azimuth_deg = index.views.azimuth_deg[rows]
        similar = index.compared.similarity(levels[rows])
        for start in np.unique(np.arange(searches) * len(rows) // searches).tolist():
            queries = _spread(azimuth_deg, start, views)
            support = np.zeros((len(index), BINS), np.float32)
            for n, i in enumerate(queries):
                aside = (aside + _GOLDEN) % 1
                neighbour = rows[(i + (1 if n % 2 else -1)) % len(rows)]
                seen_so = similar[i].copy()
                seen_so[rows[i]] -= aside * (seen_so[rows[i]] - seen_so[neighbour])
                support += index.support(seen_so, float(azimuth_deg[i] - azimuth_deg[start]))
                belief = Belief(index, support, azimuth_deg[queries[: n + 1]])
                scores, odds = belief.scores(), belief.posterior(beta).sum(axis=1)
                known.append(_leader(index.object_index, scores))
                others = np.delete(index.object_index, place)
                stranger.append(_leader(others, np.delete(scores, place)))
                posterior.append(odds.max())
                correct.append(odds.argmax() == place)
    if not known:
        raise ValueError(f"no object has {max(views, 2)} views; enroll more of each, or rehearse fewer views")
    shape = -1, views
    return Rehearsal(
        len(index.views.object_names),
        _leaders(known, shape),
        _leaders(stranger, shape),
        np.reshape(posterior, shape),
        np.reshape(correct, shape),
        beta,
    )


def usual_scores(leaders: Leaders, correct: NDArray[np.bool_], objects: int) -> FloatArray:
    """Return the median score of each object in searches that found it, (objects, views); of others the typical one."""
    usual = np.full((objects, leaders.score.shape[1]), np.nan)
    for n in range(usual.shape[1]):
        for j in np.unique(leaders.object_index[correct[:, n], n]).tolist():
            usual[j, n] = np.median(leaders.score[correct[:, n] & (leaders.object_index[:, n] == j), n])
        found = usual[~np.isnan(usual[:, n]), n]
        usual[np.isnan(usual[:, n]), n] = np.median(found) if len(found) else 0.0
    return usual


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
    searches, views = rehearsal.posterior.shape
    usual = usual_scores(rehearsal.known, rehearsal.correct, rehearsal.objects)
    known, stranger = rehearsal.known.familiarity(usual), rehearsal.stranger.familiarity(usual)
    familiar = tuple(conformal_threshold(known[:, n], false_reject) for n in range(views))
    certainty = max(LEAST_CERTAINTY, certainty_for(rehearsal.posterior, rehearsal.correct, error_rate))
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
    accepted = float((stranger[:, -1] >= familiar[-1]).mean())
    return Rules(
        rehearsal.beta, certainty, usual, familiar, error_rate, false_reject, accepted, searches, tuple(promises)
    )


def judge(belief: Belief, by: Rules, *, max_views: int = 8) -> Verdict:
    """Say whether the search may end, and with what.

    An object is found when its probability reaches the rules' certainty and it is familiar; after the last view the
    best object is found if it is familiar, and otherwise unknown.
    """
    odds = belief.posterior(by.beta).sum(axis=1)
    best = int(odds.argmax())
    n = min(belief.queries, len(by.familiar)) - 1
    leaders = _leaders([_leader(belief.index.object_index, belief.scores())], (1, 1))
    probability, known = float(odds[best]), float(leaders.familiarity(by.usual[:, n : n + 1])[0, 0])
    object_index = int(belief.index.object_index[best])
    name = belief.index.views.object_names[object_index]
    least = by.familiar[n]
    says = f"{name} with a probability of {probability:.3f} and a familiarity of {known:.3f}"
    if known >= least and probability >= by.certainty:
        return Verdict("found", object_index, probability, known, f"{says}: sure enough")
    if belief.queries < max_views:
        reason = "not sure yet" if known >= least else f"below {least:.3f}, which enrolled objects reach"
        return Verdict("look", object_index, probability, known, f"{says}: {reason}")
    if known >= least:
        return Verdict("found", object_index, probability, known, f"{says}: the best after {max_views} views")
    return Verdict("unknown", object_index, probability, known, f"{says}: below {least:.3f}, so none of those enrolled")


def _leader(object_index: IndexArray, scores: FloatArray) -> tuple[int, float, float]:
    best = int(scores.argmax())
    lead = scores[best] - np.partition(scores, -2)[-2] if len(scores) > 1 else scores[best]
    return int(object_index[best]), float(scores[best]), float(lead)


def _leaders(found: list[tuple[int, float, float]], shape: tuple[int, int]) -> Leaders:
    objects, scores, leads = zip(*found, strict=True)
    return Leaders(np.reshape(objects, shape), np.reshape(scores, shape), np.reshape(leads, shape))


def _spread(azimuth_deg: FloatArray, start: int, count: int) -> list[int]:
    """Indices of so many different views, a step apart, the first at `start`."""
    chosen = [start]
    for n in range(1, count):
        away = np.abs((azimuth_deg - azimuth_deg[start] - n * _STEP_DEG + 180) % 360 - 180)
        away[chosen] = np.inf
        chosen.append(int(away.argmin()))
    return chosen
