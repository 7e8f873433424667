"""The plan that finds out what stands on the table: look, vote, decide, turn, until the answer is clear."""

from collections.abc import Generator

import hbr
from hbr.angles import wrap360
from rig.bench import Bench
from rig.clock import seconds_between
from rig.errors import RigError
from rig.plans.capture import announced, capture, moved, unwind
from rig.plans.events import Accepted, Decided, Event, Identified, Started
from rig.plans.search import SHOWN, Search
from rig.plans.strategies import Stop, Strategy, Turn
from rig.plans.strategies import strategy as strategy_named
from rig.turntable import Turntable
from rig.view import Viewer


def identify(
    bench: Bench,
    index: hbr.ViewIndex,
    *,
    strategy: Strategy | str = "ahbr",
    seed: int = 0,
    top: int = SHOWN,
) -> Generator[Event, None, Identified]:
    """Identify the object on the table against the enrolled views; yields events and returns the answer.

    The strategy decides after each view where to look next, or that it is enough; `rig.plans.strategies` has those that
    come with the rig, ``ahbr`` among them: the first two views are a fixed step apart, every later one lies where the
    rivals look less alike (Eq. 5-7), until a known object leads all others by ``identify.margin`` a view, or
    ``identify.max_views`` were taken. An object whose score a view stays below ``identify.min_score`` is unknown; where
    that is not given, below what the enrolled views let expect (`hbr.familiar_score`). Closing the generator takes the
    torque off.

    Parameters
    ----------
    bench
        An open bench.
    index : hbr.ViewIndex
        The enrolled views.
    strategy
        Its name, or a strategy of your own.
    seed
        For strategies that draw.
    top
        How many candidates the events name.

    Raises
    ------
    CatalogError
        Nothing is enrolled.
    UsageError
        There is no such strategy.
    ViewRejected, MotionTimeout, DeviceFault, DeviceSilent
        See `rig.view` and `rig.turntable`.
    """
    config = bench.config.identify
    if isinstance(strategy, str):
        strategy = strategy_named(strategy)
    search = Search(index, config, strategy, seed=seed, top=top)
    viewer = Viewer(bench.camera, bench.config.view)
    yield Started("identify", None, config.max_views, dict(bench.conditions), strategy=strategy.name, seed=seed)
    bench.operator.place(None)
    started_ns = bench.clock.now_ns()
    travelled_deg = 0.0
    sign = bench.config.table.orientation_sign  # as the table turns, the camera goes around the object backwards
    number = 0
    trouble: RigError | None = None
    with Turntable(bench) as table:
        move = table.hold()
        orientation_deg = sign * move.encoder_deg
        while True:
            yield moved(number, move)
            shot = yield from capture(number, viewer, table, move.settled_ns)
            azimuth_deg = float(wrap360(orientation_deg))
            yield Accepted(number, azimuth_deg, shot.evidence, shot.image_bgr)
            ranked, step = search.look(
                viewer.describe(shot.image_bgr),
                azimuth_deg,
                table_deg=table.rest_deg,
                limits_deg=bench.config.table.limits_deg,
            )
            yield ranked
            if isinstance(step, Stop):
                break
            asked_deg = table.rest_deg + sign * step.rotation_deg
            decided = _decided(number, step, table.within_reach(asked_deg), top)
            yield decided
            move = yield from announced(number, table, decided.target_deg, asked_deg=asked_deg)
            travelled_deg += abs(move.rotation_deg)
            orientation_deg += sign * move.rotation_deg
            number += 1
        seconds = seconds_between(started_ns, bench.clock.now_ns())
        try:
            yield from unwind(number, table)
        except RigError as error:
            trouble = error  # the answer is known, and must not be lost
    best = ranked.candidates[0]
    answer = Identified(
        name=best.name if best.score >= search.min_score else None,
        candidates=ranked.candidates,
        score=best.score,
        margin=ranked.margin,
        min_score=search.min_score,
        pose_deg=best.pose_deg,
        yaw_deg=search.yaw_deg(ranked),
        views=number + 1,
        travelled_deg=travelled_deg,
        seconds=seconds,
        reason=step.why,
    )
    yield answer
    if trouble:
        raise trouble
    return answer


def _decided(number: int, turn: Turn, target_deg: float, top: int) -> Decided:
    return Decided(
        index=number,
        side="left" if turn.rotation_deg >= 0 else "right",
        rotation_deg=turn.rotation_deg,
        target_deg=target_deg,
        s_left=turn.s_left,
        s_right=turn.s_right,
        rivals=turn.rivals[:top],
        why=turn.why,
    )
