"""The last step of a search that does not end with one object: the two leaders, compared pixel by pixel.

Decision: docs/decisions/0058.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

import hbr
from hbr import Outcome, StopReason
from hbr.core.angles import wrap360
from hbr.dense.local_difference import (
    NEAREST,
    LocalDecision,
    LocalView,
    ViewDifference,
    chosen_views,
    compare_objects,
    poses_of,
)
from rig.events.compared import Compared, ComparedView
from rig.events.events import Identified
from rig.search.session import DenseSearch, Search

LEADERS: Final = 0.9
"""Share of the probability that the two leaders have together."""
TWIN_MARGIN: Final = 0.02
"""Near twins score nearly the same: with a larger margin, an unknown object is not compared with the two leaders."""
SHOWN_VIEWS: Final = 3
TILE_PX: Final = 160

LeaderViews = Callable[[str, Sequence[float]], Sequence[LocalView]]
"""Returns the enrolled views of an object near some azimuths."""


@dataclass(frozen=True, eq=False)
class Comparison:
    """A comparison of the two leaders: its event, and the fields of the answer that follow from it."""

    event: Compared
    changes: dict[str, Any]

    def answer_of(self, answer: Identified) -> Identified:
        """Return the answer of the search after the comparison."""
        return replace(answer, **self.changes)


def compare_leaders(
    search: Search, answer: Identified, segmentations: Sequence[hbr.Segmentation], leader_views: LeaderViews
) -> Comparison | None:
    """Compare the two leaders of a search that is ambiguous, or that calls near twins unknown; None if it has no two.

    An enrolled twin takes away the lead that the open-set score measures. So an object that fits one of two near twins
    up to noise is not unknown.

    Parameters
    ----------
    search
        After its last view.
    answer
        Its answer.
    segmentations
        The views of the search.
    leader_views
        Returns enrolled views.

    Raises
    ------
    CatalogError
        From ``leader_views``.
    """
    if not isinstance(search, DenseSearch) or answer.outcome is Outcome.FOUND:
        return None
    if answer.outcome is Outcome.UNKNOWN and answer.margin > TWIN_MARGIN:
        return None
    belief, names = search.belief, search.belief.index.views.object_names
    probability = belief.posterior(search.beta).sum(axis=1)
    order = np.argsort(-probability, kind="stable")[:2]
    if len(order) < 2 or float(probability[order].sum()) < LEADERS:
        return None
    leaders = [int(belief.index.object_index[place]) for place in order]
    orientations_deg = search.orientations_deg
    chosen = chosen_views(orientations_deg)
    queries = [LocalView(segmentations[n].crop, segmentations[n].mask, orientations_deg[n]) for n in chosen]
    rotations_deg = [tuple(deg - orientations_deg[-1] for deg in poses_of(belief, leader)) for leader in leaders]
    views = [
        leader_views(
            names[leader],
            [float(wrap360(query.azimuth_deg + added_deg)) for added_deg in rotations for query in queries],
        )
        for leader, rotations in zip(leaders, rotations_deg, strict=True)
    ]
    if min(map(len, views)) <= NEAREST:
        return None
    found = compare_objects(
        queries,
        (views[0], views[1]),
        (rotations_deg[0], rotations_deg[1]),
        max_error=search.error_rate,
    )
    event = Compared(
        index=len(orientations_deg) - 1,
        names=(names[leaders[0]], names[leaders[1]]),
        winner=None if found.winner is None else names[leaders[found.winner]],
        score=found.score,
        expected=found.expected,
        error_bound=found.error_bound,
        max_error=search.error_rate,
        unexplained=found.unexplained,
        misfit=found.misfit,
        apart=found.apart,
        views=tuple(ComparedView(chosen[one.view], one.score, one.weight) for one in found.views),
        azimuths_deg=(_azimuths(views[0]), _azimuths(views[1])),
        picture_bgr=_picture(found.views),
        leaders=(_pixels(views[0]), _pixels(views[1])),
    )
    return Comparison(event, _changes(search, answer.outcome, found, (leaders[0], leaders[1])))


def _changes(search: DenseSearch, outcome: Outcome, found: LocalDecision, leaders: tuple[int, int]) -> dict[str, Any]:
    """Return the fields of the answer that the comparison changes."""
    names = search.belief.index.views.object_names
    if outcome is Outcome.UNKNOWN and not (found.fits and found.twins):
        return {}
    if found.winner is not None:
        winner = leaders[found.winner]
        return {
            "name": names[winner],
            "outcome": Outcome.FOUND,
            "possible": (names[winner],),
            "reason": StopReason.LOCAL_DIFFERENCE,
            "confidence": 1.0 - found.error_bound,
            "min_confidence": 1.0 - search.error_rate,
            **search.pose_fields(winner),
        }
    if outcome is Outcome.UNKNOWN:
        return {
            "name": names[leaders[0]],
            "outcome": Outcome.AMBIGUOUS,
            "possible": tuple(names[leader] for leader in leaders),
            "reason": StopReason.LOCAL_DIFFERENCE,
        }
    return {}


def saved_leader_views(event: Compared) -> LeaderViews:
    """Return what returns the enrolled views of a saved comparison."""

    def views(name: str, _: Sequence[float]) -> list[LocalView]:
        side = event.names.index(name)
        pairs = zip(event.leaders[side], event.azimuths_deg[side], strict=True)
        return [LocalView(*_parts(image), azimuth_deg) for image, azimuth_deg in pairs]

    return views


def _azimuths(views: Sequence[LocalView]) -> tuple[float, ...]:
    return tuple(view.azimuth_deg for view in views)


def _pixels(views: Sequence[LocalView]) -> tuple[NDArray[np.uint8], ...]:
    """Return crop and mask side by side, to be stored as an image, uint8 (160, 320, 3)."""
    return tuple(np.hstack([view.crop, np.repeat(view.mask[:, :, None], 3, axis=2)]) for view in views)


def _parts(image: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    side = image.shape[1] // 2
    if image.shape[1] != 2 * image.shape[0]:
        raise ValueError("the enrolled view of a comparison has another shape")
    return image[:, :side], np.ascontiguousarray(image[:, side:, 0])


def _picture(views: Sequence[ViewDifference]) -> NDArray[np.uint8] | None:
    """Return a row for each of the clearest views: the view, both enrolled views, and where these differ; or None."""
    if not views:
        return None
    size = (TILE_PX, TILE_PX)
    rows = []
    for one in views[:SHOWN_VIEWS]:
        tiles = [cv2.resize(tile, size, interpolation=cv2.INTER_CUBIC) for tile in (one.query, one.first, one.second)]
        rows.append(np.hstack([*tiles, _marked(tiles[0], cv2.resize(one.difference, size))]))
    return np.vstack(rows).astype(np.uint8, copy=False)


def _marked(view: NDArray[Any], difference: NDArray[Any]) -> NDArray[np.uint8]:
    """Return a view in grey, red where the enrolled views differ, with a frame around the largest part."""
    grey = cv2.cvtColor(cv2.cvtColor(view, cv2.COLOR_BGR2GRAY), cv2.COLOR_GRAY2BGR).astype(np.float32) * 0.6
    share = np.clip(difference / max(float(difference.max()), 1.0), 0, 1)[:, :, None]
    marked: NDArray[np.uint8] = (grey * (1 - share) + np.array([40.0, 40.0, 255.0], np.float32) * share).astype(
        np.uint8
    )
    _, _, stats, _ = cv2.connectedComponentsWithStats((share[:, :, 0] > 0.25).astype(np.uint8))
    if len(stats) > 1:
        x, y, w, h, _ = stats[1 + int(stats[1:, cv2.CC_STAT_AREA].argmax())].tolist()
        cv2.rectangle(marked, (x - 4, y - 4), (x + w + 3, y + h + 3), (60, 220, 255), 1, cv2.LINE_AA)
    return marked
