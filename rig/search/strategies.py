"""Strategies: after each view, rotate to the next view or finish.

`identify` asks one strategy after every view. Seven come with the rig; others are passed as an object. Its attributes
select its search: without any, the paper's (`SearchState`); with ``poses``, the hidden Markov model over poses
(`PoseSearchState`); with the bench's own ``descriptor``, the dense search (`DenseSearchState`).

Decision: docs/decisions/0017.
"""

from collections.abc import Callable
from dataclasses import dataclass
from difflib import get_close_matches
from typing import ClassVar, Final, Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

import hbr
from hbr import Outcome, StopReason
from hbr.core.angles import wrap180
from hbr.dense.arc import ARC_DEG, STEP_DEG
from hbr.paper.hmm import CONFIDENT, PoseBelief
from rig.config import IdentifyConfig, RigConfig
from rig.core.errors import UsageError
from rig.events.events import RotationReason, Weighed
from rig.motion.move import MotionTimes, equivalent_within
from rig.motion.scan_speed import scan_speed
from rig.views.description import BENCH_DESCRIPTOR, PAPER_DESCRIPTOR

ROTATION_STEP_DEG: Final = 5.0
"""Step between the rotations that the dense search weighs."""

ALONE: Final = 0.95
"""Probability of the leading candidate, among the enrolled objects, from which no other one is likely."""

_REVISIT_DEG: Final = 10.0  # as in the paper's search (`hbr.paper.next_view`): a nearer view shows nothing new
_DRAWS: Final = 20  # with views on all sides, no azimuth is free; then the last one is as good as any

State = TypeVar("State", contravariant=True)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class _AnyState:
    table_deg: float
    config: IdentifyConfig
    rng: np.random.Generator


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class SearchState(_AnyState):
    """The state of the paper's search after a view; also ``table_deg``, ``config`` and ``rng``."""

    index: hbr.ViewIndex
    """The enrolled views."""
    queries: NDArray[np.uint8]
    """Descriptors of the views so far, in their order, uint8 (N, 144)."""
    ranking: hbr.Ranking
    """The objects by their scores; `ranking.orientation_deg` has the orientation of each view."""
    score: float
    margin: float
    """Hough score and margin of the leading candidate, per view (`hbr.score_margin`)."""
    min_score: float
    """Below this score per view the object is unknown."""
    limits_deg: tuple[float, float]
    """The limits of the cable."""

    @property
    def views(self) -> int:
        """The number of views so far."""
        return len(self.queries)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class PoseSearchState(_AnyState):
    """The state of a search by the hidden Markov model after a view; also ``table_deg``, ``config`` and ``rng``."""

    belief: PoseBelief
    """The probabilities of all poses, with its method ``next_view``."""
    probability: float
    score: float
    """Both of the leading candidate; the score per view is the similarity to its most similar views."""
    min_score: float
    """Below this score per view the object is unknown."""
    rotations_deg: NDArray[np.float64]
    """Rotations of the camera around the object that the cable allows, every 5°, float64 (a,)."""

    @property
    def views(self) -> int:
        """The number of views so far."""
        return len(self.belief.orientation_deg)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class DenseSearchState(_AnyState):
    """The state of the dense search after a view; also ``table_deg``, ``config`` and ``rng``."""

    session: hbr.DenseSession
    """The search, with its ``belief`` and its method ``next_best_view``."""
    decision: hbr.StopDecision
    """What follows from the views so far."""
    rotations_deg: NDArray[np.float64]
    seconds: NDArray[np.float64]
    """Rotations of the camera around the object that the cable allows, every 5°, and the time of each on this bench,
    float64 (a,)."""

    @property
    def views(self) -> int:
        """The number of views so far."""
        return self.session.belief.queries


@dataclass(frozen=True, slots=True)
class Rotate:
    """Take the next view after a rotation of the camera around the object, positive to the left.

    ``note`` is the reason, for a strategy that does not come with the rig. ``s_left`` and ``s_right`` are the
    similarities of the ``candidates`` (names) from each side, if the strategy compared the sides; ``weighed`` has all
    rotations that it weighed.
    """

    rotation_deg: float
    reason: RotationReason = RotationReason.CUSTOM
    note: str = ""
    s_left: float | None = None
    s_right: float | None = None
    candidates: tuple[str, ...] = ()
    weighed: Weighed | None = None


@dataclass(frozen=True, slots=True)
class Finish:
    """End the search. ``note`` is the reason, for a strategy that does not come with the rig."""

    reason: StopReason = StopReason.CUSTOM
    note: str = ""


class Strategy(Protocol[State]):
    """Decides after each view.

    A strategy of the dense search also has the attribute ``descriptor``: that of its views. With the
    attribute ``in_motion`` it chooses arcs, on which every frame is a view. A strategy of the hidden Markov model has
    the attribute ``poses``, which is true.
    """

    @property
    def name(self) -> str:
        """The name that selects it, and that a saved run stores."""
        ...

    def next(self, state: State) -> Rotate | Finish:
        """Return the rotation to the next view, or the end. The same state and draws give the same answer."""
        ...


AnyStrategy = Strategy[SearchState] | Strategy[PoseSearchState] | Strategy[DenseSearchState]


def descriptor_for(strategy: AnyStrategy) -> str:
    """Return the descriptor of a strategy's views; the paper's if the strategy names none."""
    return str(getattr(strategy, "descriptor", PAPER_DESCRIPTOR))


def is_in_motion(strategy: AnyStrategy) -> bool:
    """Return whether a strategy chooses arcs, on which every frame is a view."""
    return bool(getattr(strategy, "in_motion", False))


def has_poses(strategy: AnyStrategy) -> bool:
    """Return whether a strategy searches by the hidden Markov model over poses."""
    return bool(getattr(strategy, "poses", False))


def strategy_for(descriptor: str) -> AnyStrategy:
    """Return the default strategy for views by a descriptor."""
    return BUILT_IN["ahbr" if descriptor == PAPER_DESCRIPTOR else "dense"]


def reachable_rotations(config: RigConfig, table_deg: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the rotations of the camera that the cable allows, and the time of each by the bench's motion model.

    If the short way exceeds the cable budget, the table rotates the long way round, which takes longer.
    """
    model = MotionTimes(config)
    rotations_deg, seconds = [], []
    for rotation_deg in (np.arange(ROTATION_STEP_DEG - 180, 180 + ROTATION_STEP_DEG, ROTATION_STEP_DEG)).tolist():
        asked_deg = table_deg + config.table.orientation_sign * rotation_deg
        target_deg = equivalent_within(asked_deg, table_deg, config.table.limits_deg)
        if rotation_deg and target_deg is not None:
            rotations_deg.append(rotation_deg)
            seconds.append(model.move_s(target_deg - table_deg))
    return np.array(rotations_deg), np.array(seconds)


def reachable_arcs(config: RigConfig, table_deg: float, way: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the ends of the arcs that the cable allows, as rotations of the camera, and the time to each.

    ``way`` is the sign of the present rotation of the camera, 0 at rest. An arc in the other direction also takes the
    time for a reversal.
    """
    speed = scan_speed(config, config.imu.range_dps).dps
    low_deg, high_deg = config.table.limits_deg
    arcs_deg = np.arange(STEP_DEG, 180.0 + STEP_DEG, STEP_DEG)
    arcs_deg = np.concatenate([-arcs_deg[::-1], arcs_deg])
    ends_deg = table_deg + config.table.orientation_sign * arcs_deg
    arcs_deg = arcs_deg[(ends_deg >= low_deg) & (ends_deg <= high_deg)]
    seconds = np.abs(arcs_deg) / speed
    if not way:  # if the cable ends before the whole arc, the table would have to come back
        for side in (-1.0, 1.0):
            room_deg = high_deg - table_deg if side * config.table.orientation_sign > 0 else table_deg - low_deg
            seconds[np.sign(arcs_deg) == side] += max(ARC_DEG - room_deg, 0.0) / speed / 2
    seconds[np.sign(arcs_deg) == -way] += 2 * speed / config.table.acceleration_dps2
    return arcs_deg, seconds


def end_by_margin(state: SearchState) -> Finish | None:
    """Return the end by the rule that most strategies of the paper's search share, or None.

    A search ends when an enrolled object leads all others by ``identify.margin`` per view, or after
    ``identify.max_views``. A low score ends no search early.
    """
    config = state.config
    if state.views >= config.min_views and state.score >= state.min_score and state.margin >= config.margin:
        return Finish(StopReason.MARGIN)
    return end_by_views(state)


def end_by_views(state: SearchState | PoseSearchState) -> Finish | None:
    """Return the end if all allowed views were taken, or None."""
    return Finish(StopReason.MAX_VIEWS) if state.views >= state.config.max_views else None


def end_by_probability(state: PoseSearchState) -> Finish | None:
    """Return the end if one object is probable and similar enough, after all allowed views, or without a rotation."""
    if state.probability >= CONFIDENT and state.score >= state.min_score:
        return Finish(StopReason.CONFIDENT)
    return end_by_views(state) or (None if len(state.rotations_deg) else Finish(StopReason.NO_ROTATION_LEFT))


PaperState = TypeVar("PaperState", SearchState, PoseSearchState)


@dataclass(frozen=True)
class PaperStrategy(Generic[PaperState]):
    """A strategy of the paper or its successor: the rule that ends the search, and the choice of the next rotation."""

    name: str
    end: Callable[[PaperState], Finish | None]
    rotate: Callable[[PaperState], Rotate]
    poses: bool = False

    def next(self, state: PaperState) -> Rotate | Finish:
        return self.end(state) or self.rotate(state)


def to_less_similar_side(state: SearchState) -> Rotate:
    """Rotate to the side on which the candidates look less similar (Eq. 5-7); the first rotation is fixed."""
    if state.views == 1:
        return Rotate(state.config.first_step_deg, RotationReason.FIRST_STEP)
    decision = hbr.next_view(state.ranking)
    names = state.ranking.views.object_names
    several = len(decision.candidates) > 1
    return Rotate(
        decision.rotation_deg,
        RotationReason.LESS_SIMILAR_SIDE if several else RotationReason.ONE_CANDIDATE,
        s_left=decision.s_left,
        s_right=decision.s_right,
        candidates=tuple(names[i] for i in decision.candidates),
    )


def by_even_steps(state: SearchState) -> Rotate:
    """Rotate by an even step of a revolution, one for each allowed view."""
    return Rotate(360.0 / state.config.max_views, RotationReason.EVEN_STEPS)


def to_random_azimuth(state: SearchState) -> Rotate:
    """Rotate to a random azimuth without a view; to the last one drawn if there is none."""
    seen_deg = state.ranking.orientation_deg
    for _ in range(_DRAWS):
        rotation_deg = float(state.rng.uniform(-180.0, 180.0))
        if np.all(np.abs(wrap180(seen_deg[-1] + rotation_deg - seen_deg)) > _REVISIT_DEG):
            break
    return Rotate(rotation_deg, RotationReason.RANDOM)


def to_least_risk(state: PoseSearchState) -> Rotate:
    """Rotate to the view with the least risk of misclassification (`hbr.paper.hmm`); its time does not count."""
    return Rotate(state.belief.next_view(state.rotations_deg).rotation_deg, RotationReason.LEAST_RISK)


@dataclass(frozen=True)
class DenseStrategy:
    """The bench's own: rotates to the next best view, motion time included, until an answer is probable enough.

    In motion it rotates along the most informative arc, and decides again while the table rotates.
    """

    name: str
    in_motion: bool = False
    descriptor: ClassVar[str] = BENCH_DESCRIPTOR

    def next(self, state: DenseSearchState) -> Rotate | Finish:
        if state.decision.outcome is not Outcome.CONTINUE:
            return Finish(state.decision.reason)
        if not len(state.rotations_deg):
            return Finish(StopReason.NO_ROTATION_LEFT)
        best = state.session.next_best_view(state.rotations_deg, state.seconds)
        names = state.session.belief.index.views.object_names
        if best.pair is not None:
            reason = RotationReason.SEPARATES_CANDIDATES
        else:  # the strongest hypotheses are poses of one object, but the others together may be as likely
            _, leading = state.session.belief.likeliest()
            reason = RotationReason.NEW_SIDE if leading >= ALONE else RotationReason.SEVERAL_POSES
        return Rotate(
            best.rotation_deg,
            reason,
            candidates=() if best.pair is None else tuple(names[i] for i in best.pair),
            weighed=Weighed(
                tuple(best.rotations_deg.tolist()),
                tuple(best.confusion.tolist()),
                tuple(best.cost.tolist()),
                None if best.similarity is None else tuple(best.similarity.tolist()),
            ),
        )


_OWN: Final[tuple[AnyStrategy, ...]] = (
    DenseStrategy("dense"),
    DenseStrategy("arc", in_motion=True),
    PaperStrategy("ahbr", end_by_margin, to_less_similar_side),
    PaperStrategy("hbr", end_by_views, to_random_azimuth),
    PaperStrategy("sweep", end_by_margin, by_even_steps),
    PaperStrategy("random", end_by_margin, to_random_azimuth),
    PaperStrategy("hmm", end_by_probability, to_least_risk, poses=True),
)
BUILT_IN: Final = {strategy.name: strategy for strategy in _OWN}
"""The rig's own strategies. ``hbr`` takes all allowed views at random, as the paper measures HBR."""


def strategy(name: str) -> AnyStrategy:
    """Return the strategy of that name.

    Raises `UsageError`: there is none.
    """
    if name in BUILT_IN:
        return BUILT_IN[name]
    near = get_close_matches(name, BUILT_IN, n=1)
    raise UsageError(
        f"There is no strategy {name!r}.",
        next_step=f"Did you mean {near[0]}?" if near else "Choose one of those listed.",
        evidence={"strategies": list(BUILT_IN)},
    )
