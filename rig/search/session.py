"""A search without its hardware: views in, ranking and decision out.

A search does no I/O. It takes a view (`Search.add`), asks for enrolled views to compare it with (`Search.verify`), and
says what it needs next (`Search.decide`): a view after a rotation, or the end. Then it answers (`Search.answer`). The
bench at rest and in motion (`rig.plans.identify`) and the replay (`rig.search.replay`) drive it; `rig eval` drives the
same `hbr.DenseSession`. Which rotation comes next, and when the search ends, a `Strategy` decides from the search.

Decision: docs/decisions/0017.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final, Protocol, TypeVar

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
    Weighed,
)
from rig.views.capture import RejectReason
from rig.views.description import DescribedView

EnrolledViews = Callable[[str, Sequence[float]], Sequence[LocalView]]
"""Returns the enrolled views of an object near some azimuths."""


SHOWN: Final = 5
"""Candidates that an event names."""

Hypotheses = Sequence[Sequence[hbr.Segmentation]]
"""All segmentations of each view of a search, the likeliest first (`rig.views.description.SearchDescriber`)."""


@dataclass(frozen=True, slots=True)
class Rotate:
    """Take the next view after a rotation of the camera around the object, positive to the left.

    ``note`` is the reason, for a strategy that does not come with the rig. ``s_left`` and ``s_right`` are the
    similarities of the ``candidates`` (names) from each side, if the strategy compared the sides; ``weighed`` has all
    rotations that it weighed.
    """

    rotation_deg: float
    reason: RotationReason = RotationReason.CUSTOM
    note: str = ""
    s_left: float | None = None
    s_right: float | None = None
    candidates: tuple[str, ...] = ()
    weighed: Weighed | None = None


@dataclass(frozen=True, slots=True)
class Finish:
    """End the search. ``note`` is the reason, for a strategy that does not come with the rig."""

    reason: hbr.StopReason = hbr.StopReason.CUSTOM
    note: str = ""


Searched = TypeVar("Searched", bound="Search", contravariant=True)


class Strategy(Protocol[Searched]):
    """Decides after each view.

    A strategy of the dense search also has the attribute ``descriptor``: that of its views. With the
    attribute ``in_motion`` it chooses arcs, on which every frame is a view. A strategy of the hidden Markov model has
    the attribute ``poses``, which is true.
    """

    @property
    def name(self) -> str:
        """The name that selects it, and that a saved run stores."""
        ...

    def next(self, search: Searched) -> Rotate | Finish:
        """Return the rotation to the next view, or the end. It only reads the search, and draws from its ``rng``.

        The same search and draws give the same answer.
        """
        ...


AnyStrategy = Strategy[Any]


@dataclass(eq=False)
class Search(ABC):
    """One search for an object; `rig.search.model.begin_search` makes it, and its strategy reads it.

    Views can be added after its end, too: a replay adds all views of a run.
    """

    enrolled: hbr.Views
    config: RigConfig
    strategy: AnyStrategy
    seed: int
    in_motion: bool = field(default=False, init=False)
    """Whether the frames of a rotation are its views."""
    ranked: Ranked = field(init=False)
    """The candidates after the last view that was decided on."""
    step: Rotate | Finish | None = field(default=None, init=False)
    """The strategy's last decision."""
    is_new_decision: bool = field(default=True, init=False)
    """Whether the last view led to a decision; between the decisions of a search in motion the last one stays."""
    table_deg: float = field(default=0.0, init=False)
    """Table angle of the last view, unwrapped."""
    rng: np.random.Generator = field(init=False)
    _orientations: list[float] = field(default_factory=list, init=False)
    _disturbed: bool = field(default=False, init=False)
    _is_decided: bool = field(default=True, init=False)

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng(self.seed)

    @property
    def descriptor(self) -> str:
        """The descriptor of the enrolled views, which queries need."""
        return self.enrolled.descriptor

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the enrolled objects."""
        return self.enrolled.object_names

    @property
    def views(self) -> int:
        """The number of views so far."""
        return len(self._orientations)

    @property
    def score(self) -> float:
        """The score of the leading candidate, per view."""
        return self.ranked.candidates[0].score

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
        self.table_deg = table_deg
        self._add(view)
        self._disturbed = self._is_decided = False

    def decide(self) -> tuple[Ranked, Rotate | Finish]:
        """Return the candidates after the last view, and the strategy's decision. A verification counts."""
        if not self._is_decided:
            self._is_decided = True
            self.ranked = self._rank()
            # A search in motion decides when its frames have covered another step of the circle, not at each frame.
            if self.is_new_decision:
                self.step = self.strategy.next(self)
        assert self.step is not None
        return self.ranked, self.step

    @abstractmethod
    def _add(self, view: DescribedView) -> None: ...

    @abstractmethod
    def _rank(self) -> Ranked: ...

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
            candidates=step.candidates[:SHOWN],
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
        """Return the answer after the last view. The arguments are what the search took."""
        self.decide()
        return replace(self._answer(), travelled_deg=travelled_deg, seconds=seconds)

    @abstractmethod
    def _answer(self) -> Identified: ...

    def _identified(
        self, outcome: hbr.Outcome, possible: Sequence[str], yaw_set_deg: Sequence[float], **others: Any
    ) -> Identified:
        """Return the answer of a decided search; ``others`` are further fields of `Identified`."""
        best = self.ranked.candidates[0]
        # A search in motion may end after its last flight although its strategy would rotate on.
        end = self.step if isinstance(self.step, Finish) else Finish(hbr.StopReason.MAX_VIEWS)
        is_unknown = outcome is hbr.Outcome.UNKNOWN
        return Identified(
            name=None if is_unknown else best.name,
            candidates=self.ranked.candidates,
            score=best.score,
            margin=self.ranked.margin,
            pose_deg=best.pose_deg,
            yaw_deg=yaw_set_deg[0] if len(yaw_set_deg) == 1 else None,
            yaw_set_deg=tuple(yaw_set_deg),
            views=self.views,
            travelled_deg=0.0,
            seconds=0.0,
            reason=end.reason,
            outcome=outcome,
            possible=() if is_unknown else tuple(possible),
            note=end.note,
            **others,
        )


def _no_step() -> Asking[None]:
    yield from ()


@dataclass(eq=False)
class PaperSearch(Search):
    """A search of the paper or of its successor: a score per view tells whether the object is unknown."""

    min_score: float = field(init=False)
    """Below this score per view the object is unknown."""

    def __post_init__(self) -> None:
        super().__post_init__()
        given, repeatability = self.config.identify.min_score, self.config.identify.repeatability
        self.min_score = hbr.open_set_threshold(self.enrolled, repeatability=repeatability) if given is None else given

    def _by_score(self, possible: Sequence[str], object_index: int, **others: Any) -> Identified:
        """Return the answer by its score and its possible objects, with all rotations by the measured symmetry."""
        outcome = hbr.Outcome.FOUND if len(possible) == 1 else hbr.Outcome.AMBIGUOUS
        if self.score < self.min_score:
            outcome = hbr.Outcome.UNKNOWN
        if outcome is not hbr.Outcome.FOUND:
            others["confidence"] = None
        own = symmetry(self.enrolled, object_index)
        period_deg = own.period_deg if own else None
        # An object without a measured symmetry has one pose, one that looks the same from all sides has none.
        poses = round(360 / period_deg) if period_deg else 1 if period_deg is None else 0
        yaw_deg = float(wrap360(self._orientations[-1] - self.ranked.candidates[0].pose_deg))
        yaw_set_deg = [float(wrap360(yaw_deg + k * 360 / poses)) for k in range(poses)]
        return self._identified(
            outcome, possible, yaw_set_deg, min_score=self.min_score, period_deg=period_deg, **others
        )


@dataclass(eq=False)
class HoughSearch(PaperSearch):
    """The paper's search: views vote by lists of the most similar enrolled views (`hbr.retrieve`)."""

    index: hbr.ViewIndex
    """The enrolled views."""
    queries: NDArray[np.uint8] = field(init=False)
    """Descriptors of the views so far, in their order, uint8 (N, 144)."""
    ranking: hbr.Ranking = field(init=False)
    """The objects by their scores; `ranking.orientation_deg` has the orientation of each view."""
    _descriptors: list[NDArray[np.uint8]] = field(default_factory=list, init=False)

    def _add(self, view: DescribedView) -> None:
        self._descriptors.append(view.levels[self.descriptor])

    def _rank(self) -> Ranked:
        self.queries = queries = np.array(self._descriptors)
        config = self.config.identify
        self.ranking = ranking = hbr.retrieve(
            queries,
            np.array(self._orientations),
            self.index,
            omega=config.omega,
            list_length=config.list_length,
            extension=config.extension,
        )
        views = len(queries)
        candidates = tuple(
            Candidate(name, float(score) / views, float(pose_deg))
            for name, score, pose_deg in zip(ranking.names[:SHOWN], ranking.scores, ranking.pose_deg, strict=False)
        )
        return Ranked(views - 1, candidates, hbr.score_margin(ranking, queries) / views)

    def _answer(self) -> Identified:
        names, scores = self.ranking.names, self.ranking.scores
        # Objects that share the best score; at least the second one, which is as likely by the margin.
        shared = self.ranked.margin <= 0 and len(names) > 1
        possible = names[: max(2, int((scores >= scores[0]).sum()))] if shared else names[:1]
        return self._by_score(possible, int(self.ranking.object_index[0]), min_margin=self.config.identify.margin)


@dataclass(eq=False)
class PoseSearch(PaperSearch):
    """The search of the paper's successor: a hidden Markov model over the poses of all objects (`hbr.paper.hmm`).

    The probabilities are shares among the enrolled objects, because the model knows no other. Whether the object is
    unknown is decided as in the paper's search, with the same threshold. The score is the one of that search without
    orientations: the similarity to the most similar view of the object, averaged over the views so far.
    """

    model: PoseModel
    belief: PoseBelief = field(init=False)
    """The probabilities of all poses, with its method ``next_view``."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._so_far: PoseModel | PoseBelief = self.model
        self._rows, _ = self.enrolled.by_object
        self._with_views = self.enrolled.object_index[self._rows[self.model.begin]]
        self._reach = np.zeros(len(self.model.begin))

    @property
    def probability(self) -> float:
        """The probability of the leading candidate."""
        return float(self._probability[0])

    def _add(self, view: DescribedView) -> None:
        similar = self.model.compared.similarity(view.levels[self.descriptor][None])[0]
        self._so_far = self.belief = update_poses(similar, self._orientations[-1], self._so_far)
        # The score knows no orientations: the most similar view of each object counts, wherever it was taken.
        self._reach += np.maximum.reduceat(similar[self._rows], self.model.begin)

    def _rank(self) -> Ranked:
        self._objects, log_probability, poses_deg = self.belief.ranking()
        self._probability = np.exp(log_probability)
        # The scores, of the objects in the order of their probabilities.
        views = len(self._orientations)
        score = self._reach[np.searchsorted(self._with_views, self._objects)] / views
        numbers = zip(*(each.tolist() for each in (self._objects, score, poses_deg, self._probability)), strict=True)
        candidates = tuple(Candidate(self.names[j], *rest) for j, *rest in numbers)
        margin = float(score[0] - score[1:].max(initial=0.0))
        return Ranked(views - 1, candidates[:SHOWN], margin)

    def _answer(self) -> Identified:
        count = 1 + int((np.cumsum(self._probability) < CONFIDENT).sum())
        possible = [self.names[j] for j in self._objects[:count].tolist()]
        return self._by_score(possible, int(self._objects[0]), min_confidence=CONFIDENT, confidence=self.probability)


@dataclass(eq=False)
class DenseSearch(Search):
    """The bench's own search: a probability for every object at every azimuth (`hbr.DenseSession`).

    In motion (`hbr.dense.arc`), each frame has a weight for its share of new evidence.
    """

    session: hbr.DenseSession
    """The belief, with its methods to choose a view."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.in_motion = isinstance(self.session, ArcSession)

    @property
    def views(self) -> int:
        """The number of views so far that show the present object."""
        return self.session.belief.queries

    @property
    def decision(self) -> hbr.StopDecision:
        """What follows from the views so far."""
        return self.session.decision

    def _add(self, view: DescribedView) -> None:
        self.session.add(
            view.levels[self.descriptor],
            self._orientations[-1],
            earlier=view.earlier,
            reliable=view.reliable,
            other_bench=view.other_bench,
            disturbed=self._disturbed,
        )
        self.is_new_decision = self.session.is_new_decision

    def _rank(self) -> Ranked:
        belief = self.session.belief
        self._scores = belief.scores()
        # The most probable object first; of equally probable ones, that with the higher score.
        self._order = np.lexsort((-self._scores, -self.session.among_enrolled()))
        candidates = self._candidates()
        others = float(self._scores[self._order[1:]].max(initial=0.0))
        return Ranked(len(self._orientations) - 1, candidates, candidates[0].score - others, self.decision)

    def _candidates(self) -> tuple[Candidate, ...]:
        """Return the leading candidates, the likeliest first, with their shares of the posterior."""
        belief, probability = self.session.belief, self._probability()
        found = []
        for place in self._order[:SHOWN].tolist():
            one = int(belief.index.object_index[place])
            numbers = float(self._scores[place]), azimuth_of(belief, one), float(probability[place])
            found.append(Candidate(self.names[one], *numbers))
        return tuple(found)

    def _probability(self) -> NDArray[np.float64]:
        """Return the probability of each object considered; what is missing to 1 is that of "not enrolled"."""
        return self.session.among_enrolled() * (1 - self.decision.not_enrolled)

    def changed(self) -> ObjectChanged | None:
        change = self.session.change
        return None if change is None else ObjectChanged(len(self._orientations) - 1, *change)

    def frame_used(self, number: int, azimuth_deg: float, seconds: float, rejected: int) -> FrameUsed:
        present = self.session.present
        name = self.names[present.object_index]
        return FrameUsed(number, azimuth_deg, seconds, rejected, name, present.probability, present.outcome)

    def verify(self, hypotheses: Hypotheses, measured: PixelFit | None = None) -> Asking[Verified | None]:
        found = yield from self.session.verify(self._queries(hypotheses), measured)
        if found is None:
            return None
        decision = self.decision
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
        # Views from before a change show another object.
        own, orientations_deg = hypotheses[self.session.left_out :], self._orientations[self.session.left_out :]
        return lambda n: [LocalView(one.crop, one.mask, orientations_deg[n]) for one in own[n]]

    def _answer(self) -> Identified:
        decision = self.session.end()
        found = pose(self.session.belief, decision.object_index)
        return self._identified(
            decision.outcome,
            self._possible(decision),
            [float(wrap360(self._orientations[-1] - azimuth_deg)) for azimuth_deg in found.azimuth_deg],
            left_out=tuple(LeftOut(n, LeftOutReason.OBJECT_CHANGED) for n in range(self.session.left_out)),
            yaw_sigma_deg=found.sigma_deg,
            period_deg=found.period_deg,
            confidence=decision.probability if decision.outcome is hbr.Outcome.FOUND else None,
            min_confidence=decision.min_confidence,
            not_enrolled=decision.not_enrolled,
        )

    def _possible(self, decision: hbr.StopDecision) -> tuple[str, ...]:
        """Return the possible objects: of an ambiguous one at least the likeliest two.

        With "not enrolled", they reach the confidence together.
        """
        count = 1
        if decision.outcome is hbr.Outcome.AMBIGUOUS:
            together = decision.not_enrolled + np.cumsum(self._probability()[self._order])
            count = max(2, 1 + int((together < decision.min_confidence).sum()))
        return tuple(self.names[j] for j in self.session.belief.index.object_index[self._order[:count]].tolist())
