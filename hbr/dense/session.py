"""One search by the dense filter: views in; belief, decision and next best view out. It reads no image itself.

`DenseSession.verify`, after each view at rest, compares the views with enrolled ones, pixel by pixel
(`hbr.dense.pixel_fit`). It asks for the enrolled views at the estimated pose (`NeedEnrolledViews`); the driver of the
search brings them. The share of the views' contrast that they explain is a part of the posterior
(`hbr.dense.stopping`).

If the object was replaced or rotated by hand, the search begins again with the views since then (`hbr.dense.change`).

Decisions: docs/decisions/0013, docs/decisions/0015, docs/decisions/0017.
"""

from collections import deque
from collections.abc import Callable, Generator, Sequence
from typing import ClassVar, Final, NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from hbr.core.angles import size_deg, wrap360
from hbr.core.arrays import FloatArray, IndexArray, LevelArray
from hbr.dense.change import Change, changed
from hbr.dense.evidence import near_twins
from hbr.dense.filter import Belief, update_belief
from hbr.dense.index import DenseIndex
from hbr.dense.next_view import NextBestView, next_best_view
from hbr.dense.pixel_fit import BY_FIT, Compared, LocalView, PixelFit, Pixels, compare
from hbr.dense.pose import azimuth_of
from hbr.dense.stopping import HOPELESS, Outcome, StopDecision, among_enrolled, decide, pair_odds

#: Enrolled views of a candidate that a view is compared with.
NEAREST: Final = 2  # a view lies between two enrolled ones; further ones show other sides
#: Segmentations of each view that are compared.
_SEGMENTATIONS: Final = 2  # more: a wrong box does less harm; each costs a registration of every candidate
#: Candidates that are compared with the views.
_COMPARED: Final = 3  # the two leaders, and one more if these are near twins
#: From this probability of "not enrolled" on, the next view is taken without a fit, which would hardly end the search.
_NOT_WORTH_A_FIT: Final = 0.95

_Result = TypeVar("_Result")


class NeedEnrolledViews(NamedTuple):
    """A search needs the enrolled views of an object, by its index in the views' names, near some azimuths.

    The answer is None if they cannot be read: the search then ends without them.
    """

    object_index: int
    azimuths_deg: tuple[float, ...]


Asking = Generator[NeedEnrolledViews, Sequence[LocalView] | None, _Result]
"""A step of a search that asks for enrolled views, and returns its result."""
Queries = Callable[[int], Sequence[LocalView]]
"""Returns a view of a search by each of its segmentations, the likeliest first."""


def answered(
    step: Asking[_Result], enrolled: Callable[[int, Sequence[float]], Sequence[LocalView] | None] = lambda *_: None
) -> _Result:
    """Return the result of a step; ``enrolled`` returns the enrolled views of an object near some azimuths."""
    try:
        need = next(step)
        while True:
            need = step.send(enrolled(*need))
    except StopIteration as end:
        result: _Result = end.value
        return result


def near(own_deg: ArrayLike, azimuths_deg: Sequence[float]) -> IndexArray:
    """Return the indices of the views, at ``own_deg`` (n,), that a comparison near some azimuths needs, by azimuth."""
    own_deg = np.asarray(own_deg, np.float64)
    wanted = np.unique([_nearest(own_deg, azimuth_deg) for azimuth_deg in azimuths_deg])
    places: IndexArray = wanted[np.argsort(own_deg[wanted], kind="stable")]
    return places


def _nearest(own_deg: FloatArray, azimuth_deg: float) -> IndexArray:
    """Return the indices of the `NEAREST` views to an azimuth."""
    return np.argsort(size_deg(own_deg - azimuth_deg), kind="stable")[:NEAREST]


class Fits:
    """The fits of a search, and the enrolled views that they need; each is measured, and asked for, once."""

    def __init__(self) -> None:
        self._views: dict[int, dict[float, LocalView]] = {}
        self._seen: dict[int, list[Pixels]] = {}
        self._enrolled: dict[tuple[int, float], Pixels] = {}
        self._of_views: dict[tuple[int, int, float], Compared] = {}
        self._of_pairs: dict[tuple[int, float, float], float] = {}

    def views(
        self, object_index: int, own_deg: FloatArray, azimuths_deg: Sequence[float]
    ) -> Asking[Sequence[LocalView] | None]:
        """Return enrolled views of an object, those next to some azimuths among them; ``own_deg`` has those of all."""
        known = self._views.setdefault(object_index, {})
        unknown = [deg for deg in azimuths_deg if not known.keys() >= set(own_deg[_nearest(own_deg, deg)].tolist())]
        if unknown:
            found = yield NeedEnrolledViews(object_index, tuple(unknown))
            if not found:
                return None
            known.update((view.azimuth_deg, view) for view in found)
        return list(known.values())

    def of_view(self, n: int, queries: Queries, object_index: int, enrolled: LocalView) -> Compared:
        """Compare an enrolled view with the view n of the search, by its better segmentation."""
        key = n, object_index, enrolled.azimuth_deg
        if key not in self._of_views:
            if n not in self._seen:
                self._seen[n] = [Pixels.of(one) for one in queries(n)[:_SEGMENTATIONS]]
            pixels = self._pixels(object_index, enrolled)
            self._of_views[key] = max((compare(one, pixels) for one in self._seen[n]), key=BY_FIT)
        return self._of_views[key]

    def of_pair(self, object_index: int, one: LocalView, other: LocalView) -> float:
        """Return the fit of two enrolled views of an object."""
        key = object_index, one.azimuth_deg, other.azimuth_deg
        if key not in self._of_pairs:
            self._of_pairs[key] = compare(self._pixels(object_index, one), self._pixels(object_index, other)).fit
        return self._of_pairs[key]

    def _pixels(self, object_index: int, view: LocalView) -> Pixels:
        key = object_index, view.azimuth_deg
        if key not in self._enrolled:
            self._enrolled[key] = Pixels.of(view)
        return self._enrolled[key]


def verify(belief: Belief, queries: Queries, fits: Fits | None = None) -> Asking[PixelFit | None]:
    """Compare the views of a search with the enrolled views of its leading candidates; None without such views.

    The queries are in the order of the belief's.
    """
    fits = fits or Fits()
    last_deg = float(belief.orientation_deg[-1])
    places: IndexArray = np.argsort(-belief.probability(), kind="stable")[:_COMPARED]
    candidates = belief.index.object_index[places].tolist()
    found, means, beside = [], [], []
    for candidate in candidates:
        pose_deg = azimuth_of(belief, candidate)
        azimuths_deg = [wrap360(pose_deg + o - last_deg) for o in belief.orientation_deg.tolist()]
        own_deg = belief.index.views.azimuth_deg[belief.index.views.of(candidate)]
        views = yield from fits.views(candidate, own_deg, azimuths_deg)
        if views is None:
            return None
        enrolled_deg = np.array([view.azimuth_deg for view in views])
        nearest = [[views[place] for place in _nearest(enrolled_deg, deg).tolist()] for deg in azimuths_deg]
        best = [
            max((fits.of_view(n, queries, candidate, one) for one in near), key=BY_FIT)
            for n, near in enumerate(nearest)
        ]
        found.append(best)
        means.append(float(np.mean([one.fit for one in best])))
        beside.append(nearest)
    # the second candidate leads if it fits better
    leader = 1 if len(candidates) > 1 and pair_odds(belief, places[0], places[1], means[0] - means[1]) < 0 else 0
    is_other = ~near_twins(belief, int(places[leader]), places)
    others = [mean for mean, other in zip(means, is_other.tolist(), strict=True) if other]
    # what a view between two enrolled ones has at least
    expected = np.mean([fits.of_pair(candidates[leader], near[0], near[-1]) for near in beside[leader]])
    light = np.mean([one.light for one in found[leader]], axis=0)
    return PixelFit(
        candidates[leader],
        means[leader],
        means[1 - leader] if len(candidates) > 1 else 0.0,
        max(others, default=0.0),
        float(expected),
        float(light @ light),
    )


#: Number of times that a search begins again because the object changed.
MOST_CHANGES: Final = 3  # more: a hand that stays in the picture holds up the bench; fewer: it uses up all of them
#: Number of objects of a large catalog that are considered.
KEPT: Final = 500  # more: each view takes longer, and more memory; fewer: the object is missed more often
_WORTH_REDUCING: Final = 2  # of a smaller catalog, a reduced index saves less time than its making takes


class DenseSession:
    """A search for one object, the same for the bench, for replay and for evaluation.

    Parameters
    ----------
    index : DenseIndex
        The enrolled views.
    max_views : int
        Views after which it ends in any case, counted from the last change of the object.
    most_changes : int
        Number of times that the search begins again because the object changed; 0: all views count for one object.

    Attributes
    ----------
    belief : Belief
        After at least one view.
    left_out : int
        Number of views, from the first one on, that the belief leaves out because the object changed after them.
    change : Change, optional
        The change that the last view showed.
    decision : StopDecision
        The last decision: at rest, after the last view.
    present : StopDecision
        What the decision would be after the last view, if there was one after each.
    is_new_decision : bool
        Whether the last view led to a decision.
    verification : PixelFit, optional
        The fit of the leader after the last view, if it was measured.
    """

    belief: Belief
    decision: StopDecision
    present: StopDecision
    is_new_decision = True
    verification: PixelFit | None = None
    left_out = 0
    change: Change | None = None
    _NEWEST: ClassVar[int] = 2
    """Number of decisions since which the object may have changed."""

    def __init__(self, index: DenseIndex, *, max_views: int = 8, most_changes: int = MOST_CHANGES) -> None:
        self.max_views = max_views
        self._changes_left = most_changes
        self._all = index
        self._index = index
        self._closest: FloatArray | None = None
        self._so_far: DenseIndex | Belief = index
        self._before: deque[Belief] = deque(maxlen=self._NEWEST)
        self._queries: list[LevelArray] = []
        self._disturbed: set[int] = set()
        self._reliable, self._other_bench = True, False
        self._fits = Fits()

    def add(
        self,
        levels: LevelArray,
        orientation_deg: float,
        *,
        earlier: Sequence[LevelArray] | None = None,
        reliable: bool = True,
        other_bench: bool = False,
        disturbed: bool = False,
    ) -> StopDecision:
        """Add the next view, as for `update_belief`, and return the last decision.

        Parameters
        ----------
        levels : uint8 array (length,) or (h, length)
            The view; a row for each of several segmentations.
        orientation_deg : float
            Orientation of the camera around the object, from any zero that all views share.
        earlier : sequence of uint8 arrays, optional
            New descriptions of all earlier views, because they were segmented again, and better.
        reliable : bool
            Whether the views were segmented reliably (`hbr.ViewsTogether.reliable`). If not, the search does not end
            while it may take more views.
        other_bench : bool
            Whether the bench is certainly not that of the enrollment (`hbr.Background.shows_another_bench`).
        disturbed : bool
            Whether the table moved without a command since the view before, as if by hand.
        """
        self._reliable, self._other_bench = reliable, other_bench
        self.verification = None  # it was for the views before
        if earlier is not None:
            self._replace(earlier)
        self._begin_view(orientation_deg)
        self._extend(levels, orientation_deg)
        if disturbed:
            self._disturbed.add(self.belief.queries - 1)
        self.change = self._changed()
        self.present = self._decide()
        if self.is_new_decision:
            self.decision = self.present
        return self.decision

    def _changed(self) -> Change | None:
        """Begin again with the newest views if they show another object."""
        if not (self._changes_left and self.is_new_decision):
            return None
        found = changed(self.belief, self._before, disturbed=self._disturbed)
        if found is None:
            return None
        self._changes_left -= 1
        newest = self._queries[found.first :], self.belief.orientation_deg[found.first :].tolist()
        found = found._replace(first=self.left_out + found.first)
        self.left_out = found.first
        self._forget()
        for levels, orientation_deg in zip(*newest, strict=True):
            self._begin_view(orientation_deg)
            self._extend(levels, orientation_deg)
        self.is_new_decision = True
        return found

    def _forget(self) -> None:
        """Forget all views."""
        self._forget_queries()
        self._disturbed.clear()

    def _forget_queries(self) -> None:
        self._so_far, self._index, self._closest = self._all, self._all, None
        self._queries, self._fits = [], Fits()
        self._before.clear()

    def _begin_view(self, orientation_deg: float) -> None:
        """Set ``is_new_decision`` for the next view."""

    def _extend(self, levels: LevelArray, orientation_deg: float) -> None:
        """Add a view to the belief."""
        if self.is_new_decision and isinstance(self._so_far, Belief):
            self._before.append(self._so_far)
        weight = self._weight(orientation_deg)
        self._queries.append(levels)
        if self._shortlisted(levels):
            self._begin_again()
        self._so_far = self.belief = update_belief(levels, orientation_deg, self._so_far, weight=weight)

    def _shortlisted(self, levels: LevelArray) -> bool:
        """Choose the objects of a large catalog that are considered; return whether there are new ones.

        They are the ones with the most similar views to all queries so far, compared without the space.
        """
        if len(self._all) <= _WORTH_REDUCING * KEPT:
            return False
        closest = self._all.closest(levels)
        self._closest = closest if self._closest is None else self._closest + closest
        places = np.sort(np.argsort(-self._closest, kind="stable")[:KEPT])
        chosen = self._all.object_index[places]
        if self._index is not self._all and np.isin(chosen, self._index.object_index).all():
            return False
        self._index = self._all.only(places, None if self._index is self._all else self._index)
        return True

    def _begin_again(self) -> None:
        """Compute the belief of all earlier queries again, for the objects that are now considered."""
        earlier = self._so_far if isinstance(self._so_far, Belief) else None
        self._so_far = self._index
        self._before.clear()
        if earlier is None:
            return
        weights = [None] * earlier.queries if earlier.weights is None else earlier.weights.tolist()
        for query, deg, weight in zip(self._queries, earlier.orientation_deg.tolist(), weights, strict=False):
            self._so_far = update_belief(query, deg, self._so_far, weight=weight)

    def _replace(self, queries: Sequence[LevelArray]) -> None:
        """Compute the belief again from other descriptions of the same views."""
        if len(queries) != self.left_out + len(self._queries):
            raise ValueError(f"{len(queries)} earlier views; the search has {self.left_out + len(self._queries)}")
        queries = queries[self.left_out :]
        if all(np.array_equal(a, b) for a, b in zip(queries, self._queries, strict=True)):
            return
        orientations_deg = self.belief.orientation_deg.tolist()
        self._forget_queries()
        for query, orientation_deg in zip(queries, orientations_deg, strict=True):
            self._extend(query, orientation_deg)

    def next_best_view(self, rotations_deg: ArrayLike | None = None, seconds: ArrayLike | None = None) -> NextBestView:
        """Return the rotation to the next best view, as `hbr.next_best_view` does."""
        return next_best_view(
            self.belief, rotations_deg=rotations_deg, seconds=seconds, not_enrolled=self.decision.not_enrolled
        )

    def among_enrolled(self) -> FloatArray:
        """Return the probability of every object considered if the object on the table is enrolled, (k,)."""
        return among_enrolled(self.belief, self.verification)

    def end(self) -> StopDecision:
        """Return the decision with which the search ends here, even if it would continue."""
        return self.decision if self.decision.outcome is not Outcome.CONTINUE else self._decide(last=True)

    def verify(self, queries: Queries, measured: PixelFit | None = None) -> Asking[PixelFit | None]:
        """Compare the leader with the views pixel by pixel, and decide again; None if that is not worth its time.

        A fit that was ``measured`` before is used instead of enrolled views.
        """
        if measured is None and self._is_worth_a_fit():
            measured = yield from verify(self.belief, queries, self._fits)
        self.verification = measured
        if measured is not None:
            self.decision = self.present = self._decide()
        return measured

    def _is_worth_a_fit(self) -> bool:
        last = self.belief.queries >= self.max_views
        return (last or self._reliable) and self.decision.not_enrolled < (HOPELESS if last else _NOT_WORTH_A_FIT)

    def _weight(self, orientation_deg: float) -> float | None:  # noqa: ARG002
        """Return the weight of the next view; None: 1."""
        return None

    def _decide(self, *, last: bool = False) -> StopDecision:
        last = last or self.belief.queries >= self.max_views
        return decide(
            self.belief,
            last=last,
            reliable=self._reliable,
            fit=self.verification,
            other_bench=self._other_bench,
        )
