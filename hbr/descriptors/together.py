"""Description of views that belong together: those of one search, or of one enrollment.

While the table rotates, the background stands still, and the object and the platter's marks move. So a view is compared
with the median of the other views: behind the object most of them show the background. Such a median can show the
object, too; the network was trained with such medians and combines them with the frame. So the second view also
improves the segmentation of the first one. Further views hardly improve those that were segmented by rotation.
"""

from dataclasses import replace
from typing import Final

import numpy as np

from hbr.core.arrays import ImageArray, LevelArray
from hbr.descriptors.base import Descriptor
from hbr.descriptors.registry import descriptor as descriptor_of
from hbr.segmentation import BoxMethod, Segmentation, hypotheses
from hbr.segmentation.background import Background, SegmentedFrame, shrunk
from hbr.segmentation.segment import MOST_HYPOTHESES

#: Largest number of views that the background is learned from.
_MOST: Final = 9


class LearnedBackground:
    """The views of one search or enrollment, from one camera before one background in one light."""

    def __init__(self) -> None:
        self._shape: tuple[int, int] | None = None
        self._small: list[ImageArray] = []

    def __len__(self) -> int:
        return len(self._small)

    def add(self, image_bgr: ImageArray, small: ImageArray | None = None) -> None:
        """Add a view, uint8 (H, W, 3); ``small`` is what `shrunk` returns for it, if that is known.

        Raises `ValueError`: the view has another size than the others.
        """
        height, width = image_bgr.shape[:2]
        if self._shape is not None and self._shape != (height, width):
            raise ValueError(
                f"the view has {width} x {height} pixels, the others {self._shape[1]} x {self._shape[0]}; "
                "views of one search need one size"
            )
        self._shape = height, width
        self._small.append(shrunk(image_bgr) if small is None else small)

    def of(self, view: int) -> Background | None:
        """Return the background of a view, learned from the others; None with a single view."""
        others = [n for n in range(len(self)) if n != view]
        if not others or self._shape is None:
            return None
        if len(others) > _MOST:  # evenly spread over all views
            others = [others[n * len(others) // _MOST] for n in range(_MOST)]
        return Background.learned([self._small[n] for n in others], self._shape)


#: Methods that use a known background.
_RELIABLE: Final = (BoxMethod.PLAIN_BACKGROUND, BoxMethod.EMPTY_TABLE, BoxMethod.ROTATION)


class ViewsTogether:
    """The views of one search or enrollment, each described by several segmentations.

    ::

        views = hbr.ViewsTogether("edges+colours+cedd")
        for frame, orientation_deg in frames:
            views.add(frame, table)  # or without an empty-table image
            *earlier, levels = views.levels
            decision = session.add(levels, orientation_deg, earlier=earlier, reliable=views.reliable)

    Parameters
    ----------
    descriptor : str or Descriptor
        A descriptor of the object.
    several : bool
        Whether each view has several segmentations, for a search; an enrollment has one.

    Attributes
    ----------
    segmentations : list of tuple of Segmentation
        Of each view, the likeliest first.
    levels : list of uint8 array (k, length)
        Levels of each view, a row for each segmentation.
    """

    def __init__(self, descriptor: str | Descriptor, *, several: bool = True) -> None:
        self._descriptor = descriptor_of(descriptor) if isinstance(descriptor, str) else descriptor
        self._several = several
        self._frames: list[SegmentedFrame | None] = []
        self._tables: list[Background | None] = []
        self._learned = LearnedBackground()
        self.segmentations: list[tuple[Segmentation, ...]] = []
        self.levels: list[LevelArray] = []

    def add(
        self,
        image_bgr: ImageArray,
        empty_table: Background | ImageArray | None = None,
        *,
        revise: bool = True,
        keep: bool = True,
    ) -> tuple[Segmentation, ...]:
        """Add a view, and revise the earlier ones if asked for; return the segmentations of the new view.

        ``empty_table`` is the empty-table image for this view, as for `hbr.segment`.

        The object is guessed only in the first view. If the image is not stored, `revise` does not change the view's
        segmentations, and a long search needs less memory.

        Raises `TypeError`, `ValueError`: as for `hbr.segment`, or the view has another size than the others.
        """
        self.learn(image_bgr, empty_table)
        if revise:
            self.revise()
        else:
            self._describe(len(self._frames) - 1)
        if not keep:
            self._frames[-1] = None
            self.segmentations[-1] = tuple(replace(one, frame=None) for one in self.segmentations[-1])
        return self.segmentations[-1]

    def learn(self, image_bgr: ImageArray, empty_table: Background | ImageArray | None = None) -> None:
        """Add a view that `revise` segments and describes together with the others; errors as for `add`."""
        frame = SegmentedFrame(image_bgr)
        self._learned.add(image_bgr, frame.small)
        self._frames.append(frame)
        self._tables.append(Background(empty_table) if isinstance(empty_table, np.ndarray) else empty_table)
        self.segmentations.append(())
        self.levels.append(np.empty((0, self._descriptor.length), np.uint8))

    @property
    def reliable(self) -> bool:
        """Whether the last view was segmented by a known background; without an empty-table image the first was not."""
        return self.segmentations[-1][0].method in _RELIABLE

    def revise(self) -> None:
        """Segment the views whose background was not known again, with the background that the other views show."""
        for view, found in enumerate(self.segmentations):
            if self._frames[view] is not None and (not found or found[0].method not in _RELIABLE):
                self._describe(view)

    def _describe(self, view: int) -> None:
        frame = self._frames[view]
        assert frame is not None
        before = self.segmentations[view]
        known = dict(zip(map(id, before), self.levels[view], strict=True))
        found = hypotheses(
            frame,
            empty_table=self._tables[view],
            learned=self._learned.of(view),
            alone=before if before and before[0].method in (BoxMethod.GUESS, BoxMethod.NETWORK) else (),
            most=MOST_HYPOTHESES if self._several else 1,
        )
        levels = [known[id(one)] if id(one) in known else self._descriptor.describe(one) for one in found]
        self.segmentations[view] = found
        self.levels[view] = np.stack(levels)
