"""A search without its hardware: views in, ranking and decision out.

A search does no I/O. It takes a view (`Search.add`), asks for enrolled views to compare it with (`Search.verify`), and
says what it needs next (`Search.decide`): a view after a rotation, or the end. Then it answers (`Search.answer`). The
bench at rest and in motion (`rig.plans.identify`) and the replay (`rig.search.replay`) drive it; `rig eval` drives the
same `hbr.DenseSession`.

Decision: docs/decisions/0017.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

import hbr
from hbr.core.angles import wrap360
from hbr.dense.arc import ArcSession
from hbr.dense.pixel_fit import LocalView, PixelFit
from hbr.dense.pose import azimuth_of, pose
from hbr.dense.session import Asking, Queries
from hbr.model.symmetry import symmetry
from hbr.paper.hmm import CONFIDENT, PoseBelief, PoseModel, update_poses
from rig.config import RigConfig
from rig.events.events import (
    Candidate,
    Decided,
    Event,
    FrameUsed,
    Identified,
    LeftOut,
    LeftOutReason,
    Moved,
    ObjectChanged,
    Ranked,
    Rejected,
    RotationReason,
    Verified,
)
from rig.search.strategies import (
    DenseSearchState,
    Finish,
    PoseSearchState,
    Rotate,
    SearchState,
    Strategy,
    reachable_arcs,
    reachable_rotations,
)
from rig.views.capture import RejectReason
from rig.views.description import DescribedView

EnrolledViews = Callable[[str, Sequence[float]], Sequence[LocalView]]
"""Returns the enrolled views of an object near some azimuths."""


SHOWN: Final = 5
"""Candidates that an event names by default."""

Hypotheses = Sequence[Sequence[hbr.Segmentation]]
"""All segmentations of each view of a search, the likeliest first (`rig.views.description.SearchDescriber`)."""


class Search(ABC):
    """One search for an object; `rig.search.model.begin_search` makes it.

    Views can be added after its end, too: a replay adds all views of a run. Queries need its ``descriptor``; ``names``
    are those of the enrolled objects.
    """

    in_motion = False
    """Whether the frames of a rotation are its views."""
    ranked: Ranked
    """The candidates after the last view that was decided on."""
    step: Rotate | Finish | None = None
    """The strategy's last decision."""
    is_new_decision = True
    """Whether the last view led to a decision; between the decisions of a search in motion the last one stays."""

    def __init__(self, views: hbr.Views, config: RigConfig, strategy: Strategy[Any], *, seed: int, top: int) -> None:
        self.descriptor = views.descriptor
        self.names = views.object_names
        self.strategy = strategy
        self._config = config
        self._top = top
        self._rng = np.random.default_rng(seed)
        self._orientations: list[float] = []
        self._table_deg = 0.0
        self._disturbed = False
        self._is_decided = True

    def notice(self, event: Event) -> None:
        """Take an event that precedes the next view: the table may have moved without a command, as if by hand."""
        match event:
            case Moved(agrees=False):
                self._disturbed = True
            case Rejected(reasons=reasons) if RejectReason.TABLE_MOVED in reasons:
                self._disturbed = True
            case _:
                pass

    def add(self, view: DescribedView, azimuth_deg: float, *, table_deg: float) -> None:
        """Add the next view, described by the search's descriptor.

        The azimuth is the orientation of the camera around the object, from any zero that all views share, in [0, 360).
        The table angle is unwrapped.
        """
        self._orientations.append(azimuth_deg)
        self._table_deg = table_deg
        self._add(view)
        self._disturbed = self._is_decided = False

    def decide(self) -> tuple[Ranked, Rotate | Finish]:
        """Return the candidates after the last view, and the strategy's decision. A verification counts."""
        if not self._is_decided:
            self._is_decided = True
            self.ranked = self._rank()
            if self.is_new_decision:
                self.step = self.strategy.next(self._state(self._table_deg))
        assert self.step is not None
        return self.ranked, self.step

    @abstractmethod
    def _add(self, view: DescribedView) -> None: ...

    @abstractmethod
    def _rank(self) -> Ranked: ...

    @abstractmethod
    def _state(self, table_deg: float) -> SearchState | PoseSearchState | DenseSearchState: ...

    def decided(self, number: int, target_deg: float) -> Decided:
        """Return the event of the last decision, a rotation of the table to ``target_deg``."""
        step = self.step
        assert isinstance(step, Rotate)
        return Decided(
            index=number,
            side="left" if step.rotation_deg >= 0 else "right",
            rotation_deg=step.rotation_deg,
            target_deg=target_deg,
            s_left=step.s_left,
            s_right=step.s_right,
            candidates=step.candidates[: self._top],
            reason=RotationReason(step.reason),
            note=step.note,
            weighed=step.weighed,
        )

    def frame_used(self, number: int, azimuth_deg: float, seconds: float, rejected: int) -> FrameUsed:
        """Return the event of the last frame of a search in motion; ``number`` counts the views from 0."""
        raise NotImplementedError

    def changed(self) -> ObjectChanged | None:
        """Return the event if the last view shows that the object changed; the search has then begun again."""
        return None

    def verify(self, hypotheses: Hypotheses, measured: PixelFit | None = None) -> Asking[Verified | None]:  # noqa: ARG002
        """Compare the last views with the leader's, as `hbr.DenseSession.verify`; the decision depends on it."""
        return _no_step()

    def answer(self, *, travelled_deg: float = 0.0, seconds: float = 0.0) -> Identified:
        """Return the answer after the last view."""
        self.decide()
        best = self.ranked.candidates[0]
        end = self.step if isinstance(self.step, Finish) else Finish(hbr.StopReason.MAX_VIEWS)
        return Identified(
            name=best.name,
            candidates=self.ranked.candidates,
            score=best.score,
            margin=self.ranked.margin,
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


def _no_step() -> Asking[None]:
    yield from ()


class _PaperSearch(Search):
    """A search of the paper or of its successor: a score per view tells whether the object is unknown."""

    def __init__(self, views: hbr.Views, config: RigConfig, strategy: Strategy[Any], *, seed: int, top: int) -> None:
        super().__init__(views, config, strategy, seed=seed, top=top)
        self._views = views
        given, repeatability = config.identify.min_score, config.identify.repeatability
        self._min_score = hbr.open_set_threshold(views, repeatability=repeatability) if given is None else given

    def _by_score(self, answer: Identified, possible: Sequence[str], object_index: int, **others: Any) -> Identified:
        """Return the answer by its score and its possible objects, with all rotations by the measured symmetry."""
        outcome = hbr.Outcome.FOUND if len(possible) == 1 else hbr.Outcome.AMBIGUOUS
        if answer.score < self._min_score:
            outcome, possible = hbr.Outcome.UNKNOWN, ()
        own = symmetry(self._views, object_index)
        period_deg = own.period_deg if own else None
        poses = round(360 / period_deg) if period_deg else 1 if period_deg is None else 0
        yaw_deg = answer.yaw_set_deg[0]
        return replace(
            answer,
            name=None if outcome is hbr.Outcome.UNKNOWN else answer.name,
            outcome=outcome,
            possible=tuple(possible),
            min_score=self._min_score,
            yaw_deg=yaw_deg if poses == 1 else None,
            yaw_set_deg=tuple(wrap360(yaw_deg + k * 360 / poses) for k in range(poses)),
            period_deg=period_deg,
            **others,
        )


class HoughSearch(_PaperSearch):
    """The paper's search: views vote by lists of the most similar enrolled views (`hbr.retrieve`)."""

    def __init__(
        self, index: hbr.ViewIndex, config: RigConfig, strategy: Strategy[Any], *, seed: int, top: int
    ) -> None:
        super().__init__(index.views, config, strategy, seed=seed, top=top)
        self._index = index
        self._descriptors: list[NDArray[np.uint8]] = []

    def _add(self, view: DescribedView) -> None:
        self._descriptors.append(view.levels[self.descriptor])

    def _rank(self) -> Ranked:
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

    def _state(self, table_deg: float) -> SearchState:
        return SearchState(
            index=self._index,
            queries=self._queries,
            ranking=self._ranking,
            score=self.ranked.candidates[0].score,
            margin=self.ranked.margin,
            min_score=self._min_score,
            table_deg=table_deg,
            limits_deg=self._config.table.limits_deg,
            config=self._config.identify,
            rng=self._rng,
        )

    def answer(self, *, travelled_deg: float = 0.0, seconds: float = 0.0) -> Identified:
        answer = super().answer(travelled_deg=travelled_deg, seconds=seconds)
        possible = answer.possible
        if answer.margin <= 0 and len(self._ranking.names) > 1:
            # Objects that share the best score; at least the second one, which is as likely by the margin.
            scores = self._ranking.scores
            possible = self._ranking.names[: max(2, int((scores >= scores[0]).sum()))]
        first = int(self._ranking.object_index[0])
        return self._by_score(answer, possible, first, min_margin=self._config.identify.margin)


class PoseSearch(_PaperSearch):
    """The search of the paper's successor: a hidden Markov model over the poses of all objects (`hbr.paper.hmm`).

    The probabilities are shares among the enrolled objects, because the model knows no other. Whether the object is
    unknown is decided as in the paper's search, with the same threshold. The score is the one of that search without
    orientations: the similarity to the most similar view of the object, averaged over the views so far.
    """

    _belief: PoseBelief

    def __init__(self, model: PoseModel, config: RigConfig, strategy: Strategy[Any], *, seed: int, top: int) -> None:
        super().__init__(model.views, config, strategy, seed=seed, top=top)
        self._so_far: PoseModel | PoseBelief = model
        self._compared = model.compared
        self._rows, _ = model.views.by_object
        self._begin = model.begin
        self._with_views = model.views.object_index[self._rows[model.begin]]
        self._reach = np.zeros(len(model.begin))

    def _add(self, view: DescribedView) -> None:
        similar = self._compared.similarity(view.levels[self.descriptor][None])[0]
        self._so_far = self._belief = update_poses(similar, self._orientations[-1], self._so_far)
        self._reach += np.maximum.reduceat(similar[self._rows], self._begin)

    def _rank(self) -> Ranked:
        self._objects, log_probability, poses_deg = self._belief.ranking()
        self._probability = np.exp(log_probability)
        # The scores, of the objects in the order of their probabilities.
        views = len(self._orientations)
        score = self._reach[np.searchsorted(self._with_views, self._objects)] / views
        numbers = zip(*(each.tolist() for each in (self._objects, score, poses_deg, self._probability)), strict=True)
        candidates = tuple(Candidate(self.names[j], *rest) for j, *rest in numbers)
        margin = float(score[0] - score[1:].max(initial=0.0))
        return Ranked(views - 1, candidates[: self._top], margin)

    def _state(self, table_deg: float) -> PoseSearchState:
        return PoseSearchState(
            belief=self._belief,
            probability=float(self._probability[0]),
            score=self.ranked.candidates[0].score,
            min_score=self._min_score,
            rotations_deg=reachable_rotations(self._config, table_deg)[0],
            table_deg=table_deg,
            config=self._config.identify,
            rng=self._rng,
        )

    def answer(self, *, travelled_deg: float = 0.0, seconds: float = 0.0) -> Identified:
        answer = super().answer(travelled_deg=travelled_deg, seconds=seconds)
        count = 1 + int((np.cumsum(self._probability) < CONFIDENT).sum())
        possible = [self.names[j] for j in self._objects[:count].tolist()]
        answer = self._by_score(answer, possible, int(self._objects[0]), min_confidence=CONFIDENT)
        found = answer.outcome is hbr.Outcome.FOUND
        return replace(answer, confidence=float(self._probability[0]) if found else None)


class DenseSearch(Search):
    """The bench's own search: a probability for every object at every azimuth (`hbr.DenseSession`).

    In motion (`hbr.dense.arc`), each frame has a weight for its share of new evidence.
    """

    def __init__(
        self,
        session: hbr.DenseSession,
        views: hbr.Views,
        config: RigConfig,
        strategy: Strategy[Any],
        *,
        seed: int,
        top: int,
    ) -> None:
        super().__init__(views, config, strategy, seed=seed, top=top)
        self._session = session
        self.in_motion = isinstance(session, ArcSession)

    def _add(self, view: DescribedView) -> None:
        self._session.add(
            view.levels[self.descriptor],
            self._orientations[-1],
            earlier=view.earlier,
            reliable=view.reliable,
            other_bench=view.other_bench,
            disturbed=self._disturbed,
        )
        self.is_new_decision = self._session.is_new_decision

    def _rank(self) -> Ranked:
        belief = self._session.belief
        self._scores = belief.scores()
        self._order = np.lexsort((-self._scores, -self._session.among_enrolled()))
        candidates = self._candidates()
        others = float(self._scores[self._order[1:]].max(initial=0.0))
        return Ranked(len(self._orientations) - 1, candidates, candidates[0].score - others, self._session.decision)

    def _candidates(self) -> tuple[Candidate, ...]:
        """Return the leading candidates, the likeliest first, with their shares of the posterior."""
        belief, probability = self._session.belief, self._probability()
        found = []
        for place in self._order[: self._top].tolist():
            one = int(belief.index.object_index[place])
            numbers = float(self._scores[place]), azimuth_of(belief, one), float(probability[place])
            found.append(Candidate(self.names[one], *numbers))
        return tuple(found)

    def _probability(self) -> NDArray[np.float64]:
        """Return the probability of each object considered; what is missing to 1 is that of "not enrolled"."""
        return self._session.among_enrolled() * (1 - self._session.decision.not_enrolled)

    def changed(self) -> ObjectChanged | None:
        change = self._session.change
        return None if change is None else ObjectChanged(len(self._orientations) - 1, *change)

    def frame_used(self, number: int, azimuth_deg: float, seconds: float, rejected: int) -> FrameUsed:
        present = self._session.present
        name = self.names[present.object_index]
        return FrameUsed(number, azimuth_deg, seconds, rejected, name, present.probability, present.outcome)

    def _state(self, table_deg: float) -> DenseSearchState:
        if self.in_motion:
            way = float(np.sign(self.step.rotation_deg)) if isinstance(self.step, Rotate) else 0.0
            rotations_deg, seconds = reachable_arcs(self._config, table_deg, way)
        else:
            rotations_deg, seconds = reachable_rotations(self._config, table_deg)
        return DenseSearchState(
            session=self._session,
            decision=self._session.decision,
            rotations_deg=rotations_deg,
            seconds=seconds,
            table_deg=table_deg,
            config=self._config.identify,
            rng=self._rng,
        )

    def verify(self, hypotheses: Hypotheses, measured: PixelFit | None = None) -> Asking[Verified | None]:
        found = yield from self._session.verify(self._queries(hypotheses), measured)
        if found is None:
            return None
        decision = self._session.decision
        return Verified(
            index=len(self._orientations) - 1,
            name=self.names[found.object_index],
            fit=found.own,
            second=found.second,
            others=found.others,
            expected=found.expected,
            light=found.light,
            outcome=decision.outcome,
            probability=decision.probability,
            not_enrolled=decision.not_enrolled,
        )

    def _queries(self, hypotheses: Hypotheses) -> Queries:
        own, orientations_deg = hypotheses[self._session.left_out :], self._orientations[self._session.left_out :]
        return lambda n: [LocalView(one.crop, one.mask, orientations_deg[n]) for one in own[n]]

    def answer(self, *, travelled_deg: float = 0.0, seconds: float = 0.0) -> Identified:
        answer = super().answer(travelled_deg=travelled_deg, seconds=seconds)
        decision = self._session.end()
        outcome = decision.outcome
        possible = self._possible(decision)
        found = pose(self._session.belief, decision.object_index)
        yaws_deg = tuple(float(wrap360(self._orientations[-1] - azimuth_deg)) for azimuth_deg in found.azimuth_deg)
        return replace(
            answer,
            name=None if outcome is hbr.Outcome.UNKNOWN else answer.name,
            views=self._session.belief.queries,
            left_out=tuple(LeftOut(n, LeftOutReason.OBJECT_CHANGED) for n in range(self._session.left_out)),
            outcome=outcome,
            possible=possible,
            yaw_deg=yaws_deg[0] if len(yaws_deg) == 1 else None,
            yaw_sigma_deg=found.sigma_deg,
            yaw_set_deg=yaws_deg,
            period_deg=found.period_deg,
            confidence=decision.probability if outcome is hbr.Outcome.FOUND else None,
            min_confidence=decision.min_confidence,
            not_enrolled=decision.not_enrolled,
        )

    def _possible(self, decision: hbr.StopDecision) -> tuple[str, ...]:
        """Return the possible objects: of an ambiguous one at least the likeliest two.

        With "not enrolled", they reach the confidence together.
        """
        if decision.outcome is hbr.Outcome.UNKNOWN:
            return ()
        count = 1
        if decision.outcome is hbr.Outcome.AMBIGUOUS:
            together = decision.not_enrolled + np.cumsum(self._probability()[self._order])
            count = max(2, 1 + int((together < decision.min_confidence).sum()))
        return tuple(self.names[j] for j in self._session.belief.index.object_index[self._order[:count]].tolist())
