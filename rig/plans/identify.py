"""The plan that identifies the object on the table: view, rank, decide, rotate, until the search ends.

Decision: docs/decisions/0002.
"""

from collections.abc import Callable, Generator
from functools import partial

import numpy as np
from numpy.typing import NDArray

import hbr
from hbr.core.angles import wrap360
from rig.bench import Bench
from rig.config import RigConfig
from rig.core.clock import seconds_between
from rig.core.errors import CatalogError, RigError
from rig.events.events import Event, FrameUsed, Identified, Note, NoteCode, Started, Warned
from rig.motion.scan_speed import can_fly, require_camera_time
from rig.motion.turntable import Turntable
from rig.plans.capture import (
    accepted,
    add_view,
    announced,
    capture,
    check_camera,
    check_object,
    moved,
    unwind,
    warn_of_table,
)
from rig.plans.identify_moving import decided as decided_event
from rig.plans.identify_moving import search_in_motion
from rig.search.local_step import compare_leaders, verify_leader
from rig.search.model import Model, empty_table_for
from rig.search.session import SHOWN, ArcSearch, Search, begin_search
from rig.search.strategies import AnyStrategy, Finish
from rig.views.capture import Viewer
from rig.views.description import SearchDescriber
from rig.views.empty_table import empty_table_status


def identify(
    bench: Bench,
    model: Model | hbr.ViewIndex,
    *,
    strategy: AnyStrategy | str | None = None,
    seed: int = 0,
    top: int = SHOWN,
    empty_table: NDArray[np.uint8] | None = None,
    live: Callable[[FrameUsed], object] = lambda _: None,
) -> Generator[Event, None, Identified]:
    """Identify the object on the table; yields events and returns the answer.

    After each view the strategy chooses the next view or ends the search (`rig.search.strategies`). ``dense`` is the
    bench's own: it takes the next best view until the stopping rule, which was calibrated on the catalog, finds an
    object or calls it unknown. ``ahbr`` is the paper's: the first rotation is fixed, and each further one leads to the
    side on which the candidates look less similar (Eq. 5-7). The search ends when an enrolled object leads all others
    by ``identify.margin`` per view, or after ``identify.max_views``. The object is unknown if its score per view is
    below ``identify.min_score``; the default comes from the scores of the enrolled views among each other
    (`hbr.open_set_threshold`). Closing the generator turns the torque off.

    Parameters
    ----------
    bench
        An open bench.
    model : Model or hbr.ViewIndex
        The enrolled views, from `rig.search.model.load_model`; a ViewIndex is for the paper's strategies.
    strategy
        Its name, or a `Strategy` object. The default is the one that the model is for.
    seed
        For strategies that draw random numbers.
    top
        The number of candidates that the events name.
    empty_table : uint8 array (H, W, 3), optional
        The empty-table image for the segmentation; by default the one from `rig.search.model.empty_table_for`. With
        this image, or with the bench's own, an empty table is noticed.
    live
        Called with the event of each frame of a search in motion while the table rotates; the plan yields these events
        when it has stopped. It must return at once.

    Raises
    ------
    CatalogError
        Nothing is enrolled.
    CameraSettingsDiffer
        All objects were enrolled with other settings of the camera.
    UsageError
        There is no such strategy, or the model is not for it.
    NoObject
        The first view shows the empty table.
    ViewRejected, MotionTimeout, DeviceFault, DeviceSilent
        See `rig.views.capture` and `rig.motion.turntable`.
    """
    config = bench.config.identify
    if strategy is None and flies(bench.config, model):
        strategy = "arc"
    search, chosen = begin_search(model, bench.config, strategy, seed=seed, top=top)
    if isinstance(search, ArcSearch):
        require_camera_time(bench.config)
    viewer = Viewer(bench.camera, bench.config)
    notes = model.notes if isinstance(model, Model) else ()
    if isinstance(model, Model):
        check_camera(bench, model.camera)
    if empty_table is None and isinstance(model, Model):
        empty_table, more = empty_table_for(bench, model)
        notes += more
    own = empty_table_status(bench).table if empty_table is None else None
    check = partial(check_object, bench, empty_table=empty_table if own is None else own.image_bgr)
    moving = isinstance(search, ArcSearch)
    bench_image = model.bench_image if isinstance(model, Model) else None
    if bench.config.table.carries == "camera":
        bench_image = None  # the background of the object changes with each view
    describe = SearchDescriber(
        bench.config.view, search.descriptor, empty_table, revise=not moving, bench_image=bench_image
    )
    bench.operator.place(None)
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
    started_ns = bench.clock.now_ns()
    if isinstance(search, ArcSearch):
        found = yield from search_in_motion(
            bench, search, viewer, describe, check=check, top=top, started_ns=started_ns, live=live
        )
        answer = search.answer(found.ranked, found.end, travelled_deg=found.travelled_deg, seconds=found.seconds)
        answer = yield from _compared(search, answer, describe, model)
        yield answer
        if found.failed:
            raise found.failed
        return answer
    travelled_deg = 0.0
    sign = bench.config.table.orientation_sign  # the camera moves opposite to the table
    number = 0
    failed: RigError | None = None
    with Turntable(bench) as table:
        move = table.hold()
        orientation_deg = sign * move.encoder_deg
        while True:
            # View: at rest, an acceptable frame, described.
            yield moved(number, move)
            captured = yield from capture(number, viewer, table, move.settled_ns)
            azimuth_deg = float(wrap360(orientation_deg))
            described = describe(captured.image_bgr)
            yield accepted(number, azimuth_deg, captured, described)
            if number == 0:
                check(captured.image_bgr)
            yield from warn_of_table(bench, number, described)
            # Decide: rank the candidates, then rotate or finish.
            ranked, step = add_view(search, described, azimuth_deg, table.rest_deg)
            yield ranked
            if isinstance(step, Finish):
                break
            # Rotate: within the cable budget, and use the measured rotation.
            asked_deg = table.rest_deg + sign * step.rotation_deg
            decided = decided_event(number, step, table.within_reach(asked_deg), top)
            yield decided
            move = yield from announced(number, table, decided.target_deg, asked_deg=asked_deg)
            travelled_deg += abs(move.rotation_deg)
            orientation_deg += sign * move.rotation_deg
            number += 1
        seconds = seconds_between(started_ns, bench.clock.now_ns())
        try:
            yield from unwind(number, table)
        except RigError as error:
            failed = error  # report the answer first
    yield from _verified(search, describe, model)
    answer = search.answer(ranked, step, travelled_deg=travelled_deg, seconds=seconds)
    answer = yield from _compared(search, answer, describe, model)
    yield answer
    if failed:
        raise failed
    return answer


def _verified(search: Search, describe: SearchDescriber, model: Model | hbr.ViewIndex) -> Generator[Event, None, None]:
    """Compare the views with the enrolled views of a doubtful leader pixel by pixel; the answer depends on it."""
    if not isinstance(model, Model) or model.leader_views is None:
        return
    try:
        found = verify_leader(search, describe.hypotheses, model.leader_views)
    except CatalogError as error:  # an image is missing: the search has its answer without it
        number = len(search.orientations_deg) - 1
        yield Warned(number, Note(NoteCode.NOT_COMPARED, {"what": error.what, "next_step": error.next_step}))
        return
    if found is not None:
        yield found


def _compared(
    search: Search, answer: Identified, describe: SearchDescriber, model: Model | hbr.ViewIndex
) -> Generator[Event, None, Identified]:
    """Compare the two leaders pixel by pixel if the search does not end with one object; return the answer."""
    if not isinstance(model, Model) or model.leader_views is None:
        return answer
    try:
        found = compare_leaders(search, answer, describe.segmentations, model.leader_views)
    except CatalogError as error:  # an image is missing: the search has its answer without it
        yield Warned(answer.views - 1, Note(NoteCode.NOT_COMPARED, {"what": error.what, "next_step": error.next_step}))
        return answer
    if found is None:
        return answer
    yield found.event
    return found.answer_of(answer)


def flies(config: RigConfig, model: Model | hbr.ViewIndex) -> bool:
    """Return whether a search without a named strategy takes frames in motion, by ``identify.mode``."""
    is_dense = isinstance(model, Model) and isinstance(model.index, hbr.DenseIndex)
    mode = config.identify.mode
    return is_dense and config.identify.strategy is None and (mode == "fly" or (mode == "auto" and can_fly(config)))
