"""The trials of an experiment: the methods that are compared, the settings, the records of the runs."""

import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from functools import lru_cache
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from hbr.core.angles import wrap180
from hbr.core.arrays import FloatArray
from hbr.dense.index import OMEGA, DenseIndex
from hbr.dense.stopping import Outcome
from hbr.model.views import Views
from hbr.paper.hough import Extension
from hbr.paper.index import Method as IndexMethod

Removal = Literal["near", "paper79", "queries"]
#: Codes of `Runs.outcome`.
OUTCOMES: Final = (Outcome.CONTINUE, Outcome.FOUND, Outcome.UNKNOWN, Outcome.AMBIGUOUS)


Strategy = Literal[
    "random",
    "sweep-45",
    "sweep-90",
    "ahbr",
    "ahbr-90",
    "coin",
    "least-risk",
    "next-best-view",
    "next-best-view-coin",
    "mutual",
    "oracle",
]


@dataclass(frozen=True)
class Method:
    """A retrieval method."""

    name: str
    """Name in ``--methods``."""
    label: str
    """Name in tables and figures."""
    strategy: Strategy = "random"
    """How the next view is chosen. ``random``; ``sweep-45``, ``sweep-90``: fixed steps; ``ahbr``: Eq. 5-7; ``coin``:
    the step of Eq. 5-7 to a random side. ``ahbr`` and ``coin`` begin with two random views, ``ahbr-90`` with a step of
    90° to the left, like the rig. With the hidden Markov model only: ``least-risk``. With the dense filter only:
    ``next-best-view``: `hbr.next_best_view`; ``next-best-view-coin``: its rotation to a random side; ``mutual``: mutual
    information; ``oracle``: the photograph with the largest lead of the true object."""
    omega: float = 0.5
    list_length: int = 10
    extension: Extension = "orient_all"
    """Parameters of `hbr.retrieve` or `hbr.DenseIndex`."""
    views: int | None = None
    """Largest number of views of this method; None: that of the protocol."""
    dense: bool = False
    """Whether the dense filter ranks the objects, instead of the paper's voting."""
    sectors: int = 4
    """Number of average views of an object (N~M of Eq. 5) that AHBR plans with."""
    hmm: bool = False
    """Whether the hidden Markov model over poses (`hbr.paper.hmm`) ranks the objects."""

    @property
    def active(self) -> bool:
        return self.strategy in ("ahbr", "ahbr-90", "coin")


_LISTED: Final = (
    Method("single", "single view", omega=0.0, extension="visual", views=1),
    Method("hbr-visual", "HBR best visual match", omega=0.0, extension="visual"),
    Method("hbr-0", "HBR ω = 0", omega=0.0),
    Method("hbr-0-orient", "HBR ω = 0 (orient)", omega=0.0, extension="orient"),
    Method("hbr", "HBR ω = 0.5"),
    Method("hbr-orient", "HBR ω = 0.5 (orient)", extension="orient"),
    Method("ahbr", "AHBR ω = 0.5", strategy="ahbr"),
    Method("ahbr-orient", "AHBR ω = 0.5 (orient)", strategy="ahbr", extension="orient"),
    Method("ahbr-90", "AHBR, first rotation 90°", strategy="ahbr-90"),
    Method("coin", "coin flip", strategy="coin"),
    Method("sweep-45", "sweep 45°", strategy="sweep-45"),
    Method("sweep-90", "sweep 90°", strategy="sweep-90"),
)
_DENSE: Final = (
    Method("dense", "dense filter, next best view", "next-best-view", OMEGA, dense=True),
    Method("dense-coin", "dense filter, coin flip", "next-best-view-coin", OMEGA, dense=True),
    Method("dense-random", "dense filter, random", "random", OMEGA, dense=True),
    Method("dense-45", "dense filter, sweep 45°", "sweep-45", OMEGA, dense=True),
    Method("dense-90", "dense filter, sweep 90°", "sweep-90", OMEGA, dense=True),
    Method("dense-mutual", "dense filter, mutual information", "mutual", OMEGA, dense=True),
    Method("dense-oracle", "dense filter, oracle", "oracle", OMEGA, dense=True),
)
_HMM: Final = (
    Method("hmm", "HMM, least risk", "least-risk", hmm=True),
    Method("hmm-random", "HMM, random views", hmm=True),
)
_OMEGAS: Final = (0.0, 0.125, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0)  # the sweeps around the paper's values: 0.5, 10 and 4.
_LENGTHS: Final = (1, 2, 4, 5, 6, 8, 10, 20, 50, 100)
_SECTORS: Final = (2, 3, 4, 6, 8, 12, 16)
_OMEGA_SWEEP: Final = tuple(Method(f"omega-{omega:g}", f"HBR ω = {omega:g}", omega=omega) for omega in _OMEGAS)
_LIST_SWEEP: Final = tuple(Method(f"list-{n}", f"HBR lists of {n}", list_length=n) for n in _LENGTHS)

_SECTOR_SWEEP: Final = tuple(
    Method(f"sectors-{n}", f"AHBR with {n} average views", "ahbr", sectors=n) for n in _SECTORS
)

METHODS: Final = {
    method.name: method for method in (*_LISTED, *_DENSE, *_HMM, *_OMEGA_SWEEP, *_LIST_SWEEP, *_SECTOR_SWEEP)
}
GROUPS: Final[dict[str, tuple[Method, ...]]] = {
    "all": _LISTED,
    "beyond": _DENSE[:-1],  # the oracle tries every view, which is slow
    "omega-sweep": _OMEGA_SWEEP,
    "list-sweep": _LIST_SWEEP,
    "sector-sweep": _SECTOR_SWEEP,
}


def choose_methods(names: Iterable[str]) -> tuple[Method, ...]:
    """Return the methods of these names and groups, each once.

    Raises
    ------
    ValueError
        There is no name, or one is neither a method nor a group.
    """
    chosen: dict[str, Method] = {}
    for name in names:
        if name in GROUPS:
            chosen |= {method.name: method for method in GROUPS[name]}
        elif name in METHODS:
            chosen[name] = METHODS[name]
        else:
            listed = ", ".join([*GROUPS, *(method.name for method in (*_LISTED, *_DENSE, *_HMM))])
            raise ValueError(f"method {name!r} is unknown; use some of {listed}")
    if not chosen:
        raise ValueError("no method is given; use all for the whole comparison")
    return tuple(chosen.values())


@dataclass(frozen=True)
class Protocol:
    """The settings of the trials."""

    trials: int = 10
    """Number of trials for each object."""
    max_views: int = 8
    """Number of queries in a trial; there are results after each query."""
    removal: Removal = "near"
    """{"near", "paper79", "queries"}: enrolled views of the object that are removed before the search. ``near``: those
    closer than `near_deg` to any query so far; ``paper79``: the queries and the next view of each (79 % of 72 views
    stay after 8 queries); ``queries``: only the queries."""
    near_deg: float = 10.0
    """The distance for ``near``."""
    sigma_deg: float = 2.0
    """Standard deviation of the error of each measured orientation."""
    drift_deg: float = 0.0
    """Drift of the measured orientation with each view."""
    rotation_errors_deg: tuple[float, ...] = ()
    """Measured errors of rotations. If there are any, each rotation between two views has one of them at random, and
    they add up, as those of a gyro do; `sigma_deg` and `drift_deg` then have no effect."""
    seed: int = 0
    """Seed of all random values."""
    enrolled: int | None = None
    """Number of enrolled views of each object, at equal distances; queries are taken from the other views. None: all
    views are enrolled, including the queries."""
    index: IndexMethod = "flat"
    """Search for similar views (`hbr.ViewIndex`) in the first trial of each object, whose time is measured."""

    def __post_init__(self) -> None:
        if self.trials < 1 or self.max_views < 1:
            raise ValueError(f"{self.trials} trials of {self.max_views} views; at least one of each is needed")
        if not (0 < self.near_deg <= 180 and 0 <= self.sigma_deg < np.inf and np.isfinite(self.drift_deg)):
            raise ValueError(
                f"near_deg is {self.near_deg}, sigma_deg {self.sigma_deg}, drift_deg {self.drift_deg}; needed are a "
                "value above 0 and up to 180, one of at least 0, and a finite one"
            )
        if not np.isfinite(self.rotation_errors_deg).all():
            raise ValueError("an error of a rotation is not a finite number; correct the file of the errors")
        if self.seed < 0:
            raise ValueError(f"seed is {self.seed}; a whole number of at least 0 is needed")
        if self.enrolled is not None and self.enrolled < 1:
            raise ValueError(f"{self.enrolled} enrolled views; at least 1 is needed")


@dataclass(frozen=True, eq=False)
class Runs:
    """The results of the trials: arrays of shape (methods, objects, trials, views)."""

    rank: NDArray[np.int32]
    """int32: rank of the true object, 1 if it leads; 0 if it is not a candidate, -1 after the last view of the
    method."""
    pose_error_deg: FloatArray
    """float64: distance of the estimated from the true orientation of the true object, 0..180; nan if it is not a
    candidate."""
    alike_error_deg: FloatArray
    """float64: distance of the estimated from the nearest orientation in which the object looks as in the true one,
    0..180."""
    period_deg: FloatArray
    """float64: symmetry of the true object, from all its views (`hbr.model.symmetry.symmetry`): 360 if it is not
    symmetric; nan if it has too few views."""
    stated: FloatArray
    """float64 (methods, objects, trials, views, 4): `hbr.evaluation.poses.StatedPose` for the true object, where a
    search of the dense filter ends; else nan."""
    margin: FloatArray
    """float64: `hbr.score_margin` of the leading object per view; with the dense filter, its score minus the second
    score."""
    named: NDArray[np.bool_]
    """Whether the true object leads. With the dense filter the decision counts, pixels included."""
    score: FloatArray
    """float64: the leading object's score per view."""
    outcome: NDArray[np.int8]
    """int8: decision of the stopping rule with the dense filter, as an index of `OUTCOMES`; -1 with the paper's
    voting."""
    travelled_deg: FloatArray
    """float64: sum of the rotations since the first view, without signs."""
    step_ns: NDArray[np.int64]
    """int64: time of retrieval and decision in the first trial of each object, and with the dense filter in all; else
    0. The other trials of the paper's voting share the retrieval lists. 0 without a timer."""

    @classmethod
    def blank(cls, methods: int, objects: int, trials: int, views: int) -> "Runs":
        """Return runs without any result."""
        filled = {
            "rank": (-1, np.int32),
            "named": (False, np.bool_),
            "outcome": (-1, np.int8),
            "step_ns": (0, np.int64),
        }
        shape = (methods, objects, trials, views)
        shapes = {"stated": (*shape, 4)}
        numbers = ((item.name, filled.get(item.name, (np.nan, np.float64))) for item in fields(cls))
        return cls(*(np.full(shapes.get(name, shape), *values) for name, values in numbers))

    def of(self, objects: slice) -> "Runs":
        """Return the runs of some objects."""
        return Runs(*(getattr(self, item.name)[:, objects] for item in fields(self)))

    @classmethod
    def concatenate(cls, parts: Sequence["Runs"]) -> "Runs":
        """Return the runs of the objects of all parts, in their order."""
        return cls(*(np.concatenate([getattr(part, item.name) for part in parts], axis=1) for item in fields(cls)))


@lru_cache(maxsize=1)
def index_of(views: Views) -> DenseIndex:
    """Return the index of all objects, which each process makes once."""
    return DenseIndex(views)


def views_enrolled(azimuth_deg: FloatArray, count: int) -> NDArray[np.bool_]:
    """Return which views are the nearest to `count` equally spaced azimuths, bool (n,)."""
    mask = np.zeros(len(azimuth_deg), np.bool_)
    if len(azimuth_deg):
        away_deg = np.abs(wrap180(azimuth_deg[:, None] - np.arange(count) * 360 / count))
        mask[away_deg.argmin(axis=0)] = True
    return mask


def views_of_trial(views: Views, protocol: Protocol) -> NDArray[np.bool_]:
    """Return which views are enrolled in all trials, bool (n,)."""
    mask = np.ones(len(views), np.bool_)
    if protocol.enrolled is not None:
        for j in range(len(views.object_names)):
            rows = views.of(j)
            mask[rows] = views_enrolled(views.azimuth_deg[rows], protocol.enrolled)
    return mask


# never renumber: the numbers are a part of each seed, and so of every published figure
_PURPOSES: Final = {"trial": 0, "photograph": 1, "bootstrap": 2, "enrolled": 3}


def generator(
    seed: int, name: str, purpose: Literal["trial", "photograph", "bootstrap", "enrolled"], number: int
) -> np.random.Generator:
    """Return the generator for one purpose and number of an object; no other draw, object or order changes it."""
    key = (_PURPOSES[purpose], number)
    return np.random.default_rng(np.random.SeedSequence([seed, zlib.crc32(name.encode())], spawn_key=key))
