"""The plan that finds out what stands on the table: look, vote, decide, turn, until the answer is clear (AHBR)."""

from collections.abc import Generator

import numpy as np
from numpy.typing import NDArray

import hbr
from hbr.angles import wrap360
from rig.bench import Bench
from rig.clock import seconds_between
from rig.config import IdentifyConfig
from rig.errors import CatalogError
from rig.plans.capture import capture, moved
from rig.plans.events import Accepted, Candidate, Decided, Event, Identified, Ranked, Started
from rig.turntable import Turntable
from rig.view import Viewer

SHOWN = 5
"""Candidates that an event names."""


def identify(bench: Bench, index: hbr.ViewIndex) -> Generator[Event, None, Identified]:
    """Identify the object on the table against the enrolled views; yields events and returns the answer.

    The first two views are a fixed step apart, every later one lies where the rivals look less alike (Eq. 5-7). The
    search ends when a known object leads all others by ``identify.margin`` a view, or after ``identify.max_views``; an
    object whose score a view stays below ``identify.min_score`` is unknown; where that is not given, below what the
    enrolled views let expect (`hbr.familiar_score`). Closing the generator takes the torque off.

    Raises
    ------
    CatalogError
        Nothing is enrolled.
    ViewRejected, MotionTimeout, DeviceFault, DeviceSilent
        See `rig.view` and `rig.turntable`.
    """
    if not len(index.views):
        raise CatalogError("The catalog is empty.", next_step="Enroll at least one object: rig enroll NAME.")
    config = bench.config.identify
    min_score = hbr.familiar_score(index.views) if config.min_score is None else config.min_score
    viewer = Viewer(bench.camera, bench.config.view)
    yield Started("identify", None, config.max_views, dict(bench.conditions))
    bench.operator.place(None)
    started_ns = bench.clock.now_ns()
    descriptors: list[NDArray[np.uint8]] = []
    orientations: list[float] = []
    travelled_deg = 0.0
    with Turntable(bench) as table:
        move = table.hold()
        orientation_deg = -move.encoder_deg
        while True:
            number = len(descriptors)
            yield moved(number, move)
            shot = yield from capture(number, viewer, table, move.settled_ns)
            descriptors.append(viewer.describe(shot.image_bgr))
            orientations.append(orientation_deg)
            yield Accepted(number, float(wrap360(orientation_deg)), shot.evidence, shot.image_bgr)
            ranking = hbr.retrieve(
                np.array(descriptors),
                np.array(orientations),
                index,
                omega=config.omega,
                list_length=config.list_length,
                extension=config.extension,
            )
            ranked = _ranked(number, ranking, hbr.lead(ranking, np.array(descriptors)))
            yield ranked
            reason = _finished(config, ranked, number + 1, min_score)
            if reason:
                break
            decided = _decide(config, number, ranking, table)
            yield decided
            move = table.goto(decided.target_deg)
            travelled_deg += abs(move.rotation_deg)
            orientation_deg -= move.rotation_deg  # as the table turns, the camera goes around the object backwards
    best = ranked.candidates[0]
    answer = Identified(
        name=best.name if best.score >= min_score else None,
        candidates=ranked.candidates,
        score=best.score,
        margin=ranked.margin,
        min_score=min_score,
        pose_deg=best.pose_deg,
        yaw_deg=float(wrap360(orientation_deg - best.pose_deg)),
        views=len(descriptors),
        travelled_deg=travelled_deg,
        seconds=seconds_between(started_ns, bench.clock.now_ns()),
        reason=reason,
    )
    yield answer
    return answer


def _ranked(number: int, ranking: hbr.Ranking, lead: float) -> Ranked:
    views = number + 1
    candidates = tuple(
        Candidate(name, float(score) / views, float(pose_deg))
        for name, score, pose_deg in zip(ranking.names[:SHOWN], ranking.scores, ranking.pose_deg, strict=False)
    )
    return Ranked(number, candidates, lead / views)


def _finished(config: IdentifyConfig, ranked: Ranked, views: int, min_score: float) -> str:
    """Return why the search ends, or nothing where it goes on: nobody is called unknown at a first glance."""
    known = ranked.candidates[0].score >= min_score
    if views >= config.min_views and known and ranked.margin >= config.margin:
        return f"the lead of {ranked.margin:.3f} a view passes {config.margin:g}"
    if views >= config.max_views:
        return f"{config.max_views} views were taken"
    return ""


def _decide(
    config: IdentifyConfig,
    number: int,
    ranking: hbr.Ranking,
    table: Turntable,
) -> Decided:
    if number == 0:
        rotation_deg = config.first_step_deg
        side = "left" if rotation_deg >= 0 else "right"
        target_deg = table.within_reach(table.rest_deg - rotation_deg)
        return Decided(number, side, rotation_deg, target_deg, None, None, ())
    decision = hbr.next_view(ranking)
    names = ranking.views.object_names
    return Decided(
        index=number,
        side=decision.side,
        rotation_deg=decision.rotation_deg,
        target_deg=table.within_reach(table.rest_deg - decision.rotation_deg),
        s_left=decision.s_left,
        s_right=decision.s_right,
        rivals=tuple(names[i] for i in decision.candidates[:SHOWN]),
    )
