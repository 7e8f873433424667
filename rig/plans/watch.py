"""The plan that never ends: whatever is put on the table is identified, one object after the other."""

from collections.abc import Callable, Generator

import hbr
from rig.bench import Bench
from rig.errors import ViewRejected
from rig.plans.capture import moved
from rig.plans.events import Event, Failed, Waiting
from rig.plans.identify import identify
from rig.plans.search import SHOWN
from rig.plans.strategies import Strategy
from rig.turntable import Turntable


def watch(
    bench: Bench,
    model: Callable[[], hbr.ViewIndex],
    *,
    strategy: Strategy | str = "ahbr",
    seed: int = 0,
    top: int = SHOWN,
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
        Gives the enrolled views, before each search: what was enrolled meanwhile is found.
    strategy, seed, top
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
            answer = yield from identify(bench, model(), strategy=strategy, seed=seed, top=top)
            views = answer.views
        except ViewRejected as error:
            yield Failed(**{key: error.as_dict()[key] for key in ("error", "code", "what", "evidence", "next_step")})
            views = 0
        with Turntable(bench) as table:
            if abs(table.rest_deg - home_deg) > bench.config.table.tolerance_deg:
                yield moved(views, table.goto(home_deg))
