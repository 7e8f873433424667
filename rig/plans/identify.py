"""The plans that identify the object on the table, once or one object after the other.

View, rank, decide, rotate, until the search ends.

Decision: docs/decisions/0002.
"""

from collections.abc import Callable, Generator, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from hbr.dense.last_steps import answered
from hbr.dense.local_difference import LocalView
from rig.bench import Bench, Placer
from rig.config import RigConfig
from rig.core.errors import CatalogError, MotionStopped, NoObject, RigError, ViewRejected
from rig.events.events import (
    Event,
    Failed,
    FrameUsed,
    Identified,
    Note,
    NoteCode,
    Started,
    Waiting,
    WaitReason,
    Warned,
)
from rig.motion.scan_speed import can_fly, require_camera_time
from rig.motion.turntable import Turntable
from rig.plans.capture import announced, check_camera, check_object, moved
from rig.plans.search_views import ViewsAtRest, ViewsInMotion
from rig.search.model import Model, begin_search, empty_table_for
from rig.search.session import SHOWN, Hypotheses, Search
from rig.search.strategies import AnyStrategy, Rotate
from rig.views.capture import Viewer
from rig.views.description import SearchDescriber
from rig.views.empty_table import empty_table_status


def identify(
    bench: Bench,
    model: Model,
    *,
    config: RigConfig | None = None,
    placer: Placer | None = None,
    strategy: AnyStrategy | str | None = None,
    seed: int = 0,
    top: int = SHOWN,
    empty_table: NDArray[np.uint8] | None = None,
    live: Callable[[FrameUsed], object] = lambda _: None,
) -> Generator[Event, None, Identified]:
    """Identify the object on the table; yields events and returns the answer.

    After each view the strategy chooses the next view or ends the search (`rig.search.strategies`). ``dense`` is the
    bench's own: it takes the next best view until the stopping rule, which was fitted to the catalog, finds an
    object or calls it unknown. ``ahbr`` is the paper's: the first rotation is fixed, and each further one leads to the
    side on which the candidates look less similar (Eq. 5-7). The search ends when an enrolled object leads all others
    by ``identify.margin`` per view, or after ``identify.max_views``. The object is unknown if its score per view is
    below ``identify.min_score``; the default comes from the scores of the enrolled views among each other
    (`hbr.open_set_threshold`). Closing the generator turns the torque off.

    Parameters
    ----------
    bench
        An open bench.
    model
        The enrolled views, from `rig.search.model.load_model` or `rig.search.model.model_of`.
    config
        The settings of the search, if they are not those of the bench.
    placer
        Puts the object on the table, or waits for it; the default is that of the bench.
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
    config = config or bench.config
    if strategy is None and _flies(config, model):
        strategy = "arc"
    search = begin_search(model, config, strategy, seed=seed, top=top)
    if search.in_motion:
        require_camera_time(bench.config)
    viewer = Viewer(bench.camera, bench.config)
    check_camera(bench, model.camera)
    notes = model.notes
    if empty_table is None:
        empty_table, more = empty_table_for(bench, model)
        notes += more
    own = empty_table_status(bench).table if empty_table is None else None
    describe = SearchDescriber(
        bench.config.view,
        search.descriptor,
        empty_table,
        revise=not search.in_motion,
        # a camera that moves around the object sees another background in each view
        bench_image=None if bench.config.table.carries == "camera" else model.bench_image,
    )
    check = partial(check_object, bench, empty_table=empty_table if own is None else own.image_bgr)
    (placer or bench).place(None)
    yield Started(
        "identify",
        None,
        config.identify.max_views,
        dict(bench.conditions),
        strategy=search.strategy.name,
        seed=seed,
        descriptor=search.descriptor,
        notes=notes,
    )
    # Take views until the search ends.
    kind = ViewsInMotion if search.in_motion else ViewsAtRest
    views = kind(bench, search, viewer, describe, check, live)
    try:
        with views.table as table:
            yield from views.begin()
            while not views.is_over:
                yield from views.view()
                if isinstance(search.step, Rotate):
                    yield from views.rotate(search.step)
            seconds = views.seconds
            failed = yield from _unwound(views.number, table)
    except MotionStopped:
        raise
    except Exception:
        # The events of an interrupted arc come when the torque is off, because their consumer may pause.
        yield from views.unseen
        raise
    yield from _last_steps(model, search, describe.hypotheses)
    answer = search.answer(travelled_deg=views.travelled_deg, seconds=seconds)
    yield answer
    if failed:  # the answer is reported first
        raise failed
    return answer


def _flies(config: RigConfig, model: Model) -> bool:
    """Return whether a search without a named strategy takes frames in motion, by ``identify.mode``."""
    is_dense = model.rule is not None
    mode = config.identify.mode
    return is_dense and config.identify.strategy is None and (mode == "fly" or (mode == "auto" and can_fly(config)))


def _unwound(number: int, table: Turntable) -> Generator[Event, None, RigError | None]:
    """Unwind the cable by whole revolutions, so that the camera sees the same side as before; return the error."""
    target_deg = table.unwound_deg()
    try:
        if table.unwound_revolutions(target_deg):
            yield from announced(number, table, target_deg)
    except RigError as error:
        return error
    return None


def _last_steps(model: Model, search: Search, hypotheses: Hypotheses) -> Generator[Event, None, None]:
    """Take the last steps of a search. If an enrolled image is missing, the answer is the one without it."""
    missing: list[CatalogError] = []

    def enrolled(object_index: int, azimuths_deg: Sequence[float]) -> Sequence[LocalView] | None:
        try:
            return None if model.leader_views is None else model.leader_views(search.names[object_index], azimuths_deg)
        except CatalogError as error:
            missing.append(error)
            return None

    for step in search.last_steps(hypotheses):
        event = answered(step, enrolled)
        for error in missing:
            values = {key: value for key, value in error.as_dict().items() if key in ("what", "next_step", "steps")}
            yield Warned(search.ranked.index, Note(NoteCode.NOT_COMPARED, values))
        missing.clear()
        if event is not None:
            yield event


def watch(
    bench: Bench, identify_next: Callable[[], Generator[Event, None, Identified]]
) -> Generator[Event, None, None]:
    """Identify one object after the other, until closed; yields a `Waiting` before the events of each.

    After each answer the table returns to its start angle and unwinds its cable. If no view of an object is acceptable,
    or no object is on the table, the plan yields `Failed` and waits for the next object; any other error ends the plan.

    Parameters
    ----------
    bench
        An open bench.
    identify_next
        Begins `identify` for the next object, with a model of what is enrolled then. Its placer brings the objects,
        or waits for them.

    Raises
    ------
    RigError
        As `identify`, except for `NoObject` and `ViewRejected`.
    """
    with Turntable(bench) as table:
        home_deg = table.rest_deg
    reason = WaitReason.FIRST_OBJECT
    while True:
        yield Waiting(reason)
        reason = WaitReason.NEXT_OBJECT
        try:
            views = (yield from identify_next()).views
        except (NoObject, ViewRejected) as error:
            yield Failed(**error.as_dict())
            views = 0
        with Turntable(bench) as table:
            if abs(table.rest_deg - home_deg) > bench.config.table.tolerance_deg:
                yield moved(views, table.goto(home_deg))
