"""Description of views that belong together: those of one search, or of one enrollment.

They share a background, which is learned while the table rotates (`hbr.segmentation.learned`). So the second view also
improves the segmentation of the first one. Further views hardly improve those that were segmented by rotation.
"""

from functools import partial
from typing import Final

import numpy as np

from hbr.core.arrays import ImageArray, LevelArray
from hbr.descriptors.base import Descriptor
from hbr.descriptors.registry import descriptor as descriptor_of
from hbr.segmentation import Background, Method, Segmentation, hypotheses
from hbr.segmentation.cut_out import Found
from hbr.segmentation.frame import Frame
from hbr.segmentation.learned import LearnedBackground
from hbr.segmentation.segment import MOST_HYPOTHESES, without_background

#: Methods whose segmentations are as good as those of enrolled views.
_EXACT: Final = (Method.PLAIN_BACKGROUND, Method.EMPTY_TABLE)
#: Methods that use a known background.
RELIABLE: Final = (*_EXACT, Method.ROTATION)


def like_enrollment(method: str, same_bench: bool | None) -> bool | None:
    """Return whether a view is described under the conditions of the enrollment; None: not known.

    Parameters
    ----------
    method : str
        A `Method`. A segmentation by rotation changes a description as much as another bench does.
    same_bench : bool or None
        Whether the bench is that of the enrollment; None: not known.
    """
    return None if same_bench and method not in _EXACT else same_bench


class ViewsTogether:
    """The views of one search or enrollment, each described by several segmentations.

    ::

        views = hbr.ViewsTogether("edges+colours", empty_table=table)  # or without an empty-table image
        for frame, orientation_deg in frames:
            views.add(frame)
            *earlier, levels = views.levels
            decision = session.add(levels, orientation_deg, earlier=earlier, reliable=views.reliable)

    Parameters
    ----------
    descriptor : str or Descriptor
        A descriptor of the object.
    empty_table : Background, or uint8 array (H, W, 3), optional
        As for `hbr.segment`.
    several : bool
        Whether each view has several segmentations, for a search; an enrollment has one.

    Attributes
    ----------
    segmentations : list of tuple of Segmentation
        Of each view, the likeliest first.
    levels : list of uint8 array (k, length)
        Levels of each view, a row for each segmentation.
    """

    def __init__(
        self,
        descriptor: str | Descriptor,
        *,
        empty_table: Background | ImageArray | None = None,
        several: bool = True,
    ) -> None:
        self._descriptor = descriptor_of(descriptor) if isinstance(descriptor, str) else descriptor
        self._table = Background(empty_table) if isinstance(empty_table, np.ndarray) else empty_table
        self._several = several
        self._frames: list[Frame | None] = []
        self._learned = LearnedBackground()
        self.segmentations: list[tuple[Segmentation, ...]] = []
        self.levels: list[LevelArray] = []

    def add(self, image_bgr: ImageArray, *, revise: bool = True, keep: bool = True) -> tuple[Segmentation, ...]:
        """Add a view, and revise the earlier ones if asked for; return the segmentations of the new view.

        If many views are not revised, the object is guessed only in the first one. If the image is not stored, `revise`
        does not change the view's segmentations, and a long search needs less memory.

        Raises
        ------
        TypeError, ValueError
            As for `hbr.segment`, or the view has another size than the others.
        """
        self.learn(image_bgr)
        if revise:
            self.revise()
        else:
            self._describe(len(self._frames) - 1)
        if not keep:
            self._frames[-1] = None
        return self.segmentations[-1]

    def learn(self, image_bgr: ImageArray) -> None:
        """Add a view that `revise` segments and describes together with the others; errors as for `add`."""
        frame = Frame(image_bgr)
        self._learned.add(image_bgr, frame.small)
        self._frames.append(frame)
        self.segmentations.append(())
        self.levels.append(np.empty((0, self._descriptor.length), np.uint8))

    @property
    def reliable(self) -> bool:
        """Whether the last view was segmented by a known background; without an empty-table image the first was not."""
        return self.segmentations[-1][0].method in RELIABLE

    def revise(self) -> None:
        """Segment the views whose background was not known again, with the background that the other views show."""
        for view, found in enumerate(self.segmentations):
            if self._frames[view] is not None and (not found or found[0].method not in RELIABLE):
                self._describe(view, guess=self._several)

    def _describe(self, view: int, *, guess: bool = False) -> None:
        frame = self._frames[view]
        assert frame is not None
        known = dict(zip(map(id, self.segmentations[view]), self.levels[view], strict=True))
        found = hypotheses(
            frame,
            empty_table=self._table,
            learned=self._learned.of(view),
            alone=partial(self._without_background, view, frame) if guess else None,
            most=MOST_HYPOTHESES if self._several else 1,
        )
        levels = [known[id(one)] if id(one) in known else self._descriptor.describe(one) for one in found]
        self.segmentations[view] = found
        self.levels[view] = np.stack(levels)

    def _without_background(self, view: int, frame: Frame) -> tuple[Segmentation | Found, ...]:
        """Return the segmentations of a view that no other view changes."""
        known = self.segmentations[view]
        return known if known and known[0].method is Method.GUESS else without_background(frame)
