"""A frame, with the data that several segmentations of it share."""

from functools import cached_property

from hbr.core.arrays import ImageArray
from hbr.core.validation import check_frame
from hbr.segmentation.background import Background, Difference, Mask, shrunk
from hbr.segmentation.plain import plain_difference


class Frame:
    """A frame, uint8 (H, W, 3), and its small image.

    Raises
    ------
    TypeError, ValueError
        The array is no such image.
    """

    def __init__(self, image_bgr: ImageArray) -> None:
        check_frame(image_bgr)
        self.image = image_bgr
        self.small = shrunk(image_bgr)
        self._compared: tuple[Background, Difference] | None = None

    @classmethod
    def of(cls, image_bgr: "ImageArray | Frame") -> "Frame":
        """Return the frame of an image, or the frame itself."""
        return image_bgr if isinstance(image_bgr, Frame) else cls(image_bgr)

    def difference(self, background: Background) -> Difference:
        """Return the difference from a background. The last one is cached for further segmentations of the frame."""
        if self._compared is None or self._compared[0] is not background:
            self._compared = background, background.difference(self.small)
        return self._compared[1]

    @cached_property
    def differs(self) -> Mask | None:
        """Return where the small image differs from a plain background, bool (h, w); None if it is not plain."""
        return plain_difference(self.small)
