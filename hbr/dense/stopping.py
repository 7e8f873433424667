"""The posterior of a search over the enrolled objects and "not enrolled", and the decision that follows from it.

The numbers of `hbr.dense.evidence` give the log-odds that the leading candidate is the object on the table, by a
logistic model for each number of views. The pixel by pixel fit of the leader is one more number. What is left is the
probability that the object is not enrolled. `Belief` divides the rest among the enrolled objects.

The weights (``evidence.json``) are the same for all catalogs. They were fitted to objects 1-50 of COIL-100, after hard
changes of a drawn bench and in the photographs as they are, with and without Gaussian noise, and with half of the
searches for objects that are not enrolled. `python -m benchmarks.fit_search` does such a fit. Measured rates:
docs/results.md.

Decision: docs/decisions/0015.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from functools import cache
from importlib.resources import files
from math import exp
from typing import Any, Final

import numpy as np

from hbr.core.arrays import FloatArray
from hbr.dense.evidence import COMMON, numbers
from hbr.dense.filter import Belief
from hbr.dense.local_difference import PixelFit

WEIGHTS: Final = "evidence.json"
#: Probability of the leading candidate that ends a search, and that is enough after its last view.
# lower: fewer views, and more objects that are not enrolled are found
MIN_CONFIDENCE: Final = 0.97
LAST_CONFIDENCE: Final = 0.9
#: Probability of "not enrolled" that ends a search before its last view: no pixel by pixel fit would change it.
HOPELESS: Final = 0.998
#: After the last view, an object is unknown from this probability on, and otherwise ambiguous.
UNKNOWN_FROM: Final = 0.8
#: Added to the log-odds on another bench than that of the enrollment. Another bench makes an enrolled object less
#: similar. The weights hold for all conditions together, so they underrate the object there.
_OTHER_BENCH: Final = 1.5  # measured between 1 and 2 after hard changes, on objects 1-50 of COIL-100
#: Share of wrong objects among those that a comparison of two leaders names.
ERROR_RATE: Final = 0.01


class Outcome(StrEnum):
    """What a search does after a view: continue, or end with one of three answers."""

    CONTINUE = "continue"
    FOUND = "found"
    AMBIGUOUS = "ambiguous"
    UNKNOWN = "unknown"


class StopReason(StrEnum):
    """The reason why a search continues or ends."""

    CONFIDENT = "confident"
    NOT_CONFIDENT = "not-confident"
    NOT_ENROLLED = "not-enrolled"
    BADLY_SEGMENTED = "badly-segmented"
    MARGIN = "margin"
    MAX_VIEWS = "max-views"
    NO_ROTATION_LEFT = "no-rotation-left"
    LOCAL_DIFFERENCE = "local-difference"
    CUSTOM = "custom"


@dataclass(frozen=True, slots=True)
class StopDecision:
    """The decision after a view, and the probabilities that it follows from.

    Attributes
    ----------
    outcome, reason
        What to do, and why.
    object_index : int
        The leading candidate, for every outcome.
    probability : float
        That it is the object on the table.
    not_enrolled : float
        Probability that the object on the table is not enrolled.
    min_confidence : float
        Probability that ends a search.
    """

    outcome: Outcome
    reason: StopReason
    object_index: int
    probability: float
    not_enrolled: float
    min_confidence: float


def posterior(belief: Belief, fit: PixelFit | None = None, *, other_bench: bool = False) -> tuple[FloatArray, float]:
    """Return the probability of every object considered, (k,), and that the object is not enrolled; the sum is 1.

    A ``fit`` of the leading candidate, pixel by pixel, is one more number; ``other_bench`` says that the bench is
    certainly not that of the enrollment.
    """
    among = belief.probability()
    odds = log_odds(belief, int(among.argmax()), fit) + (_OTHER_BENCH if other_bench else 0.0)
    enrolled = 1 / (1 + exp(-min(max(odds, -_MOST_ODDS), _MOST_ODDS)))
    return among * enrolled, 1 - enrolled


def log_odds(belief: Belief, leader: int, fit: PixelFit | None = None) -> float:
    """Return the log-odds that the object at a place of the belief's index is on the table."""
    found = numbers(belief, leader)
    model = _models().get(belief.index.views.descriptor)
    if model is None:  # no model of these parts: only the numbers of all parts together
        found, model = found[:COMMON], _models()[""]
    return model.log_odds(found, belief.amount, fit)


def decide(
    belief: Belief, *, last: bool, reliable: bool = True, fit: PixelFit | None = None, other_bench: bool = False
) -> StopDecision:
    """Decide whether a search ends after these views.

    An object is found if its probability reaches `MIN_CONFIDENCE`, after the last view `LAST_CONFIDENCE`. An object
    that is hardly enrolled ends the search as unknown. After the last view, an object that is not found is unknown if
    it is probably not enrolled, and otherwise ambiguous. If the views were not segmented reliably, the search continues
    until the last view: another view costs little, and the background is then known.
    """
    probability, not_enrolled = posterior(belief, fit, other_bench=other_bench)
    place = int(probability.argmax())
    best = float(probability[place])
    least = LAST_CONFIDENCE if last else MIN_CONFIDENCE
    if best >= least:
        outcome, reason = Outcome.FOUND, StopReason.CONFIDENT
    elif not_enrolled >= (UNKNOWN_FROM if last else HOPELESS):
        outcome, reason = Outcome.UNKNOWN, StopReason.NOT_ENROLLED
    elif last:
        outcome, reason = Outcome.AMBIGUOUS, StopReason.MAX_VIEWS
    else:
        outcome, reason = Outcome.CONTINUE, StopReason.NOT_CONFIDENT
    if outcome is not Outcome.CONTINUE and not (reliable or last):
        outcome, reason = Outcome.CONTINUE, StopReason.BADLY_SEGMENTED
    return StopDecision(outcome, reason, int(belief.index.object_index[place]), best, not_enrolled, least)


#: Log-odds are limited to this: 1 in 10,000. No data support a smaller probability.
_MOST_ODDS: Final = 9.2


@dataclass(frozen=True, eq=False)
class _Model:
    """A logistic model after 1, 2, ... views; its last weights are for all further views.

    Attributes
    ----------
    weights : float64 array (views, numbers + 1)
        Weights of the numbers, and an offset.
    fit : float64 array (views, 5)
        Weights of the log-odds by the numbers, of the leader's fit, and of its differences from the fit of the next
        candidate and from the expected fit; an offset.
    """

    weights: FloatArray
    fit: FloatArray

    def log_odds(self, found: FloatArray, views: float, fit: PixelFit | None) -> float:
        odds = float(_after(self.weights, views) @ np.append(found, 1.0))
        if fit is None:
            return odds
        return float(_after(self.fit, views) @ [odds, fit.own, fit.own - fit.others, fit.own - fit.expected, 1.0])


def _after(weights: FloatArray, views: float) -> FloatArray:
    """Return the weights after a number of views; between two numbers, which frames in motion have, they are mixed."""
    at = min(max(views, 1.0), float(len(weights))) - 1
    low = min(int(at), len(weights) - 2)
    mixed: FloatArray = (1 - at + low) * weights[low] + (at - low) * weights[low + 1]
    return mixed


@cache
def _models() -> Mapping[str, _Model]:
    stored: dict[str, Any] = json.loads(files("hbr.dense").joinpath(WEIGHTS).read_text(encoding="utf-8"))
    return {
        name: _Model(*(np.array(one[key], np.float64) for key in ("weights", "fit"))) for name, one in stored.items()
    }
