"""The plan that finds out what stands on the table: look, vote, decide, turn, until the answer is clear.

Decision: docs/decisions/0002.
"""

from collections.abc import Generator

import numpy as np
from numpy.typing import NDArray

import hbr
from hbr.core.angles import wrap360
from rig.bench import Bench
from rig.core.clock import seconds_between
from rig.core.errors import RigError
from rig.events.events import Accepted, Decided, Event, Identified, Started
from rig.motion.turntable import Turntable
from rig.plans.capture import announced, capture, moved, unwind, warn_of_table
from rig.search.model import Model, empty_table_for
from rig.search.session import SHOWN, begin_search
from rig.search.strategies import AnyStrategy, Finish, Rotate
from rig.views.capture import Viewer
from rig.views.description import ViewDescriber


def identify(
    bench: Bench,
    model: Model | hbr.ViewIndex,
    *,
    strategy: AnyStrategy | str | None = None,
    seed: int = 0,
    top: int = SHOWN,
    empty_table: NDArray[np.uint8] | None = None,
) -> Generator[Event, None, Identified]:
    """Identify the object on the table against the enrolled views; yields events and returns the answer.

    After each view the strategy chooses the next view or ends the search (`rig.search.strategies`).
    ``dense`` is the bench's own: it turns to where the likeliest objects differ most, until one is
    probable enough, or unknown, by rules that were rehearsed on the catalog. ``ahbr`` is the paper's: the first two
    views are a fixed step apart, every later one lies where the rivals look less alike (Eq. 5-7), until a known object
    leads all others by ``identify.margin`` a view, or ``identify.max_views`` were taken. Its object is unknown when its
    score a view stays below ``identify.min_score``; where that is not given, below what the enrolled views let expect
    (`hbr.open_set_threshold`). Closing the generator takes the torque off.

    Parameters
    ----------
    bench
        An open bench.
    model : Model or hbr.ViewIndex
        What is enrolled, as `rig.search.model.load_model` has it; a ViewIndex is for the paper's strategies.
    strategy
        Its name, or a strategy of your own; None takes the one that the model is for.
    seed
        For strategies that draw.
    top
        How many candidates the events name.
    empty_table : uint8 array (H, W, 3), optional
        The bench without an object: the object is found by what differs from it. Where none is given, the one that
        `rig.search.model.empty_table_for` has.

    Raises
    ------
    CatalogError
        Nothing is enrolled.
    UsageError
        There is no such strategy, or the model is not for it.
    ViewRejected, MotionTimeout, DeviceFault, DeviceSilent
        See `rig.views.capture` and `rig.motion.turntable`.
    """
    config = bench.config.identify
    search, chosen = begin_search(model, bench.config, strategy, seed=seed, top=top)
    viewer = Viewer(bench.camera, bench.config.view)
    notes = model.notes if isinstance(model, Model) else ()
    if empty_table is None and isinstance(model, Model):
        empty_table, told = empty_table_for(bench, model)
        notes += told
    describe = ViewDescriber(bench.config.view, (search.descriptor,), empty_table)
    yield Started(
        "identify",
        None,
        config.max_views,
        dict(bench.conditions),
        strategy=chosen.name,
        seed=seed,
        descriptor=search.descriptor,
        notes=notes,
    )
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
            seen = describe(shot.image_bgr)
            yield Accepted(number, azimuth_deg, shot.evidence, shot.image_bgr, seen.segmentation)
            yield from warn_of_table(bench, number, seen, "The search continues without the image")
            ranked, step = search.look(seen.levels[search.descriptor], azimuth_deg, table_deg=table.rest_deg)
            yield ranked
            if isinstance(step, Finish):
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
    answer = search.answer(ranked, step.why, travelled_deg=travelled_deg, seconds=seconds)
    yield answer
    if trouble:
        raise trouble
    return answer


def _decided(number: int, turn: Rotate, target_deg: float, top: int) -> Decided:
    return Decided(
        index=number,
        side="left" if turn.rotation_deg >= 0 else "right",
        rotation_deg=turn.rotation_deg,
        target_deg=target_deg,
        s_left=turn.s_left,
        s_right=turn.s_right,
        rivals=turn.rivals[:top],
        why=turn.why,
        weighed=turn.weighed,
    )
