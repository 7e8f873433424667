"""What a bench keeps of a picture: the levels of several descriptors, and how the object was found and lit."""

import re
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

import hbr
from hbr.descriptors import PAPERS
from rig.config import ViewConfig
from rig.core.errors import UsageError

PAPER_DESCRIPTOR: Final = "cedd"
"""The paper's: of the whole region, whatever else is in it."""
BENCH_DESCRIPTOR: Final = "edges+colours"
"""The bench's own: of the object alone, in the light of the empty table."""
DESCRIPTORS: Final = (PAPER_DESCRIPTOR, BENCH_DESCRIPTOR)
"""What every view is described by when it is taken."""

_NUMBER: Final = re.compile(r"\d+%")
_GUESSED: Final = "guessed"


@dataclass(frozen=True, slots=True, eq=False)
class Described:
    """A picture as it is kept and compared.

    Attributes
    ----------
    levels : mapping of name to uint8 array (length,)
        By each descriptor.
    segmentation
        `hbr.Segmentation.evidence` as JSON values; None if no segmentation was made.
    """

    levels: Mapping[str, NDArray[np.uint8]]
    segmentation: dict[str, Any] | None


def within(image_bgr: NDArray[np.uint8], region: tuple[int, int, int, int] | None) -> NDArray[np.uint8]:
    """Return the part of an image, uint8 (h, w, 3).

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


@dataclass(frozen=True, slots=True)
class SegmentationSummary:
    """How the objects of several views were found.

    Attributes
    ----------
    views
        In which they were looked for.
    found, guessed, lit
        In how many the object was found, and only guessed; and in how many its light was normalised.
    refused
        What could not be done, with a reason, and in how many views; the most frequent first.
    """

    views: int
    found: int
    guessed: int
    lit: int
    refused: Mapping[str, int]

    @classmethod
    def of(cls, segmentations: Iterable[Mapping[str, Any] | None]) -> "SegmentationSummary":
        """Sum up what the front end left with views; None is a view in which nothing looked."""
        seen = [one for one in segmentations if one is not None]
        reasons = Counter(
            _NUMBER.sub("…", words) for one in seen for words in dict.fromkeys(map(str, one.get("refused") or ()))
        )
        guesses = [any(_GUESSED in str(words) for words in one.get("refused") or ()) for one in seen]
        boxes = [one.get("box_px") is not None for one in seen]
        return cls(
            views=len(seen),
            found=sum(box and not guess for box, guess in zip(boxes, guesses, strict=True)),
            guessed=sum(box and guess for box, guess in zip(boxes, guesses, strict=True)),
            lit=sum(one.get("gains_bgr") is not None for one in seen),
            refused=dict(reasons.most_common()),
        )

    @property
    def words(self) -> str:
        """Return it as a line; empty where nothing looked for an object."""
        if not self.views:
            return ""
        guessed = f", guessed in {self.guessed}" if self.guessed else ""
        refused = "".join(f"; {words} ({count})" for words, count in self.refused.items())
        return f"object found in {self.found} of {self.views} views{guessed}, light normalised in {self.lit}{refused}"


class Describer:
    """Describes pictures of one bench by several descriptors; the object is looked for once.

    The paper's descriptors take the whole region as it is. All others are of the object alone, which is found by what
    differs from the empty table, if its picture is given and belongs to the frame.

    Parameters
    ----------
    config
        Its region of interest is what is described.
    names
        The descriptors.
    empty_table : uint8 array (H, W, 3), optional
        The bench without an object: a whole frame, like those to be described.

    Raises
    ------
    ValueError
        There is no such descriptor.
    """

    def __init__(
        self,
        config: ViewConfig,
        names: tuple[str, ...] = DESCRIPTORS,
        empty_table: NDArray[np.uint8] | None = None,
    ) -> None:
        self.region = config.roi
        self._kinds = [hbr.descriptor(name) for name in names]
        self._sights = any(name not in PAPERS for name in names)
        self._table = empty_table if self._sights else None
        self._background: hbr.Background | None = None

    def __call__(self, image_bgr: NDArray[np.uint8]) -> Described:
        """Describe a frame, uint8 (H, W, 3).

        Raises
        ------
        UsageError
            The region does not lie within the frame.
        ValueError
            It is too small to look for an object in.
        """
        part = within(image_bgr, self.region)
        seen = self._sight(image_bgr, part) if self._sights else None
        return Described(
            {kind.name: kind.describe(part if seen is None or kind.name in PAPERS else seen) for kind in self._kinds},
            None if seen is None else seen.evidence(),
        )

    def _sight(self, image_bgr: NDArray[np.uint8], part: NDArray[np.uint8]) -> hbr.Segmentation:
        if self._table is None:
            return hbr.segment(part)
        if self._table.shape != image_bgr.shape:
            (height, width), (its_height, its_width) = image_bgr.shape[:2], self._table.shape[:2]
            words = f"the reference: it has {its_width} x {its_height} pixels, the frame {width} x {height}"
            seen = hbr.segment(part)
            return replace(seen, refused=(words, *seen.refused))
        if self._background is None:
            self._background = hbr.Background(within(self._table, self.region))
        return hbr.segment(part, reference=self._background)
