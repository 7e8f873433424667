"""The last steps of a doubtful search: the leader is verified, and two leaders are compared, pixel by pixel.

Decisions: docs/decisions/0057, docs/decisions/0059.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

import hbr
from hbr import Outcome, StopReason
from hbr.dense import leaders
from hbr.dense.local_difference import LocalView, ViewDifference
from hbr.dense.verification import UNKNOWN_BELOW, Verification, verify
from rig.events.compared import Compared, ComparedView, Verified
from rig.events.events import Identified
from rig.search.session import ArcSearch, DenseSearch, Search

SHOWN_VIEWS: Final = 3
TILE_PX: Final = 160

LeaderViews = Callable[[str, Sequence[float]], Sequence[LocalView]]
"""Returns the enrolled views of an object near some azimuths."""


@dataclass(frozen=True, eq=False)
class Comparison:
    """A comparison of the two leaders: its event, and the fields of the answer that it changes."""

    event: Compared
    changes: dict[str, Any]

    def answer_of(self, answer: Identified) -> Identified:
        """Return the answer of the search after the comparison."""
        return replace(answer, **self.changes)


def verify_leader(
    search: Search, hypotheses: Sequence[Sequence[hbr.Segmentation]], leader_views: LeaderViews
) -> Verified | None:
    """Compare the views with a doubtful leader's enrolled views, and use the result in the answer; None without doubt.

    A search in motion is not verified: its frames are smeared, and mostly not segmented again.

    Parameters
    ----------
    search
        After its last view.
    hypotheses
        All segmentations of each view of the search.
    leader_views
        Returns enrolled views.

    Raises
    ------
    CatalogError
        The enrolled views cannot be read.
    """
    if not isinstance(search, DenseSearch) or isinstance(search, ArcSearch) or not search.is_doubtful:
        return None
    names, orientations_deg = search.belief.index.views.object_names, search.orientations_deg
    found = verify(
        search.belief,
        search.decision.object_index,
        lambda n: [LocalView(one.crop, one.mask, orientations_deg[n]) for one in hypotheses[n]],
        lambda leader, azimuths_deg: leader_views(names[leader], azimuths_deg),
    )
    return with_verification(search, found)


def with_verification(search: DenseSearch, found: Verification) -> Verified:
    """Use a verification of the leader in the answer of a search; return the event."""
    score = found.score(search.decision.open_set_score)
    search.set_verification(found)
    return Verified(
        index=len(search.orientations_deg) - 1,
        name=search.belief.index.views.object_names[found.object_index],
        fit=found.fit,
        others=found.others,
        score=score,
        found_from=search.found_from,
        unknown_below=UNKNOWN_BELOW,
        outcome=search.decision.outcome,
    )


def compare_leaders(
    search: Search, answer: Identified, segmentations: Sequence[hbr.Segmentation], leader_views: LeaderViews
) -> Comparison | None:
    """Compare the two leaders of a search (`hbr.dense.leaders`); None if it has no two that are to be compared.

    ``answer`` is that of the search, and ``segmentations`` has the likeliest one of each view; the rest is as for
    `verify_leader`.
    """
    if not isinstance(search, DenseSearch):
        return None
    names, orientations_deg = search.belief.index.views.object_names, search.orientations_deg
    compared = leaders.compare_leaders(
        search.belief,
        answer.outcome,
        orientations_deg,
        lambda n: LocalView(segmentations[n].crop, segmentations[n].mask, orientations_deg[n]),
        lambda leader, azimuths_deg: leader_views(names[leader], azimuths_deg),
        beta=search.beta,
        max_error=search.error_rate,
    )
    if compared is None:
        return None
    found = compared.found
    first, second = compared.leaders
    event = Compared(
        index=len(orientations_deg) - 1,
        names=(names[first], names[second]),
        winner=None if found.winner is None else names[compared.leaders[found.winner]],
        score=found.score,
        expected=found.expected,
        error_bound=found.error_bound,
        max_error=search.error_rate,
        unexplained=found.unexplained,
        misfit=found.misfit,
        apart=found.apart,
        views=tuple(ComparedView(compared.compared[one.view], one.score, one.weight) for one in found.views),
        azimuths_deg=(_azimuths(compared.views[0]), _azimuths(compared.views[1])),
        picture_bgr=_picture(found.views),
        leaders=(_pixels(compared.views[0]), _pixels(compared.views[1])),
    )
    return Comparison(event, _changes(search, answer.outcome, compared))


def _changes(search: DenseSearch, outcome: Outcome, compared: leaders.LeaderComparison) -> dict[str, Any]:
    """Return the fields of the answer that the comparison changes."""
    names = search.belief.index.views.object_names
    if compared.winner is not None:
        return {
            "name": names[compared.winner],
            "outcome": Outcome.FOUND,
            "possible": (names[compared.winner],),
            "reason": StopReason.LOCAL_DIFFERENCE,
            "confidence": 1.0 - compared.found.error_bound,
            "min_confidence": 1.0 - search.error_rate,
            **search.pose_fields(compared.winner),
        }
    if compared.outcome is not outcome:
        return {
            "name": names[compared.leaders[0]],
            "outcome": compared.outcome,
            "possible": tuple(names[leader] for leader in compared.leaders),
            "reason": StopReason.LOCAL_DIFFERENCE,
        }
    return {}


def saved_leader_views(event: Compared) -> LeaderViews:
    """Return a function that returns the enrolled views of a saved comparison."""

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
