"""The plan that identifies one object after the other, until it is stopped."""

from collections.abc import Callable, Generator

import numpy as np
from numpy.typing import NDArray

from rig.bench import Bench
from rig.config import RigConfig
from rig.core.errors import NoObject, ViewRejected
from rig.events.events import Event, Failed, FrameUsed, Waiting, WaitReason
from rig.motion.turntable import Turntable
from rig.plans.capture import moved
from rig.plans.identify import identify
from rig.search.model import Model
from rig.search.session import SHOWN
from rig.search.strategies import AnyStrategy
from rig.views.object_presence import TableWatcher


def watch(
    bench: Bench,
    model: Callable[[], Model],
    *,
    config: RigConfig | None = None,
    watcher: TableWatcher | None = None,
    strategy: AnyStrategy | str | None = None,
    seed: int = 0,
    top: int = SHOWN,
    empty_table: NDArray[np.uint8] | None = None,
    live: Callable[[FrameUsed], object] = lambda _: None,
) -> Generator[Event, None, None]:
    """Identify one object after the other, until closed; yields a `Waiting` before the events of each.

    The operator brings the objects, or the ``watcher`` waits for them. After each
    answer the table returns to its start angle and unwinds its cable. If no view of an object is acceptable, or no
    object is on the table, the plan yields `Failed` and waits for the next object; any other error ends the plan.

    Parameters
    ----------
    bench
        An open bench.
    model
        Returns the model before each search, so that objects enrolled meanwhile are found.
    config, watcher, strategy, seed, top, empty_table, live
        As for `identify`.

    Raises
    ------
    RigError
        As `identify`, except for `NoObject` and `ViewRejected`.
    """
    with Turntable(bench) as table:
        home_deg = table.rest_deg
    started = False
    while True:
        yield Waiting(WaitReason.NEXT_OBJECT if started else WaitReason.FIRST_OBJECT)
        started = True
        try:
            answer = yield from identify(
                bench,
                model(),
                config=config,
                watcher=watcher,
                strategy=strategy,
                seed=seed,
                top=top,
                empty_table=empty_table,
                live=live,
            )
            views = answer.views
        except (NoObject, ViewRejected) as error:
            yield Failed(**error.as_dict())
            views = 0
        with Turntable(bench) as table:
            if abs(table.rest_deg - home_deg) > bench.config.table.tolerance_deg:
                yield moved(views, table.goto(home_deg))
