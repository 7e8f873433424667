"""The posterior of a search over the enrolled objects and "not enrolled", and the decision that follows from it.

The numbers of `hbr.dense.evidence` give the log-odds that the leading candidate is the object on the table, by a small
network. The pixel by pixel fit of the leader, and whether the bench is another one, are further numbers. What is left
is the probability that the object is not enrolled. `Belief` divides the rest among the enrolled objects; the fit also
counts between the two likeliest ones.

The weights (``evidence.json``) are the same for all catalogs. `python -m benchmarks.fit_search` fits them to half of
the objects of COIL-100 and ETH-80, after changes of a drawn bench and in the photographs as they are, with and without
noise, and with half of the searches for objects that are not enrolled. Measured rates: docs/results.md.

Decision: docs/decisions/0015.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import cache
from importlib.resources import files
from math import exp
from typing import Any, Final, NamedTuple

import numpy as np

from hbr.core.arrays import FloatArray
from hbr.dense.evidence import COMMON, numbers
from hbr.dense.filter import Belief
from hbr.dense.pixel_fit import PixelFit

WEIGHTS: Final = "evidence.json"
#: Probability of the leading candidate that ends a search, and that is enough after its last view.
# lower: fewer views, and more objects that are not enrolled are found
MIN_CONFIDENCE: Final = 0.97
LAST_CONFIDENCE: Final = 0.8
#: Probability of "not enrolled" that ends a search before its last view: no pixel by pixel fit would change it.
HOPELESS: Final = 0.998
#: After the last view, an object is unknown from this probability on, and otherwise ambiguous.
UNKNOWN_FROM: Final = 0.8


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
    CUSTOM = "custom"


@dataclass(frozen=True, slots=True)
class StopDecision:
    """The decision after a view, and the probabilities that it follows from."""

    outcome: Outcome
    reason: StopReason
    """What to do, and why."""
    object_index: int
    """The leading candidate, for every outcome."""
    probability: float
    """That it is the object on the table."""
    not_enrolled: float
    """Probability that the object on the table is not enrolled."""
    min_confidence: float
    """Probability that ends a search."""


def posterior(belief: Belief, fit: PixelFit | None = None, *, other_bench: bool = False) -> tuple[FloatArray, float]:
    """Return the probability of every object considered, (k,), and that the object is not enrolled; the sum is 1.

    ``fit`` is that of the leading candidates, pixel by pixel; ``other_bench`` says that the bench is certainly not that
    of the enrollment.
    """
    among = among_enrolled(belief, fit)
    leader = int(among.argmax())
    found, model = numbers(belief, leader), _model_of(belief)
    if model.is_common:
        found = found[:COMMON]
    odds = model.log_odds([*found, other_bench], fit)
    enrolled = 1 / (1 + exp(-min(max(odds, -_MOST_ODDS), _MOST_ODDS)))
    return among * enrolled, 1 - enrolled


def pair_odds(belief: Belief, first: int, second: int, by: float) -> float:
    """Return the log-odds of one object against another, by their places, if one of both is on the table.

    The pixel by pixel fit of the first one is better ``by`` so much.
    """
    among = belief.probability()
    return _OF_BELIEF * float(np.log(max(among[first], _TINY) / max(among[second], _TINY))) + _OF_FIT * by


def among_enrolled(belief: Belief, fit: PixelFit | None) -> FloatArray:
    """Return the probability of every object considered if the object on the table is enrolled, (k,); the sum is 1.

    A fit divides the probability of the two likeliest objects again.
    """
    among = belief.probability()
    if fit is None or len(among) < 2:
        return among
    first, second = np.argsort(-among, kind="stable")[:2].tolist()
    if belief.index.object_index[second] == fit.object_index:
        first, second = second, first
    both = among[first] + among[second]
    share = 1 / (1 + exp(-pair_odds(belief, first, second, fit.own - fit.second)))
    among[first], among[second] = share * both, (1 - share) * both
    return among


def _model_of(belief: Belief) -> "_Model":
    models = _models()
    return models.get(belief.index.views.descriptor, models[""])


def decide(
    belief: Belief, *, last: bool, reliable: bool = True, fit: PixelFit | None = None, other_bench: bool = False
) -> StopDecision:
    """Decide whether a search ends after these views.

    An object is found if its probability reaches `MIN_CONFIDENCE`. After the last view `LAST_CONFIDENCE` is enough, but
    not if the rest is that of a similar enrolled object: a wrong name is worse than two names. An object that is hardly
    enrolled ends the search as unknown. After the last view, an object that is not found is unknown if
    it is probably not enrolled, and otherwise ambiguous. If the views were not segmented reliably, the search continues
    until the last view: another view costs little, and the background is then known.
    """
    probability, not_enrolled = posterior(belief, fit, other_bench=other_bench)
    place = int(probability.argmax())
    best = float(probability[place])
    least = max(LAST_CONFIDENCE, MIN_CONFIDENCE * (1 - not_enrolled)) if last else MIN_CONFIDENCE
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
#: Weights of the log-odds of two objects by the belief, and of the difference of their fits.
# fitted to 2,134 searches, of all objects of COIL-100 and ETH-80, in which the object is one of the two
_OF_BELIEF, _OF_FIT = 0.7, 14.0
_TINY: Final = 1e-12


class _Network(NamedTuple):
    """A network with one hidden layer."""

    inner: FloatArray
    outer: FloatArray
    """float64 arrays (numbers + 1, units) and (units,): weights of the hidden layer, with an offset for each unit, and
    of its units."""
    direct: FloatArray
    """float64 array (numbers + 1,): weights of the numbers themselves, and an offset."""

    def __call__(self, found: Sequence[float]) -> float:
        given = np.array([*found, 1.0])
        return float(np.tanh(given @ self.inner) @ self.outer + given @ self.direct)


class _Model(NamedTuple):
    """The model for one descriptor."""

    alone: _Network
    with_fit: _Network
    """Return the log-odds that the leader is on the table, without a fit and with one."""
    is_common: bool
    """Whether the numbers are only those that do not depend on the parts of a descriptor."""

    def log_odds(self, found: Sequence[float], fit: PixelFit | None) -> float:
        if fit is None:
            return self.alone(found)
        return self.with_fit([*found, *fit.numbers()])


@cache
def _models() -> Mapping[str, _Model]:
    stored: dict[str, Any] = json.loads(files("hbr.dense").joinpath(WEIGHTS).read_text(encoding="utf-8"))
    return {
        name: _Model(_Network(*map(np.array, one["alone"])), _Network(*map(np.array, one["with_fit"])), not name)
        for name, one in stored.items()
    }
