"""The plan that never ends: whatever is put on the table is identified, one object after the other."""

from collections.abc import Callable, Generator

import numpy as np
from numpy.typing import NDArray

import hbr
from rig.bench import Bench
from rig.errors import ViewRejected
from rig.plans.capture import moved
from rig.plans.events import Event, Failed, Waiting
from rig.plans.identify import identify
from rig.plans.model import Model
from rig.plans.search import SHOWN
from rig.plans.strategies import AnyStrategy
from rig.turntable import Turntable


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

    The bench's operator brings the objects, or waits for them (`rig.presence.TableWatcher`). After each answer the
    table goes back to where it stood, with its cable unwound. An object of which no acceptable view can be had is told
    as `Failed`, and the next one is waited for; any other error ends the plan.

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
