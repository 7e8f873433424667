"""A search without its hardware: views in, ranking and decision out. The bench runs it, and a replay runs it again."""

from abc import ABC, abstractmethod
from dataclasses import replace
from math import isfinite
from typing import Final, cast

import numpy as np
from numpy.typing import NDArray

import hbr
from hbr.core.angles import wrap360
from hbr.dense.filter import KEPT
from rig.config import RigConfig
from rig.core.errors import CatalogError, UsageError
from rig.events.events import Candidate, Identified, Ranked
from rig.events.wording import verdict_words
from rig.search.model import Model
from rig.search.strategies import (
    DenseSearchState,
    DenseStrategy,
    Finish,
    Rotate,
    SearchState,
    Strategy,
    descriptor_for,
    is_dense,
    reachable_turns,
    strategy_for,
)
from rig.search.strategies import strategy as strategy_named

SHOWN: Final = 5
"""Candidates that an event names at most, unless more are asked for."""

_WORTH_IT: Final = 2


class Search(ABC):
    """What the views so far say about the object, and what to do next; `begin_search` makes one.

    Attributes
    ----------
    descriptor
        What its queries must be described by.
    """

    def __init__(self, views: hbr.Views, config: RigConfig, *, seed: int, top: int) -> None:
        self.descriptor = views.descriptor
        self._config = config
        self._top = top
        self._rng = np.random.default_rng(seed)
        self._orientations: list[float] = []

    @property
    @abstractmethod
    def min_score(self) -> float:
        """Score a view below which the leading object counts as unknown; 0 where nothing does."""

    def look(
        self, levels: NDArray[np.uint8], azimuth_deg: float, *, table_deg: float
    ) -> tuple[Ranked, Rotate | Finish]:
        """Take the next view; return what is thought now, and what to do.

        Parameters
        ----------
        levels : uint8 array (length,)
            The view by the search's descriptor.
        azimuth_deg
            Orientation of the camera around the object, from any zero that all views share, in [0, 360).
        table_deg
            Where the table stands, unwrapped.
        """
        self._orientations.append(azimuth_deg)
        ranked = self._vote(levels)
        return ranked, self._next(ranked, table_deg)

    @abstractmethod
    def _vote(self, levels: NDArray[np.uint8]) -> Ranked: ...

    @abstractmethod
    def _next(self, ranked: Ranked, table_deg: float) -> Rotate | Finish: ...

    def answer(self, ranked: Ranked, reason: str, *, travelled_deg: float = 0.0, seconds: float = 0.0) -> Identified:
        """Return what is known when the search ends."""
        best = ranked.candidates[0]
        return Identified(
            name=best.name if best.score >= self.min_score else None,
            candidates=ranked.candidates,
            score=best.score,
            margin=ranked.margin,
            min_score=self.min_score,
            pose_deg=best.pose_deg,
            yaw_deg=float(wrap360(self._orientations[-1] - best.pose_deg)),
            views=len(self._orientations),
            travelled_deg=travelled_deg,
            seconds=seconds,
            reason=reason,
        )


class HoughSearch(Search):
    """The paper's: views vote by lists of the most similar enrolled ones (`hbr.retrieve`)."""

    def __init__(self, index: hbr.ViewIndex, config: RigConfig, strategy: Strategy, *, seed: int, top: int) -> None:
        super().__init__(index.views, config, seed=seed, top=top)
        given = config.identify.min_score
        self._min_score = (
            hbr.open_set_threshold(index.views, repeatability=config.identify.repeatability) if given is None else given
        )
        self._index = index
        self._strategy = strategy
        self._descriptors: list[NDArray[np.uint8]] = []

    @property
    def min_score(self) -> float:
        return self._min_score

    def _vote(self, levels: NDArray[np.uint8]) -> Ranked:
        self._descriptors.append(levels)
        self._queries = queries = np.array(self._descriptors)
        config = self._config.identify
        self._ranking = ranking = hbr.retrieve(
            queries,
            np.array(self._orientations),
            self._index,
            omega=config.omega,
            list_length=config.list_length,
            extension=config.extension,
        )
        views = len(queries)
        candidates = tuple(
            Candidate(name, float(score) / views, float(pose_deg))
            for name, score, pose_deg in zip(ranking.names[: self._top], ranking.scores, ranking.pose_deg, strict=False)
        )
        return Ranked(views - 1, candidates, hbr.score_margin(ranking, queries) / views)

    def _next(self, ranked: Ranked, table_deg: float) -> Rotate | Finish:
        look = SearchState(
            index=self._index,
            queries=self._queries,
            ranking=self._ranking,
            score=ranked.candidates[0].score,
            margin=ranked.margin,
            min_score=self.min_score,
            table_deg=table_deg,
            limits_deg=self._config.table.limits_deg,
            config=self._config.identify,
            rng=self._rng,
        )
        return self._strategy.next(look)


class DenseSearch(Search):
    """The bench's own: every object from every azimuth has a probability (`hbr.update_belief`)."""

    def __init__(
        self,
        index: hbr.DenseIndex,
        rules: hbr.Rules,
        config: RigConfig,
        strategy: DenseStrategy,
        *,
        seed: int,
        top: int,
    ) -> None:
        super().__init__(index.views, config, seed=seed, top=top)
        self._rules = rules
        self._strategy = strategy
        # to take a part of the views out costs more than it saves where a search ends after one or two
        self._kept = KEPT if len(index) > _WORTH_IT * KEPT else len(index)
        self._so_far: hbr.DenseIndex | hbr.Belief = index
        self._belief: hbr.Belief
        self._verdict: hbr.Verdict
        self._best_score = 0.0
        self._words = ""

    @property
    def min_score(self) -> float:
        """The score that would make the leading object, with this lead, as familiar as enrolled ones are."""
        return max(0.0, self._best_score + self._least - self._verdict.familiarity)

    @property
    def _least(self) -> float:
        return self._rules.familiar[min(self._belief.queries, len(self._rules.familiar)) - 1]

    def _vote(self, levels: NDArray[np.uint8]) -> Ranked:
        self._so_far = self._belief = belief = hbr.update_belief(
            levels, self._orientations[-1], self._so_far, kept=self._kept
        )
        verdict, least = judged(belief, self._rules, max_views=self._config.identify.max_views)
        self._words = verdict_words(verdict, certainty=self._rules.certainty, least=least, views=belief.queries)
        self._verdict = replace(verdict, words=self._words)
        odds = belief.posterior(self._rules.beta).sum(axis=1)
        scores = belief.scores()
        ranking = belief.ranking()
        pose_deg = dict(zip(ranking.object_index.tolist(), ranking.pose_deg.tolist(), strict=True))
        objects = belief.index.object_index.tolist()
        order = np.lexsort((-scores, -odds)).tolist()
        names = belief.index.views.object_names
        candidates = tuple(
            Candidate(names[objects[i]], float(scores[i]), pose_deg[objects[i]], float(odds[i]))
            for i in order[: self._top]
        )
        self._best_score = candidates[0].score
        others = float(scores[order[1:]].max()) if len(order) > 1 else 0.0
        return Ranked(belief.queries - 1, candidates, self._best_score - others, self._words)

    def _next(self, ranked: Ranked, table_deg: float) -> Rotate | Finish:  # noqa: ARG002
        rotations_deg, seconds = reachable_turns(self._config, table_deg)
        look = DenseSearchState(
            belief=self._belief,
            verdict=self._verdict,
            rules=self._rules,
            rotations_deg=rotations_deg,
            seconds=seconds,
            table_deg=table_deg,
            config=self._config.identify,
            rng=self._rng,
        )
        return self._strategy.next(look)

    def answer(self, ranked: Ranked, reason: str, *, travelled_deg: float = 0.0, seconds: float = 0.0) -> Identified:
        least, familiarity = self._least, self._verdict.familiarity
        best = ranked.candidates[0]
        return replace(
            super().answer(ranked, reason, travelled_deg=travelled_deg, seconds=seconds),
            name=best.name if familiarity >= least else None,
            probability=best.probability,
            familiarity=familiarity,
            min_familiarity=least if isfinite(least) else None,
        )


def judged(belief: hbr.Belief, by: hbr.Rules, *, max_views: int) -> tuple[hbr.Verdict, float]:
    """Judge what is believed (`hbr.judge`); return that, and the familiarity that an object must have here to be found.

    Before the last of the rehearsed views that is the most that is asked of any number of views: a stranger that passes
    at a first glance is looked at once more, which costs a known object little. After them what is still unfamiliar is
    unknown, however many views may follow: of those no rate of wrong rejections was rehearsed.
    """
    verdict = hbr.judge(belief, by, max_views=max_views)
    rehearsed = len(by.familiar)
    least = by.familiar[min(belief.queries, rehearsed) - 1]
    if belief.queries < min(rehearsed, max_views):
        least = max(by.familiar)
        if verdict.kind == "found" and verdict.familiarity < least:
            return replace(verdict, kind="look"), least
    elif verdict.kind == "look" and verdict.familiarity < least:
        return hbr.judge(belief, by, max_views=belief.queries), least
    return verdict, least


def begin_search(
    model: Model | hbr.ViewIndex,
    config: RigConfig,
    strategy: Strategy | DenseStrategy | str | None = None,
    *,
    seed: int = 0,
    top: int = SHOWN,
) -> tuple[Search, Strategy | DenseStrategy]:
    """Begin a search, and return it with its strategy.

    Parameters
    ----------
    model
        What is enrolled.
    config
        Of the bench.
    strategy
        Its name, or one of your own; None takes ``dense`` where the model is for it, else ``ahbr``.
    seed
        For strategies that draw.
    top
        How many candidates are named.

    Raises
    ------
    CatalogError
        Nothing is enrolled.
    UsageError
        There is no such strategy, or the model is not for it.
    """
    if isinstance(model, hbr.ViewIndex):
        model = Model(model)
    chosen = strategy_for(model.descriptor) if strategy is None else strategy
    if isinstance(chosen, str):
        chosen = strategy_named(chosen)
    if not len(model.views):
        raise CatalogError("The catalog is empty.", next_step="Enroll at least one object: rig enroll NAME.")
    wanted = descriptor_for(chosen)
    if isinstance(model.index, hbr.DenseIndex) and is_dense(chosen) and model.rules is not None:
        if wanted == model.descriptor:
            return DenseSearch(model.index, model.rules, config, chosen, seed=seed, top=top), chosen
    elif isinstance(model.index, hbr.ViewIndex) and not is_dense(chosen):
        return HoughSearch(model.index, config, cast(Strategy, chosen), seed=seed, top=top), chosen
    raise UsageError(
        f"The strategy {chosen.name!r} compares views by {wanted}; this model has them by {model.descriptor}.",
        next_step=f"Load it by rig.search.model.load_model(catalog, descriptor={wanted!r}), or take another strategy.",
    )
