"""The plan that identifies the object on the table: view, rank, decide, rotate, until the search ends.

Decision: docs/decisions/0002.
"""

from collections.abc import Callable, Generator
from functools import partial

import numpy as np
from numpy.typing import NDArray

from hbr.core.angles import wrap360
from rig.bench import Bench
from rig.config import RigConfig
from rig.core.clock import seconds_between
from rig.events.events import Event, FrameUsed, Identified, Started
from rig.motion.scan_speed import can_fly, require_camera_time
from rig.motion.turntable import Turntable
from rig.plans.capture import announced, check_camera, check_object, moved
from rig.plans.identify_moving import search_in_motion
from rig.plans.search_steps import Searched, SearchSteps, unwound
from rig.search.model import Model, begin_search, empty_table_for
from rig.search.session import SHOWN
from rig.search.strategies import AnyStrategy, Finish
from rig.views.capture import Viewer
from rig.views.description import SearchDescriber
from rig.views.empty_table import empty_table_status
from rig.views.object_presence import TableWatcher


def identify(
    bench: Bench,
    model: Model,
    *,
    config: RigConfig | None = None,
    watcher: TableWatcher | None = None,
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
    watcher
        Waits until the object is on the table; by default the bench's own operator.
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
    if strategy is None and flies(config, model):
        strategy = "arc"
    search, chosen = begin_search(model, config, strategy, seed=seed, top=top)
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
    steps = SearchSteps(bench, model, search, viewer, describe, check, top)
    (watcher or bench.operator).place(None)
    yield Started(
        "identify",
        None,
        config.identify.max_views,
        dict(bench.conditions),
        strategy=chosen.name,
        seed=seed,
        descriptor=search.descriptor,
        notes=notes,
    )
    found = yield from search_in_motion(steps, live) if search.in_motion else _search_at_rest(steps)
    answer = yield from steps.end(travelled_deg=found.travelled_deg, seconds=found.seconds)
    yield answer
    if found.failed:
        raise found.failed
    return answer


def _search_at_rest(steps: SearchSteps) -> Generator[Event, None, Searched]:
    """Take views at rest until the search ends."""
    bench, search = steps.bench, steps.search
    started_ns = bench.clock.now_ns()
    sign = bench.config.table.orientation_sign  # the camera moves opposite to the table
    travelled_deg = 0.0
    number = 0
    with Turntable(bench) as table:
        move = table.hold()
        orientation_deg = sign * move.encoder_deg
        while True:
            yield moved(number, move)
            yield from steps.view(number, table, move.settled_ns, float(wrap360(orientation_deg)))
            step = search.step
            if isinstance(step, Finish):
                break
            # Rotate: within the cable budget, and use the measured rotation.
            asked_deg = table.rest_deg + sign * step.rotation_deg
            target_deg = table.within_reach(asked_deg)
            yield steps.decided(number, step, target_deg)
            move = yield from announced(number, table, target_deg, asked_deg=asked_deg)
            travelled_deg += abs(move.rotation_deg)
            orientation_deg += sign * move.rotation_deg
            number += 1
        seconds = seconds_between(started_ns, bench.clock.now_ns())
        failed = yield from unwound(number, table)
    return Searched(travelled_deg, seconds, failed)


def flies(config: RigConfig, model: Model) -> bool:
    """Return whether a search without a named strategy takes frames in motion, by ``identify.mode``."""
    is_dense = model.rule is not None
    mode = config.identify.mode
    return is_dense and config.identify.strategy is None and (mode == "fly" or (mode == "auto" and can_fly(config)))
