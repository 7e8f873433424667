"""The door to all descriptors: one image in, its levels out."""

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
    reference: Background | ImageArray | None = None,
    box: Box | None = None,
    grey_patch: Box | None = None,
) -> LevelArray:
    """Describe an image: by the paper's CEDD as it is, or by another descriptor of the object that the image shows.

    ``describe(image)`` is the paper's descriptor of the whole image, brought to a size that CEDD's grid covers.
    ``describe(image, descriptor="edges+colours", reference=empty_table)`` is the bench's own: the object is cut out
    and scaled, and its light corrected to that of the empty table (`hbr.segment`), if that is reliable. Enroll and
    search by the same descriptor, and compare by its ``similarity``::

        table = hbr.Background(cv2.imread("empty.png"))
        levels = hbr.describe(frame, descriptor="edges+colours", reference=table)
        hbr.descriptor("edges+colours").similarity(levels[None], enrolled)

    Parameters
    ----------
    image_bgr : uint8 array (H, W, 3)
        In OpenCV's channel order; no side may be 0.
    size : (int, int), optional
        Width and height, multiples of 80, that the whole image is brought to before plain CEDD. Otherwise an image with
        a side above 640 pixels is scaled down to that side; then each side becomes the nearest multiple of 80.
    descriptor : str or Descriptor
        One of `hbr.descriptors.names`.
    reference : Background, or uint8 array (H, W, 3), optional
        The empty table, from the same place: of this day, or of the day of the enrollment. Pass a `Background` for many
        frames. One that does not belong to the frame is noticed and left alone.
    box : (int, int, int, int), optional
        Where the object is: x, y, width, height in pixels; looked for otherwise.
    grey_patch : (int, int, int, int), optional
        Where the frame shows a neutral grey, to take exposure and white balance from.

    Returns
    -------
    uint8 array (length,)
        The descriptor's levels; 144 for CEDD.

    Raises
    ------
    TypeError, ValueError
        The image is no such image, the descriptor is unknown, or an option does not go with the others.
    """
    if descriptor == "cedd" and reference is None and box is None and grey_patch is None:
        return describe_by_cedd(image_bgr, size=size)
    if size is not None:
        raise ValueError(f"size is {size}; it goes with plain CEDD of the whole image alone")
    chosen = descriptor_of(descriptor) if isinstance(descriptor, str) else descriptor
    if reference is None and box is None and grey_patch is None:
        return chosen.describe(image_bgr)
    return chosen.describe(segment(image_bgr, reference=reference, box=box, grey_patch=grey_patch))
