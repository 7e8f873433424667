"""The test whether the object of a search changed: it was replaced, or rotated by hand, between two views.

A search adds up the evidence of all views for one object at one azimuth. The test compares this with another
explanation, that the newest views show another object, or the same object at another azimuth. The mean over all objects
and azimuths of exp(β A) is how well some views are explained by one of them. The evidence of a change is the logarithm
of the ratio of the two explanations (a Bayes factor, as for a change point):

    log mean exp(β A_before) + log mean exp(β A_newest) - log mean exp(β A_all)

An object that is not enrolled resembles another enrolled object from each side, which looks a little like a change.
Therefore more evidence is needed if no enrolled object fits the views before closely. For the same reason the mean is
over at least 100 objects.

The thresholds were chosen on searches of eight views for objects 1-50 of COIL-100: with 95 % confidence, at most 0.5 %
of the searches for an object that stays begin again. Rates: docs/results.md.

Source: R. P. Adams and D. J. C. MacKay, "Bayesian online changepoint detection", 2007, arXiv:0710.3742.
"""

from collections.abc import Collection, Iterable
from math import log
from typing import Final, NamedTuple

import numpy as np

from hbr.dense.filter import BETA, Belief
from hbr.dense.index import BINS
from hbr.dense.space import Floats

#: Score of the best object from which the object before is known, and the evidence that is needed then.
# with a lower support or less evidence, unknown objects begin again more often
KNOWN_FROM: Final = 0.65
CHANGED_FROM_KNOWN: Final = 2.0
CHANGED_FROM: Final = 6.0
#: So much more evidence is needed for each further view before, because their misfits to the enrolled views add up.
MORE_PER_VIEW: Final = 1.0
#: So much less evidence is needed if the table moved without a command before the view.
DISTURBED: Final = 2.0  # more: more changes are noticed at once, and more searches begin again wrongly
#: The mean is over at least this number of objects.
_LEAST_OBJECTS: Final = 100


class Change(NamedTuple):
    """The object changed before the view with the number ``first``, counted from the first view of the search.

    ``evidence`` is the logarithm of the likelihood ratio, and ``needed`` the evidence from which the search begins
    again.
    """

    first: int
    evidence: float
    needed: float


def changed(belief: Belief, before: Iterable[Belief], *, disturbed: Collection[int] = ()) -> Change | None:
    """Return the likeliest change, or None if the views show one object.

    Parameters
    ----------
    belief : Belief
        After all views.
    before : iterable of Belief
        Earlier beliefs of the same search, after each of which the object may have changed.
    disturbed : collection of int
        The views, from 0, before which the table moved without a command.
    """
    found: list[Change] = []
    objects = max(len(belief.index.views.object_names), _LEAST_OBJECTS)
    of_all = _log_sum(belief.support)
    for one in before:
        if one.index is not belief.index:  # an object was added that the first view had left out
            continue
        apart = _log_sum(one.support) + _log_sum(belief.support - one.support)
        known = float(one.scores().max()) >= KNOWN_FROM
        needed = (CHANGED_FROM_KNOWN if known else CHANGED_FROM) + MORE_PER_VIEW * (one.amount - 1)
        if one.queries in disturbed:
            needed -= DISTURBED
        evidence = apart - of_all - log(objects * BINS)
        if evidence >= needed:
            found.append(Change(one.queries, evidence, needed))
    return max(found, key=lambda change: change.evidence, default=None)


def _log_sum(support: Floats) -> float:
    exponents = BETA * support.astype(np.float64)
    most = float(exponents.max())
    return most + log(float(np.exp(exponents - most).sum()))
