"""A search without its hardware: views in, ranking and decision out. The bench runs it, and a replay runs it again."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from math import isfinite
from typing import Any, Final, cast

import numpy as np
from numpy.typing import NDArray

import hbr
from hbr.core.angles import wrap360
from hbr.dense.arc import ArcRule, ArcSession, calibrate_arc_rule
from hbr.dense.pose import pose
from hbr.dense.verification import Verification, found_from, is_doubtful
from hbr.descriptors.together import like_enrollment
from hbr.model.symmetry import symmetry
from rig.config import RigConfig
from rig.core.errors import CatalogError, UsageError
from rig.events.events import Candidate, FrameUsed, Identified, Ranked
from rig.search.model import Model
from rig.search.strategies import (
    Arc,
    DenseSearchState,
    DenseStrategy,
    Finish,
    Rotate,
    SearchState,
    Strategy,
    descriptor_for,
    is_dense,
    reachable_arcs,
    reachable_rotations,
    strategy_for,
)
from rig.search.strategies import strategy as strategy_named

SHOWN: Final = 5
"""Candidates that an event names by default."""


class Search(ABC):
    """One search for an object; `begin_search` makes it.

    Attributes
    ----------
    descriptor
        The descriptor that its queries need.
    """

    def __init__(self, views: hbr.Views, config: RigConfig, *, seed: int, top: int) -> None:
        self.descriptor = views.descriptor
        self._config = config
        self._top = top
        self._rng = np.random.default_rng(seed)
        self._orientations: list[float] = []
        self._earlier: Sequence[NDArray[np.uint8]] | None = None
        self._reliable = True
        self._same_bench: bool | None = None
        self._alike: bool | None = None

    def add(
        self,
        levels: NDArray[np.uint8],
        azimuth_deg: float,
        *,
        table_deg: float,
        earlier: Sequence[NDArray[np.uint8]] | None = None,
        reliable: bool = True,
        same_bench: bool | None = None,
        segmentation: Mapping[str, Any] | None = None,
    ) -> tuple[Ranked, Rotate | Finish]:
        """Add the next view; return the candidates, and the strategy's decision.

        Parameters
        ----------
        levels : uint8 array (length,) or (k, length)
            The view by the search's descriptor; for the dense search also several segmentations of it.
        azimuth_deg
            Orientation of the camera around the object, from any zero that all views share, in [0, 360).
        table_deg
            The table angle, unwrapped.
        earlier : sequence of uint8 arrays, optional
            The levels of the earlier views, which were segmented again.
        reliable, same_bench
            Whether the view was segmented reliably, and whether the bench is that of the enrollment, as for
            `hbr.DenseSession.add`.
        segmentation
            `hbr.Segmentation.evidence` of the view.
        """
        self._same_bench = self._alike = same_bench
        if segmentation is not None:
            self._alike = like_enrollment(segmentation.get("method", ""), same_bench)
        self._orientations.append(azimuth_deg)
        self._earlier, self._reliable = earlier, reliable
        ranked = self._rank(levels)
        return ranked, self._decide(ranked, table_deg)

    @property
    def orientations_deg(self) -> tuple[float, ...]:
        """Orientation of each view so far."""
        return tuple(self._orientations)

    @abstractmethod
    def _rank(self, levels: NDArray[np.uint8]) -> Ranked: ...

    @abstractmethod
    def _decide(self, ranked: Ranked, table_deg: float) -> Rotate | Finish: ...

    def answer(self, ranked: Ranked, end: Finish, *, travelled_deg: float = 0.0, seconds: float = 0.0) -> Identified:
        """Return the answer when the search ends."""
        best = ranked.candidates[0]
        return Identified(
            name=best.name,
            candidates=ranked.candidates,
            score=best.score,
            margin=ranked.margin,
            pose_deg=best.pose_deg,
            yaw_deg=(yaw_deg := float(wrap360(self._orientations[-1] - best.pose_deg))),
            yaw_set_deg=(yaw_deg,),
            views=len(self._orientations),
            travelled_deg=travelled_deg,
            seconds=seconds,
            reason=end.reason,
            outcome=hbr.Outcome.FOUND,
            possible=(best.name,),
            note=end.note,
        )


class HoughSearch(Search):
    """The paper's search: views vote by lists of the most similar enrolled views (`hbr.retrieve`)."""

    def __init__(self, index: hbr.ViewIndex, config: RigConfig, strategy: Strategy, *, seed: int, top: int) -> None:
        super().__init__(index.views, config, seed=seed, top=top)
        given = config.identify.min_score
        self._min_score = (
            hbr.open_set_threshold(index.views, repeatability=config.identify.repeatability) if given is None else given
        )
        self._index = index
        self._strategy = strategy
        self._descriptors: list[NDArray[np.uint8]] = []

    def _rank(self, levels: NDArray[np.uint8]) -> Ranked:
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

    def _decide(self, ranked: Ranked, table_deg: float) -> Rotate | Finish:
        state = SearchState(
            index=self._index,
            queries=self._queries,
            ranking=self._ranking,
            score=ranked.candidates[0].score,
            margin=ranked.margin,
            min_score=self._min_score,
            table_deg=table_deg,
            limits_deg=self._config.table.limits_deg,
            config=self._config.identify,
            rng=self._rng,
        )
        return self._strategy.next(state)

    def answer(self, ranked: Ranked, end: Finish, *, travelled_deg: float = 0.0, seconds: float = 0.0) -> Identified:
        answer = super().answer(ranked, end, travelled_deg=travelled_deg, seconds=seconds)
        outcome, possible = hbr.Outcome.FOUND, answer.possible
        if answer.score < self._min_score:
            outcome, possible = hbr.Outcome.UNKNOWN, ()
        elif answer.margin <= 0 and len(self._ranking.names) > 1:
            # Objects that share the best score; at least the second one, which is as likely by the margin.
            outcome, scores = hbr.Outcome.AMBIGUOUS, self._ranking.scores
            possible = self._ranking.names[: max(2, int((scores >= scores[0]).sum()))]
        own = symmetry(self._index.views, int(self._ranking.object_index[0]))
        period_deg = own.period_deg if own else None
        poses = round(360 / period_deg) if period_deg else 1 if period_deg is None else 0
        yaw_deg = answer.yaw_set_deg[0]
        return replace(
            answer,
            name=None if outcome is hbr.Outcome.UNKNOWN else answer.name,
            yaw_deg=yaw_deg if poses == 1 else None,
            yaw_set_deg=tuple(wrap360(yaw_deg + k * 360 / poses) for k in range(poses)),
            period_deg=period_deg,
            outcome=outcome,
            possible=possible,
            min_score=self._min_score,
            min_margin=self._config.identify.margin,
        )


class DenseSearch(Search):
    """The bench's own search: a probability for every object at every azimuth (`hbr.DenseSession`)."""

    def __init__(
        self,
        index: hbr.DenseIndex,
        rule: hbr.StoppingRule,
        config: RigConfig,
        strategy: DenseStrategy,
        *,
        seed: int,
        top: int,
    ) -> None:
        super().__init__(index.views, config, seed=seed, top=top)
        self._strategy = strategy
        self._session = hbr.DenseSession(index, rule, max_views=config.identify.max_views)
        self._verification: Verification | None = None

    def _rank(self, levels: NDArray[np.uint8]) -> Ranked:
        decision = self._session.add(
            levels,
            self._orientations[-1],
            earlier=self._earlier,
            reliable=self._reliable,
            same_bench=self._alike,
        )
        belief = self._session.belief
        probability = belief.posterior(self._session.rule.beta).sum(axis=1)
        scores = belief.scores()
        ranking = belief.ranking()
        pose_deg = dict(zip(ranking.object_index.tolist(), ranking.pose_deg.tolist(), strict=True))
        objects = belief.index.object_index.tolist()
        names = belief.index.views.object_names
        order = np.lexsort((-scores, -probability)).tolist()
        candidates = tuple(
            Candidate(names[objects[i]], float(scores[i]), pose_deg[objects[i]], float(probability[i]))
            for i in order[: self._top]
        )
        others = float(scores[order[1:]].max()) if len(order) > 1 else 0.0
        return Ranked(belief.queries - 1, candidates, candidates[0].score - others, decision)

    def _decide(self, ranked: Ranked, table_deg: float) -> Rotate | Finish:  # noqa: ARG002
        return self._next(table_deg, *reachable_rotations(self._config, table_deg))

    def _next(
        self, table_deg: float, rotations_deg: NDArray[np.float64], seconds: NDArray[np.float64]
    ) -> Rotate | Finish:
        """Ask the strategy, which chooses among these rotations of the camera."""
        state = DenseSearchState(
            session=self._session,
            decision=self._session.decision,
            rotations_deg=rotations_deg,
            seconds=seconds,
            table_deg=table_deg,
            config=self._config.identify,
            rng=self._rng,
        )
        return self._strategy.next(state)

    @property
    def belief(self) -> hbr.Belief:
        """The belief after the last view."""
        return self._session.belief

    @property
    def beta(self) -> float:
        """As for `hbr.Belief.posterior`."""
        return self._session.rule.beta

    @property
    def error_rate(self) -> float:
        """The largest share of wrong objects among those named."""
        return self._session.rule.error_rate

    @property
    def decision(self) -> hbr.StopDecision:
        """The decision with which the search ends here, after the verification of its leader if there was one."""
        decision = self._session.end()
        return decision if self._verification is None else self._verification.decided(decision, self.found_from)

    @property
    def found_from(self) -> float:
        """Log-odds from which a verified leader is found (`hbr.dense.verification.found_from`)."""
        return found_from(self._same_bench)

    @property
    def is_doubtful(self) -> bool:
        """Whether the leader is to be verified (`hbr.dense.verification.is_doubtful`)."""
        belief, decision = self.belief, self._session.end()
        return is_doubtful(self._session.rule, decision, belief.queries, belief.index.views.descriptor)

    def set_verification(self, verification: Verification) -> None:
        """Use a verification of the leader in the answer."""
        self._verification = verification

    def pose_fields(self, object_index: int) -> dict[str, Any]:
        """Return the fields of the answer about the rotation of an object."""
        found = pose(self._session.belief, object_index)
        yaws_deg = tuple(float(wrap360(self._orientations[-1] - azimuth_deg)) for azimuth_deg in found.azimuth_deg)
        return {
            "yaw_deg": yaws_deg[0] if len(yaws_deg) == 1 else None,
            "yaw_sigma_deg": found.sigma_deg,
            "yaw_set_deg": yaws_deg,
            "period_deg": found.period_deg,
        }

    def answer(self, ranked: Ranked, end: Finish, *, travelled_deg: float = 0.0, seconds: float = 0.0) -> Identified:
        answer = super().answer(ranked, end, travelled_deg=travelled_deg, seconds=seconds)
        decision = self.decision
        threshold = decision.open_set_threshold
        return replace(
            answer,
            name=None if decision.outcome is hbr.Outcome.UNKNOWN else answer.name,
            outcome=decision.outcome,
            reason=answer.reason if self._verification is None else decision.reason,
            possible=self._possible(decision),
            **self.pose_fields(decision.object_index),
            confidence=decision.probability if decision.outcome is hbr.Outcome.FOUND else None,
            min_confidence=decision.min_confidence,
            open_set_score=decision.open_set_score,
            open_set_threshold=threshold if isfinite(threshold) else None,
        )

    def _possible(self, decision: hbr.StopDecision) -> tuple[str, ...]:
        """Return the possible objects: the likeliest, which together reach the confidence that ends a search."""
        if decision.outcome is hbr.Outcome.UNKNOWN:
            return ()
        belief = self._session.belief
        probability = belief.posterior(self._session.rule.beta).sum(axis=1)
        order = np.lexsort((-belief.scores(), -probability))
        count = 1
        if decision.outcome is hbr.Outcome.AMBIGUOUS:
            count += int((np.cumsum(probability[order]) < decision.min_confidence).sum())
        names = belief.index.views.object_names
        return tuple(names[j] for j in belief.index.object_index[order[:count]].tolist())


class ArcSearch(DenseSearch):
    """The bench's own search in motion (`hbr.dense.arc`): each frame has a weight for its share of new evidence.

    `is_new_decision` says whether the last frame led to a decision; between decisions the last one stays.
    """

    def __init__(
        self,
        index: hbr.DenseIndex,
        rule: hbr.StoppingRule,
        config: RigConfig,
        strategy: DenseStrategy,
        *,
        seed: int,
        top: int,
    ) -> None:
        super().__init__(index, rule, config, strategy, seed=seed, top=top)
        self._arc = self._session = ArcSession(index, _arc_rule(index, rule))
        self._step: Rotate | Finish | None = None

    @property
    def is_new_decision(self) -> bool:
        return self._arc.is_new_decision

    def frame_used(self, number: int, azimuth_deg: float, seconds: float, rejected: int) -> FrameUsed:
        """Return the event of the last frame; ``number`` counts the views from 0."""
        present = self._arc.present
        name = self._arc.belief.index.views.object_names[present.object_index]
        return FrameUsed(number, azimuth_deg, seconds, rejected, name, present.probability, present.outcome)

    def _decide(self, ranked: Ranked, table_deg: float) -> Rotate | Finish:  # noqa: ARG002
        if self._step is None or self.is_new_decision:
            way = float(np.sign(self._step.rotation_deg)) if isinstance(self._step, Rotate) else 0.0
            self._step = self._next(table_deg, *reachable_arcs(self._config, table_deg, way))
        return self._step


@lru_cache(maxsize=4)
def _arc_rule(index: hbr.DenseIndex, rule: hbr.StoppingRule) -> ArcRule:
    """Return the rule of searches in motion; it is fitted once for each model."""
    return calibrate_arc_rule(index, rule)


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
        Its name, or a strategy object. The default is ``dense`` if the model is for it, else ``ahbr``.
    seed
        For strategies that draw random numbers.
    top
        The number of candidates that events name.

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
    if isinstance(model.index, hbr.DenseIndex) and is_dense(chosen) and model.rule is not None:
        if wanted == model.descriptor:
            if isinstance(chosen, Arc):
                return ArcSearch(model.index, model.rule, config, chosen, seed=seed, top=top), chosen
            return DenseSearch(model.index, model.rule, config, chosen, seed=seed, top=top), chosen
    elif isinstance(model.index, hbr.ViewIndex) and not is_dense(chosen):
        return HoughSearch(model.index, config, cast(Strategy, chosen), seed=seed, top=top), chosen
    raise UsageError(
        f"The strategy {chosen.name!r} needs views by {wanted}; this model has views by {model.descriptor}.",
        next_step=f"Load it with rig.search.model.load_model(catalog, descriptor={wanted!r}), or use another strategy.",
    )
