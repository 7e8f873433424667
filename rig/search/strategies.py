"""Strategies: after each view, rotate to the next view or finish.

A search asks its strategy after every view (`rig.search.session.Strategy`). Seven come with the rig; others are passed
to `identify` as an object. Its attributes select its search: without any, the paper's (`HoughSearch`); with ``poses``,
the hidden Markov model over poses (`PoseSearch`); with the bench's own ``descriptor``, the dense search
(`DenseSearch`).

Decision: docs/decisions/0017.
"""

from collections.abc import Callable
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

import hbr
from hbr import Outcome, StopReason
from hbr.core.angles import wrap180
from hbr.dense.arc import ARC_DEG, STEP_DEG
from hbr.paper.hmm import CONFIDENT
from rig.config import RigConfig
from rig.core.errors import UsageError
from rig.events.events import RotationReason, Weighed
from rig.motion.move import MotionTimes, equivalent_within
from rig.motion.scan_speed import scan_speed
from rig.search.session import AnyStrategy, DenseSearch, Finish, HoughSearch, PoseSearch, Rotate, Search
from rig.views.description import BENCH_DESCRIPTOR, PAPER_DESCRIPTOR

ROTATION_STEP_DEG: Final = 5.0
"""Step between the rotations that the dense search weighs."""

ALONE: Final = 0.95
"""Probability of the leading candidate, among the enrolled objects, from which no other one is likely."""

_REVISIT_DEG: Final = 10.0  # as in the paper's search (`hbr.paper.next_view`): a nearer view shows nothing new
_DRAWS: Final = 20  # with views on all sides, no azimuth is free; then the last one is as good as any


@dataclass(frozen=True)
class OwnStrategy:
    """A strategy that comes with the rig."""

    name: str
    next: Callable[[Any], Rotate | Finish]
    descriptor: str = PAPER_DESCRIPTOR
    in_motion: bool = False
    poses: bool = False


def descriptor_for(strategy: AnyStrategy) -> str:
    """Return the descriptor of a strategy's views; the paper's if the strategy names none."""
    return str(getattr(strategy, "descriptor", PAPER_DESCRIPTOR))


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


def end_by_margin(search: HoughSearch) -> Finish | None:
    """Return the end by the rule that most strategies of the paper's search share, or None.

    A search ends when an enrolled object leads all others by ``identify.margin`` per view, or after
    ``identify.max_views``. A low score ends no search early.
    """
    config = search.config.identify
    if search.views >= config.min_views and search.score >= search.min_score and search.ranked.margin >= config.margin:
        return Finish(StopReason.MARGIN)
    return end_by_views(search)


def end_by_views(search: Search) -> Finish | None:
    """Return the end if all allowed views were taken, or None."""
    return Finish(StopReason.MAX_VIEWS) if search.views >= search.config.identify.max_views else None


def to_less_similar_side(search: HoughSearch) -> Rotate | Finish:
    """Rotate to the side on which the candidates look less similar (Eq. 5-7); the first rotation is fixed."""
    if (end := end_by_margin(search)) is not None:
        return end
    if search.views == 1:
        return Rotate(search.config.identify.first_step_deg, RotationReason.FIRST_STEP)
    decision = hbr.next_view(search.ranking)
    several = len(decision.candidates) > 1
    return Rotate(
        decision.rotation_deg,
        RotationReason.LESS_SIMILAR_SIDE if several else RotationReason.ONE_CANDIDATE,
        s_left=decision.s_left,
        s_right=decision.s_right,
        candidates=tuple(search.names[i] for i in decision.candidates),
    )


def by_even_steps(search: HoughSearch) -> Rotate | Finish:
    """Rotate by an even step of a revolution, one for each allowed view."""
    return end_by_margin(search) or Rotate(360.0 / search.config.identify.max_views, RotationReason.EVEN_STEPS)


def at_random(search: HoughSearch) -> Rotate | Finish:
    """Rotate to a random azimuth without a view, until an object leads."""
    return end_by_margin(search) or _to_random_azimuth(search)


def at_random_to_the_end(search: HoughSearch) -> Rotate | Finish:
    """Rotate to a random azimuth without a view, for all allowed views, as the paper measures HBR."""
    return end_by_views(search) or _to_random_azimuth(search)


def _to_random_azimuth(search: HoughSearch) -> Rotate:
    seen_deg = search.ranking.orientation_deg
    for _ in range(_DRAWS):
        rotation_deg = float(search.rng.uniform(-180.0, 180.0))
        if np.all(np.abs(wrap180(seen_deg[-1] + rotation_deg - seen_deg)) > _REVISIT_DEG):
            break
    return Rotate(rotation_deg, RotationReason.RANDOM)


def to_least_risk(search: PoseSearch) -> Rotate | Finish:
    """Rotate to the view with the least risk of misclassification (`hbr.paper.hmm`); its time does not count.

    The search ends if one object is probable and similar enough, after all allowed views, or without a rotation.
    """
    if search.probability >= CONFIDENT and search.score >= search.min_score:
        return Finish(StopReason.CONFIDENT)
    if (end := end_by_views(search)) is not None:
        return end
    rotations_deg, _ = reachable_rotations(search.config, search.table_deg)
    if not len(rotations_deg):
        return Finish(StopReason.NO_ROTATION_LEFT)
    return Rotate(search.belief.next_view(rotations_deg).rotation_deg, RotationReason.LEAST_RISK)


def to_next_best_view(search: DenseSearch) -> Rotate | Finish:
    """Rotate to the next best view, motion time included, until an answer is probable enough: the bench's own.

    In motion it rotates along the most informative arc, and decides again while the table rotates.
    """
    if search.decision.outcome is not Outcome.CONTINUE:
        return Finish(search.decision.reason)
    if search.in_motion:
        way = float(np.sign(search.step.rotation_deg)) if isinstance(search.step, Rotate) else 0.0
        rotations_deg, seconds = reachable_arcs(search.config, search.table_deg, way)
    else:
        rotations_deg, seconds = reachable_rotations(search.config, search.table_deg)
    if not len(rotations_deg):
        return Finish(StopReason.NO_ROTATION_LEFT)
    best = search.session.next_best_view(rotations_deg, seconds)
    if best.pair is not None:
        reason = RotationReason.SEPARATES_CANDIDATES
    else:  # the strongest hypotheses are poses of one object, but the others together may be as likely
        _, leading = search.session.belief.likeliest()
        reason = RotationReason.NEW_SIDE if leading >= ALONE else RotationReason.SEVERAL_POSES
    return Rotate(
        best.rotation_deg,
        reason,
        candidates=() if best.pair is None else tuple(search.names[i] for i in best.pair),
        weighed=Weighed(
            tuple(best.rotations_deg.tolist()),
            tuple(best.confusion.tolist()),
            tuple(best.cost.tolist()),
            None if best.similarity is None else tuple(best.similarity.tolist()),
        ),
    )


_OWN: Final[tuple[AnyStrategy, ...]] = (
    OwnStrategy("dense", to_next_best_view, BENCH_DESCRIPTOR),
    OwnStrategy("arc", to_next_best_view, BENCH_DESCRIPTOR, in_motion=True),
    OwnStrategy("ahbr", to_less_similar_side),
    OwnStrategy("hbr", at_random_to_the_end),
    OwnStrategy("sweep", by_even_steps),
    OwnStrategy("random", at_random),
    OwnStrategy("hmm", to_least_risk, poses=True),
)
BUILT_IN: Final = {strategy.name: strategy for strategy in _OWN}
"""The rig's own strategies."""


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
