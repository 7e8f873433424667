"""The settings and the records of the trials of an evaluation (`hbr.evaluation.trials`)."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Final, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from hbr.core.angles import wrap180
from hbr.core.arrays import FloatArray
from hbr.dense.stopping import Outcome
from hbr.model.views import Views

Removal = Literal["near", "paper79", "queries"]
#: Codes of `Runs.outcome`.
OUTCOMES: Final = (Outcome.CONTINUE, Outcome.FOUND, Outcome.UNKNOWN, Outcome.AMBIGUOUS)
#: Codes of `Runs.compared`: what a comparison of the two leaders names.
COMPARED: Final = ("none", "right", "wrong", "ambiguous")


@dataclass(frozen=True)
class Protocol:
    """The settings of the trials.

    Attributes
    ----------
    trials : int
        Number of trials for each object.
    max_views : int
        Number of queries in a trial; there are results after each query.
    removal : {"near", "paper79", "queries"}
        Enrolled views of the object that are removed before the search. ``near``: those closer than `near_deg` to any
        query so far; ``paper79``: the queries and the next view of each (79 % of 72 views stay after 8 queries);
        ``queries``: only the queries.
    near_deg : float
        The distance for ``near``.
    sigma_deg : float
        Standard deviation of the error of each measured orientation.
    drift_deg : float
        Drift of the measured orientation with each view.
    seed : int
        Seed of all random values.
    enrolled : int or None
        Number of enrolled views of each object, at equal distances; queries are taken from the other views. None: all
        views are enrolled, including the queries.
    absent : tuple of str
        Names of objects that are not enrolled, to measure unknown objects; only with the dense filter.
    """

    trials: int = 10
    max_views: int = 8
    removal: Removal = "near"
    near_deg: float = 10.0
    sigma_deg: float = 2.0
    drift_deg: float = 0.0
    seed: int = 0
    enrolled: int | None = None
    absent: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.trials < 1 or self.max_views < 1:
            raise ValueError(f"{self.trials} trials of {self.max_views} views; at least one of each is needed")
        if self.removal not in get_args(Removal):
            raise ValueError(f"removal {self.removal!r} is unknown; use one of {', '.join(get_args(Removal))}")
        if not (0 < self.near_deg <= 180 and 0 <= self.sigma_deg < np.inf and np.isfinite(self.drift_deg)):
            raise ValueError(
                f"near_deg is {self.near_deg}, sigma_deg {self.sigma_deg}, drift_deg {self.drift_deg}; needed are a "
                "value above 0 and up to 180, one of at least 0, and a finite one"
            )
        if self.seed < 0:
            raise ValueError(f"seed is {self.seed}; a whole number of at least 0 is needed")
        if self.enrolled is not None and self.enrolled < 1:
            raise ValueError(f"{self.enrolled} enrolled views; at least 1 is needed")


@dataclass(frozen=True, eq=False)
class Runs:
    """The results of the trials: arrays of shape (methods, objects, trials, views).

    Attributes
    ----------
    rank : int32
        Rank of the true object, 1 if it leads; 0 if it is not a candidate, -1 after the last view of the method.
    pose_error_deg : float64
        Distance of the estimated from the true orientation of the true object, 0..180; nan if it is not a candidate.
    alike_error_deg : float64
        Distance of the estimated from the nearest orientation in which the object looks as in the true one, 0..180.
    period_deg : float64
        Symmetry of the true object, from all its views (`hbr.model.symmetry.symmetry`): 360 if it is not symmetric;
        nan if it has too few views.
    margin : float64
        `hbr.score_margin` of the leading object per view; with the dense filter, its score minus the second score.
    best : int32
        The leading object, as an index of the views' names.
    score : float64
        Its score per view.
    outcome : int8
        Decision of the stopping rule with the dense filter, as an index of `OUTCOMES`; -1 with the paper's voting.
    compared : int8
        Result of the comparison of the two leaders at the end of a search of the dense filter, as an index of
        `COMPARED`; else -1.
    travelled_deg : float64
        Sum of the rotations since the first view, without signs.
    step_ns : int64
        Time of retrieval and decision in the first trial of each object, and with the dense filter in all; else 0. The
        other trials of the paper's voting share the retrieval lists. 0 without a timer.
    """

    rank: NDArray[np.int32]
    pose_error_deg: FloatArray
    alike_error_deg: FloatArray
    period_deg: FloatArray
    margin: FloatArray
    best: NDArray[np.int32]
    score: FloatArray
    outcome: NDArray[np.int8]
    compared: NDArray[np.int8]
    travelled_deg: FloatArray
    step_ns: NDArray[np.int64]

    @classmethod
    def blank(cls, methods: int, objects: int, trials: int, views: int) -> "Runs":
        """Return runs without any result."""
        filled = {
            "rank": (-1, np.int32),
            "best": (-1, np.int32),
            "outcome": (-1, np.int8),
            "compared": (-1, np.int8),
            "step_ns": (0, np.int64),
        }
        shape = (methods, objects, trials, views)
        return cls(*(np.full(shape, *filled.get(item.name, (np.nan, np.float64))) for item in fields(cls)))

    def of(self, objects: slice) -> "Runs":
        """Return the runs of some objects."""
        return Runs(*(getattr(self, item.name)[:, objects] for item in fields(self)))

    @classmethod
    def concatenate(cls, parts: Sequence["Runs"]) -> "Runs":
        """Return the runs of the objects of all parts, in their order."""
        return cls(*(np.concatenate([getattr(part, item.name) for part in parts], axis=1) for item in fields(cls)))


def views_enrolled(azimuth_deg: FloatArray, count: int) -> NDArray[np.bool_]:
    """Return which views are the nearest to `count` equally spaced azimuths, bool (n,)."""
    mask = np.zeros(len(azimuth_deg), np.bool_)
    if len(azimuth_deg):
        away_deg = np.abs(wrap180(azimuth_deg[:, None] - np.arange(count) * 360 / count))
        mask[away_deg.argmin(axis=0)] = True
    return mask


def views_of_trial(views: Views, protocol: Protocol) -> NDArray[np.bool_]:
    """Return which views are enrolled in all trials, bool (n,): all except those of absent objects."""
    mask = ~np.isin(views.object_index, [j for j, name in enumerate(views.object_names) if name in protocol.absent])
    if protocol.enrolled is not None:
        for j in range(len(views.object_names)):
            rows = views.of(j)
            mask[rows] &= views_enrolled(views.azimuth_deg[rows], protocol.enrolled)
    return mask
