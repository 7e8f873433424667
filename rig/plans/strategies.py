"""What to do next in a search: turn on, and how far, or stop; each time in words.

`identify` asks one `Strategy` after every view. Four come with the rig; others plug in by an object of their own, or by
name through the entry-point group `rig.strategies`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from difflib import get_close_matches
from importlib.metadata import entry_points
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

import hbr
from hbr.angles import wrap180
from rig.config import IdentifyConfig
from rig.errors import UsageError
from rig.plans.words import likeness_words

GROUP: Final = "rig.strategies"

_REVISIT_DEG: Final = 10.0
_DRAWS: Final = 20


@dataclass(frozen=True, slots=True, eq=False)
class Look:
    """What is known after a view.

    Attributes
    ----------
    index : hbr.ViewIndex
        The enrolled views.
    queries : uint8 array (N, 144)
        Descriptors of the views so far, in their order.
    ranking : hbr.Ranking
        What they say; `ranking.orientation_deg` is where each was taken.
    score, margin
        Of the leading candidate, per view: its Hough score, and how far it surely leads (`hbr.lead`).
    min_score
        Below this score a view the object counts as unknown.
    table_deg, limits_deg
        Where the table stands, unwrapped, and how far its cable reaches.
    config
        The settings of a search.
    rng
        For strategies that draw: seeded, so that a saved run can be computed again.
    """

    index: hbr.ViewIndex
    queries: NDArray[np.uint8]
    ranking: hbr.Ranking
    score: float
    margin: float
    min_score: float
    table_deg: float
    limits_deg: tuple[float, float]
    config: IdentifyConfig
    rng: np.random.Generator

    @property
    def views(self) -> int:
        """How many views there are."""
        return len(self.queries)


@dataclass(frozen=True, slots=True)
class Turn:
    """Look again, ``rotation_deg`` further around the object, positive to the left; ``why`` in words.

    ``s_left`` and ``s_right`` say how alike the ``rivals`` (names) look from either side, where that was asked.
    """

    rotation_deg: float
    why: str
    s_left: float | None = None
    s_right: float | None = None
    rivals: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Stop:
    """Look no further; ``why`` in words."""

    why: str


class Strategy(Protocol):
    """Decides after each view."""

    @property
    def name(self) -> str:
        """By which it is asked for, and which is kept with a run."""
        ...

    def next(self, look: Look) -> Turn | Stop:
        """Return where to look next, or that it is enough. The same look and draws give the same answer."""
        ...


def enough(look: Look) -> Stop | None:
    """Return the reason to stop that most strategies share, or None.

    A search is over when a known object leads all others by ``identify.margin`` a view, or ``identify.max_views`` were
    taken; nobody is called unknown at a first glance.
    """
    config = look.config
    if look.views >= config.min_views and look.score >= look.min_score and look.margin >= config.margin:
        return Stop(f"the lead of {look.margin:.3f} a view passes {config.margin:g}")
    return spent(look)


def spent(look: Look) -> Stop | None:
    """Return the reason to stop when all views that are allowed were taken, or None."""
    if look.views >= look.config.max_views:
        return Stop(f"{look.config.max_views} views were taken")
    return None


class Active:
    """AHBR: turn to the side where the candidates look less alike (Eq. 5-7); the first turn is fixed."""

    name = "ahbr"

    def next(self, look: Look) -> Turn | Stop:
        if stop := enough(look):
            return stop
        if look.views == 1:
            return Turn(look.config.first_step_deg, "the first turn is fixed")
        decision = hbr.next_view(look.ranking)
        names = look.ranking.views.object_names
        rivals = tuple(names[i] for i in decision.candidates)
        why = likeness_words(decision.side, decision.s_left, decision.s_right, rivals)
        return Turn(decision.rotation_deg, why, decision.s_left, decision.s_right, rivals)


class Sweep:
    """All around in even steps, one for each view that is allowed, until the answer is clear."""

    name = "sweep"

    def next(self, look: Look) -> Turn | Stop:
        views = look.config.max_views
        return enough(look) or Turn(360.0 / views, f"the sweep goes around in {views} even steps")


class Random:
    """Anywhere that was not seen yet, until the answer is clear."""

    name = "random"

    def next(self, look: Look) -> Turn | Stop:
        return enough(look) or Turn(_draw(look), "a turn drawn at random")


class Passive:
    """HBR as the paper measures it: views at random, all that are allowed, and only then an answer."""

    name = "hbr"

    def next(self, look: Look) -> Turn | Stop:
        return spent(look) or Turn(_draw(look), f"view {look.views + 1} of {look.config.max_views}, drawn at random")


BUILT_IN: Final[dict[str, Callable[[], Strategy]]] = {
    strategy.name: strategy for strategy in (Passive, Active, Sweep, Random)
}


def names() -> list[str]:
    """Return the names of all strategies that can be asked for, the plugged-in ones behind the rig's own."""
    return [*BUILT_IN, *sorted({point.name for point in entry_points(group=GROUP)} - set(BUILT_IN))]


def strategy(name: str) -> Strategy:
    """Return the strategy of that name.

    Raises
    ------
    UsageError
        There is none, or the plug-in that should bring it cannot be loaded.
    """
    if name in BUILT_IN:
        return BUILT_IN[name]()
    for point in entry_points(group=GROUP):
        if point.name == name:
            try:
                plugged: Strategy = point.load()()
            except (ImportError, AttributeError, TypeError) as error:
                raise UsageError(
                    f"The strategy {name!r} of {point.value} cannot be loaded.",
                    next_step="Mend or uninstall the package that brings it, or choose another strategy.",
                    evidence={"reason": str(error)},
                ) from error
            return plugged
    near = get_close_matches(name, names(), n=1)
    raise UsageError(
        f"There is no strategy {name!r}.",
        next_step=f"Did you mean {near[0]}?" if near else "Choose one of those listed.",
        evidence={"strategies": names()},
    )


def _draw(look: Look) -> float:
    """A rotation that leads to where no view was taken yet; the last one drawn where everything has been seen."""
    seen_deg = look.ranking.orientation_deg
    for _ in range(_DRAWS):
        rotation_deg = float(look.rng.uniform(-180.0, 180.0))
        if np.all(np.abs(wrap180(seen_deg[-1] + rotation_deg - seen_deg)) > _REVISIT_DEG):
            break
    return rotation_deg
