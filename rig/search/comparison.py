"""The event of a comparison of two leaders pixel by pixel, with its pictures, and the enrolled views of a saved one."""

from collections.abc import Callable, Sequence
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from hbr.dense.last_steps import LeaderComparison
from hbr.dense.local_difference import LocalView, ViewDifference
from rig.events.compared import Compared, ComparedView

SHOWN_VIEWS: Final = 3
TILE_PX: Final = 160

EnrolledViews = Callable[[str, Sequence[float]], Sequence[LocalView]]
"""Returns the enrolled views of an object near some azimuths."""


def compared_event(index: int, comparison: LeaderComparison, names: tuple[str, ...]) -> Compared:
    """Return the event of a comparison after the last view; ``names`` are those of the enrolled objects."""
    found = comparison.found
    first, second = comparison.leaders
    return Compared(
        index=index,
        names=(names[first], names[second]),
        winner=None if found.winner is None else names[comparison.leaders[found.winner]],
        score=found.score,
        expected=found.expected,
        error_bound=found.error_bound,
        max_error=comparison.max_error,
        unexplained=found.unexplained,
        misfit=found.misfit,
        apart=found.apart,
        views=tuple(ComparedView(comparison.compared[one.view], one.score, one.weight) for one in found.views),
        azimuths_deg=(_azimuths(comparison.views[0]), _azimuths(comparison.views[1])),
        picture_bgr=_picture(found.views),
        leaders=(_pixels(comparison.views[0]), _pixels(comparison.views[1])),
    )


def saved_enrolled_views(
    event: Compared, names: Sequence[str]
) -> Callable[[int, Sequence[float]], Sequence[LocalView]]:
    """Return a function that returns the enrolled views of a saved comparison, by the index of the object's name."""

    def views(object_index: int, _: Sequence[float]) -> list[LocalView]:
        side = event.names.index(names[object_index])
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
