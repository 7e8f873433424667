"""What to do next in a search: turn on, and how far, or stop; each time in words.

`identify` asks one strategy after every view. Five come with the rig; others plug in by an object of their own, or by
name through the entry-point group `rig.strategies`. Which views a strategy is shown it says by its attribute
``descriptor``: the paper's where it has none (`Strategy`, `SearchState`), the bench's own for the dense search
(`DenseStrategy`, `DenseSearchState`).
"""

from collections.abc import Callable
from dataclasses import dataclass
from difflib import get_close_matches
from importlib.metadata import entry_points
from typing import Final, Protocol, TypeGuard

import numpy as np
from numpy.typing import NDArray

import hbr
from hbr.core.angles import wrap180
from rig.config import IdentifyConfig, RigConfig
from rig.core.errors import UsageError
from rig.events.events import Weighed
from rig.events.wording import separation_words, side_words
from rig.motion.motion_model import MotionModel
from rig.motion.move import equivalent_within
from rig.views.description import BENCH_DESCRIPTOR, PAPER_DESCRIPTOR

GROUP: Final = "rig.strategies"

TURN_STEP_DEG: Final = 5.0
"""Turns that the dense search weighs are so far apart."""

_REVISIT_DEG: Final = 10.0
_DRAWS: Final = 20


@dataclass(frozen=True, slots=True, eq=False)
class SearchState:
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
        Of the leading candidate, per view: its Hough score, and how far it surely leads (`hbr.score_margin`).
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


@dataclass(frozen=True, slots=True, eq=False)
class DenseSearchState:
    """What the dense search knows after a view.

    Attributes
    ----------
    belief : hbr.Belief
        How much every object, from every azimuth, is supported.
    verdict : hbr.Verdict
        What the rules say of it.
    rules : hbr.Rules
        When to stop and what to call unknown.
    rotations_deg, seconds : float64 arrays (a,)
        Turns of the camera around the object that the cable allows, every 5°, and how long each takes on this bench.
    table_deg
        Where the table stands, unwrapped.
    config
        The settings of a search.
    rng
        For strategies that draw: seeded, so that a saved run can be computed again.
    """

    belief: hbr.Belief
    verdict: hbr.Verdict
    rules: hbr.Rules
    rotations_deg: NDArray[np.float64]
    seconds: NDArray[np.float64]
    table_deg: float
    config: IdentifyConfig
    rng: np.random.Generator

    @property
    def views(self) -> int:
        """How many views there are."""
        return self.belief.queries


@dataclass(frozen=True, slots=True)
class Rotate:
    """Look again, ``rotation_deg`` further around the object, positive to the left; ``why`` in words.

    ``s_left`` and ``s_right`` say how alike the ``rivals`` (names) look from either side, where that was asked;
    ``weighed`` has all turns that were, where they were.
    """

    rotation_deg: float
    why: str
    s_left: float | None = None
    s_right: float | None = None
    rivals: tuple[str, ...] = ()
    weighed: Weighed | None = None


@dataclass(frozen=True, slots=True)
class Finish:
    """Look no further; ``why`` in words."""

    why: str


class Strategy(Protocol):
    """Decides after each view."""

    @property
    def name(self) -> str:
        """By which it is asked for, and which is kept with a run."""
        ...

    def next(self, look: SearchState) -> Rotate | Finish:
        """Return where to look next, or that it is enough. The same look and draws give the same answer."""
        ...


class DenseStrategy(Protocol):
    """Decides after each view, by what the dense search believes."""

    @property
    def name(self) -> str:
        """By which it is asked for, and which is kept with a run."""
        ...

    @property
    def descriptor(self) -> str:
        """By which views are described for it: ``edges+colours``, the bench's own."""
        ...

    def next(self, look: DenseSearchState) -> Rotate | Finish:
        """Return where to look next, or that it is enough. The same look and draws give the same answer."""
        ...


AnyStrategy = Strategy | DenseStrategy


def descriptor_for(strategy: AnyStrategy) -> str:
    """Return what views are described by for a strategy; the paper's where it does not say."""
    return str(getattr(strategy, "descriptor", PAPER_DESCRIPTOR))


def is_dense(strategy: AnyStrategy) -> TypeGuard[DenseStrategy]:
    """Whether a strategy is shown what the dense search believes."""
    return descriptor_for(strategy) != PAPER_DESCRIPTOR


def strategy_for(descriptor: str) -> AnyStrategy:
    """Return the strategy that is taken for views by a descriptor where nobody asks for one."""
    return Active() if descriptor == PAPER_DESCRIPTOR else Dense()


def reachable_turns(config: RigConfig, table_deg: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the turns of the camera that the cable allows, and how long each takes by the bench's motion model.

    Where the short way exceeds the cable, the table goes the long way round, which takes its time.
    """
    model = MotionModel(config)
    rotations_deg, seconds = [], []
    for rotation_deg in (np.arange(TURN_STEP_DEG - 180, 180 + TURN_STEP_DEG, TURN_STEP_DEG)).tolist():
        asked_deg = table_deg + config.table.orientation_sign * rotation_deg
        target_deg = equivalent_within(asked_deg, table_deg, config.table.limits_deg)
        if rotation_deg and target_deg is not None:
            rotations_deg.append(rotation_deg)
            seconds.append(model.move_s(target_deg - table_deg))
    return np.array(rotations_deg), np.array(seconds)


def enough(look: SearchState) -> Finish | None:
    """Return the reason to stop that most strategies share, or None.

    A search is over when a known object leads all others by ``identify.margin`` a view, or ``identify.max_views`` were
    taken; nobody is called unknown at a first glance.
    """
    config = look.config
    if look.views >= config.min_views and look.score >= look.min_score and look.margin >= config.margin:
        return Finish(f"the lead of {look.margin:.3f} a view passes {config.margin:g}")
    return spent(look)


def spent(look: SearchState) -> Finish | None:
    """Return the reason to stop when all views that are allowed were taken, or None."""
    if look.views >= look.config.max_views:
        return Finish(f"{look.config.max_views} views were taken")
    return None


class Active:
    """AHBR: turn to the side where the candidates look less alike (Eq. 5-7); the first turn is fixed."""

    name = "ahbr"

    def next(self, look: SearchState) -> Rotate | Finish:
        if stop := enough(look):
            return stop
        if look.views == 1:
            return Rotate(look.config.first_step_deg, "the first turn is fixed")
        decision = hbr.next_view(look.ranking)
        names = look.ranking.views.object_names
        rivals = tuple(names[i] for i in decision.candidates)
        why = side_words(decision.side, decision.s_left, decision.s_right, rivals)
        return Rotate(decision.rotation_deg, why, decision.s_left, decision.s_right, rivals)


class Sweep:
    """All around in even steps, one for each view that is allowed, until the answer is clear."""

    name = "sweep"

    def next(self, look: SearchState) -> Rotate | Finish:
        views = look.config.max_views
        return enough(look) or Rotate(360.0 / views, f"the sweep goes around in {views} even steps")


class Random:
    """Anywhere that was not seen yet, until the answer is clear."""

    name = "random"

    def next(self, look: SearchState) -> Rotate | Finish:
        return enough(look) or Rotate(_draw(look), "a turn drawn at random")


class Passive:
    """HBR as the paper measures it: views at random, all that are allowed, and only then an answer."""

    name = "hbr"

    def next(self, look: SearchState) -> Rotate | Finish:
        return spent(look) or Rotate(_draw(look), f"view {look.views + 1} of {look.config.max_views}, drawn at random")


class Dense:
    """The bench's own: turn to where the likeliest objects differ most, the motion counted, until the rules end it."""

    name = "dense"
    descriptor = BENCH_DESCRIPTOR

    def next(self, look: DenseSearchState) -> Rotate | Finish:
        if look.verdict.kind != "look":
            return Finish(look.verdict.words)
        if not len(look.rotations_deg):
            return Finish("the cable leaves no other view")
        ahead = hbr.next_best_view(
            look.belief, beta=look.rules.beta, rotations_deg=look.rotations_deg, seconds=look.seconds
        )
        names = look.belief.index.views.object_names
        rivals = () if ahead.pair is None else tuple(names[i] for i in ahead.pair)
        alike = None if ahead.alike is None else tuple(ahead.alike.tolist())
        chosen = ahead.rotations_deg.tolist().index(ahead.rotation_deg)
        weighed = Weighed(
            tuple(ahead.rotations_deg.tolist()), tuple(ahead.confusion.tolist()), tuple(ahead.cost.tolist()), alike
        )
        return Rotate(ahead.rotation_deg, separation_words(rivals, alike, chosen), rivals=rivals, weighed=weighed)


BUILT_IN: Final[dict[str, Callable[[], AnyStrategy]]] = {
    strategy.name: strategy for strategy in (Dense, Active, Passive, Sweep, Random)
}


def names() -> list[str]:
    """Return the names of all strategies that can be asked for, the plugged-in ones behind the rig's own."""
    return [*BUILT_IN, *sorted({point.name for point in entry_points(group=GROUP)} - set(BUILT_IN))]


def strategy(name: str) -> AnyStrategy:
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
                plugged: AnyStrategy = point.load()()
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


def _draw(look: SearchState) -> float:
    """A rotation that leads to where no view was taken yet; the last one drawn where everything has been seen."""
    seen_deg = look.ranking.orientation_deg
    for _ in range(_DRAWS):
        rotation_deg = float(look.rng.uniform(-180.0, 180.0))
        if np.all(np.abs(wrap180(seen_deg[-1] + rotation_deg - seen_deg)) > _REVISIT_DEG):
            break
    return rotation_deg
