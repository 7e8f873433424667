"""The plan that never ends: whatever is put on the table is identified, one object after the other."""

from collections.abc import Callable, Generator

import numpy as np
from numpy.typing import NDArray

import hbr
from rig.bench import Bench
from rig.core.errors import ViewRejected
from rig.events.events import Event, Failed, Waiting
from rig.motion.turntable import Turntable
from rig.plans.capture import moved
from rig.plans.identify import identify
from rig.search.model import Model
from rig.search.session import SHOWN
from rig.search.strategies import AnyStrategy


def watch(
    bench: Bench,
    model: Callable[[], Model | hbr.ViewIndex],
    *,
    strategy: AnyStrategy | str | None = None,
    seed: int = 0,
    top: int = SHOWN,
    empty_table: NDArray[np.uint8] | None = None,
) -> Generator[Event, None, None]:
    """Identify one object after the other, endlessly; yields a `Waiting` before the events of each.

    The bench's operator brings the objects, or waits for them (`rig.views.object_presence.TableWatcher`). After each
    answer the table returns to its start angle and unwinds its cable. If no view of an object is acceptable, the plan
    yields `Failed` and waits for the next object; any other error ends the plan.

    Parameters
    ----------
    bench
        An open one.
    model
        Gives what is enrolled, before each search: what was enrolled meanwhile is found.
    strategy, seed, top, empty_table
        As for `identify`.

    Raises
    ------
    RigError
        As `identify`, but for `ViewRejected`.
    """
    with Turntable(bench) as table:
        home_deg = table.rest_deg
    begun = False
    while True:
        yield Waiting("the next object" if begun else "the first object, on the empty table")
        begun = True
        try:
            answer = yield from identify(bench, model(), strategy=strategy, seed=seed, top=top, empty_table=empty_table)
            views = answer.views
        except ViewRejected as error:
            yield Failed(**{key: error.as_dict()[key] for key in ("error", "code", "what", "evidence", "next_step")})
            views = 0
        with Turntable(bench) as table:
            if abs(table.rest_deg - home_deg) > bench.config.table.tolerance_deg:
                yield moved(views, table.goto(home_deg))
