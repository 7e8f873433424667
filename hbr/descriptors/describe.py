"""Description of an image by any descriptor."""

from hbr.core.arrays import ImageArray, LevelArray
from hbr.descriptors import Descriptor
from hbr.descriptors import descriptor as descriptor_of
from hbr.descriptors.cedd import describe as describe_by_cedd
from hbr.segmentation import Background, Box, segment


def describe(
    image_bgr: ImageArray,
    *,
    size: tuple[int, int] | None = None,
    descriptor: str | Descriptor = "cedd",
    empty_table: Background | ImageArray | None = None,
    box: Box | None = None,
    grey_patch: Box | None = None,
) -> LevelArray:
    """Return the levels of an image by the paper's CEDD, or by another descriptor.

    ``describe(image)`` is the paper's descriptor of the whole image, scaled to a size that CEDD's grid covers.
    ``describe(image, descriptor="edges+colours", empty_table=empty)`` is the rig's own: the object is cut out and
    scaled, and its illumination corrected to that of the empty-table image (`hbr.segment`), if that is reliable. Enroll
    and search by the same descriptor, and compare by its ``similarity``::

        table = hbr.Background(cv2.imread("empty.png"))
        levels = hbr.describe(frame, descriptor="edges+colours", empty_table=table)
        hbr.descriptor("edges+colours").similarity(levels[None], enrolled)

    Parameters
    ----------
    image_bgr : uint8 array (H, W, 3)
        The image, in OpenCV's channel order. No side may be 0.
    size : (int, int), optional
        Width and height, multiples of 80, to which the whole image is scaled; only for CEDD. By default, an image with
        a side above 640 pixels is scaled down to that side; then each side becomes the nearest multiple of 80.
    descriptor : str or Descriptor
        One of `hbr.descriptors.names`.
    empty_table : Background, or uint8 array (H, W, 3), optional
        The empty-table image, from the same camera position: of today, or of the day of the enrollment. Pass a
        `Background` for many frames. An image that does not fit the frame is not used.
    box : (int, int, int, int), optional
        The object's x, y, width, height in pixels. By default, the object is searched for.
    grey_patch : (int, int, int, int), optional
        Box of a neutral grey in the frame, by which exposure and white balance are corrected.

    Returns
    -------
    uint8 array (length,)
        The descriptor's levels; 144 for CEDD.

    Raises
    ------
    TypeError, ValueError
        The array is no such image, the descriptor is unknown, or the options contradict each other.
    """
    if descriptor == "cedd" and empty_table is None and box is None and grey_patch is None:
        return describe_by_cedd(image_bgr, size=size)
    if size is not None:
        raise ValueError(f"size is {size}; it is possible only with plain CEDD of the whole image")
    chosen = descriptor_of(descriptor) if isinstance(descriptor, str) else descriptor
    if empty_table is None and box is None and grey_patch is None:
        return chosen.describe(image_bgr)
    return chosen.describe(segment(image_bgr, empty_table=empty_table, box=box, grey_patch=grey_patch))
