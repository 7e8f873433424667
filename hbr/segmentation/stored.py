"""Segmentations as evidence that can be stored: it holds the silhouette.

A silhouette depends on the other views of an enrollment. With it, one view is cut out again without the others.
"""

import zlib
from base64 import b64decode, b64encode
from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from hbr.core.arrays import ImageArray
from hbr.segmentation.background import Background, Mask
from hbr.segmentation.cut_out import Found, Segmentation
from hbr.segmentation.evidence import Issue, IssueCode, Method
from hbr.segmentation.frame import Frame
from hbr.segmentation.segment import compared, segment

#: Keys of the evidence: the silhouette, and how many views were segmented together.
MASK: Final = "mask"
TOGETHER: Final = "together"


def evidence_together(found: Segmentation, views: int) -> dict[str, Any]:
    """Return the evidence of a view that was segmented together with others, ``views`` in all, with its silhouette."""
    evidence = {**found.evidence(), TOGETHER: views}
    if found.silhouette is not None:
        evidence[MASK] = mask_text(found.silhouette)
    return evidence


def stored_segmentation(
    image_bgr: ImageArray | Frame,
    evidence: Mapping[str, Any] | None,
    *,
    empty_table: Background | ImageArray | None = None,
) -> Segmentation:
    """Return the segmentation of a stored view: by its silhouette, or by `hbr.segment` if it was segmented alone.

    Parameters
    ----------
    image_bgr, empty_table
        As for `hbr.segment`.
    evidence
        As it is stored with the view (`evidence_together` or `Segmentation.evidence`).

    Raises
    ------
    TypeError, ValueError
        As for `hbr.segment`, or the evidence is damaged.
    """
    if evidence is None or TOGETHER not in evidence:
        return segment(image_bgr, empty_table=empty_table)
    frame = Frame.of(image_bgr)
    background, difference = compared(frame, empty_table)
    correction = None
    if background is not None and difference is not None and difference.reliable:
        correction = background.whole_correction(difference)
    found = mask_from(evidence[MASK], frame.small.shape[:2]) if MASK in evidence else None
    issues = tuple(_issue(one) for one in evidence.get("issues", ()))
    agreement = None if difference is None else difference.agreement
    return Found(frame.image, found, None, correction, agreement, Method(evidence["method"]), issues).cut_out()


def mask_text(found: Mask) -> str:
    """Return a silhouette, bool (h, w), as text of about 200 characters: its packed bits, compressed, in Base64."""
    return b64encode(zlib.compress(np.packbits(found).tobytes(), 9)).decode()


def mask_from(text: str, shape: tuple[int, int]) -> Mask:
    """Return the silhouette of this height and width from its text.

    Raises
    ------
    ValueError
        The text is damaged, or the silhouette has another size.
    """
    pixels = shape[0] * shape[1]
    try:
        packed = zlib.decompressobj().decompress(b64decode(text, validate=True), pixels)
    except (TypeError, ValueError, zlib.error) as error:
        raise ValueError("the stored silhouette of a view is damaged") from error
    if len(packed) != (pixels + 7) // 8:
        raise ValueError(f"the stored silhouette of a view does not have {shape[1]} x {shape[0]} pixels")
    found: Mask = np.unpackbits(np.frombuffer(packed, np.uint8), count=pixels).astype(np.bool_).reshape(shape)
    if not found.any():
        raise ValueError("the stored silhouette of a view is empty")
    return found


def _issue(stored: Mapping[str, Any]) -> Issue:
    return Issue(IssueCode(stored["code"]), {name: value for name, value in stored.items() if name != "code"})
