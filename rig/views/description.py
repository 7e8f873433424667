"""Description of views: the levels of several descriptors, and the evidence of the segmentation.

Decision: docs/decisions/0029.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

import hbr
from hbr.segmentation import MIN_AGREEMENT, Issue, IssueCode
from rig.config import ViewConfig
from rig.core.errors import UsageError
from rig.views.table_problems import TableProblem, TableProblemCode

PAPER_DESCRIPTOR: Final = "cedd"
"""The paper's descriptor. It describes the whole region of interest, with the background."""
BENCH_DESCRIPTOR: Final = "edges+colours"
"""The rig's own descriptor. It describes only the object, with corrected illumination."""
DESCRIPTORS: Final = (PAPER_DESCRIPTOR, BENCH_DESCRIPTOR)
"""The descriptors of every enrolled view."""
IN_A_ROW: Final = 3
"""So many frames must differ from the empty-table image: one or two can show an arm that reached into the frame."""


@dataclass(frozen=True, slots=True, eq=False)
class DescribedView:
    """The description of a view, as it is stored and compared.

    Attributes
    ----------
    levels : mapping of name to uint8 array (length,)
        Levels of each descriptor.
    segmentation
        `hbr.Segmentation.evidence` as JSON values; None if no segmentation was made.
    table_problem
        Set for the view after which it is clear that the bench no longer looks like its empty-table image.
    earlier : tuple of uint8 arrays (k, length), optional
        In a search: the levels of all earlier views, which were segmented again; a row for each segmentation.
    """

    levels: Mapping[str, NDArray[np.uint8]]
    segmentation: dict[str, Any] | None
    table_problem: TableProblem | None = None
    earlier: tuple[NDArray[np.uint8], ...] | None = None


def within(image_bgr: NDArray[np.uint8], region: tuple[int, int, int, int] | None) -> NDArray[np.uint8]:
    """Return a region of an image, uint8 (h, w, 3); the whole image if the region is None.

    Raises
    ------
    UsageError
        The region does not lie within the image.
    """
    if region is None:
        return image_bgr
    x, y, width, height = region
    if min(x, y) < 0 or min(width, height) < 1 or x + width > image_bgr.shape[1] or y + height > image_bgr.shape[0]:
        raise UsageError(
            f"the region {list(region)} does not lie within an image of {image_bgr.shape[1]}x{image_bgr.shape[0]}",
            next_step="give a region within the images: x, y, width, height in pixels",
        )
    return image_bgr[y : y + height, x : x + width]


class ViewDescriber:
    """Describes views of one bench by several descriptors. Segmentation runs once for each view.

    The paper's descriptors describe the whole region of interest. All others describe only the object.

    Parameters
    ----------
    config
        Its region of interest is described.
    names
        The descriptors.
    empty_table : uint8 array (H, W, 3), optional
        The bench's empty-table image: a whole frame of the same size as the views.

    Raises
    ------
    ValueError
        A descriptor is unknown.
    """

    def __init__(
        self, config: ViewConfig, names: tuple[str, ...] = DESCRIPTORS, empty_table: NDArray[np.uint8] | None = None
    ) -> None:
        self.region = config.roi
        self._descriptors = [hbr.descriptor(name) for name in names]
        self._segments = any(not one.whole_image for one in self._descriptors)
        self._table = empty_table if self._segments else None
        self._background: hbr.Background | None = None
        self._low: list[float] = []
        self._reported = False

    def __call__(self, image_bgr: NDArray[np.uint8]) -> DescribedView:
        """Describe a frame, uint8 (H, W, 3).

        Raises
        ------
        UsageError
            The region does not lie within the frame.
        ValueError
            The region is too small for a segmentation.
        """
        part = within(image_bgr, self.region)
        found = self.segment(image_bgr) if self._segments else None
        levels = {
            one.name: one.describe(part if found is None or one.whole_image else found) for one in self._descriptors
        }
        if found is None:
            return DescribedView(levels, None)
        return DescribedView(levels, found.evidence(), self._table_problem(found.agreement))

    def _table_problem(self, agreement: float | None) -> TableProblem | None:
        """Return a problem after `IN_A_ROW` frames that differ from the empty-table image, but only once."""
        if agreement is None or self._reported:
            return None
        self._low = [*self._low, agreement] if agreement < MIN_AGREEMENT else []
        if len(self._low) < IN_A_ROW:
            return None
        self._reported = True
        parameters = {"frames": IN_A_ROW, "agreement": round(max(self._low), 3)}
        return TableProblem(TableProblemCode.SURROUNDINGS, parameters)

    def segment(self, image_bgr: NDArray[np.uint8]) -> hbr.Segmentation:
        """Return the segmentation of the region of interest in a frame, uint8 (H, W, 3); errors as for a call."""
        part = within(image_bgr, self.region)
        if self._table is None:
            return hbr.segment(part)
        if self._table.shape != image_bgr.shape:
            sizes = {"table_px": list(self._table.shape[1::-1]), "frame_px": list(image_bgr.shape[1::-1])}
            found = hbr.segment(part)
            return replace(found, issues=(Issue(IssueCode.TABLE_SIZE, sizes), *found.issues))
        if self._background is None:
            self._background = hbr.Background(within(self._table, self.region))
        return hbr.segment(part, empty_table=self._background)


class SearchDescriber(ViewDescriber):
    """Describes the views of one search by one descriptor, with several segmentations of each view.

    The background is learned from all views of the search, so that each view also improves the earlier ones
    (`hbr.ViewsTogether`). The levels have a row for each segmentation.

    Parameters
    ----------
    config, empty_table
        As for `ViewDescriber`.
    name
        The descriptor.

    Raises
    ------
    ValueError
        The descriptor is unknown.
    """

    def __init__(self, config: ViewConfig, name: str, empty_table: NDArray[np.uint8] | None = None) -> None:
        super().__init__(config, (name,), empty_table)
        self._name = name
        self._views: hbr.ViewsTogether | None = None

    def __call__(self, image_bgr: NDArray[np.uint8]) -> DescribedView:
        """Describe the next frame of the search; errors as for `ViewDescriber`."""
        if not self._segments:
            return super().__call__(image_bgr)
        part = within(image_bgr, self.region)
        fits = self._table is None or self._table.shape == image_bgr.shape
        if self._views is None:
            table = within(self._table, self.region) if self._table is not None and fits else None
            self._views = hbr.ViewsTogether(self._name, empty_table=table)
        found = self._views.add(part)[0]
        if self._table is not None and not fits:
            sizes = {"table_px": list(self._table.shape[1::-1]), "frame_px": list(image_bgr.shape[1::-1])}
            found = replace(found, issues=(Issue(IssueCode.TABLE_SIZE, sizes), *found.issues))
        *earlier, levels = self._views.levels
        problem = self._table_problem(found.agreement)
        return DescribedView({self._name: levels}, found.evidence(), problem, tuple(earlier))
