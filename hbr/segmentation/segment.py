"""Segmentation of a frame: the object's box, mask and illumination, and a crop of fixed size.

A silhouette depends on the other views of an enrollment. It is stored with the evidence of a view
(`evidence_together`), so that one view is cut out again without the others (`stored_segmentation`).
"""

import zlib
from base64 import b64decode, b64encode
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np

from hbr.core.arrays import ImageArray
from hbr.segmentation.background import (
    Background,
    BoxMethod,
    Difference,
    Floats,
    Issue,
    IssueCode,
    Mask,
    SegmentedFrame,
)
from hbr.segmentation.cut_out import Box, Found, Segmentation
from hbr.segmentation.silhouette import guess_object, shares, silhouette

#: A pixel belongs to the object if it is more probable than this,
_LEVEL: Final = 0.35
#: and with a learned background in the first segmentation and in further ones: where an object looks the same from all
#: sides, it is part of that background, and less probable.
_LEVELS: Final = (0.25, 0.5, 0.8)
#: Of a silhouette that the network finds, at least this share differs from the background,
# 8 % or more of drawn objects whose sides look alike; 1 % or less where the drawn plain table is empty
_SUPPORT: Final = 0.05
#: or the network is so sure of so much of the frame: a ball does not change while it rotates.
# 4 % or more of frames with drawn objects, 1.2 % or less of those of the empty plain table
_SURE: Final = 0.85
_SURE_OF: Final = 0.02
#: A pixel that is brighter than the empty table by more than this, in logarithms, belongs to the object,
_BRIGHTER: Final = 0.3
#: if it is more probable than this: a bright bar in front of the object is not part of it.
# 1 of 150 drawn silhouettes after hard changes becomes worse; without this limit 23 do
_TRACE: Final = 0.03
#: A part is the platter, or the object of other views, if the mean of its pixels is more than this.
_MOST: Final = 0.5
#: A smaller expected overlap is reported.
_DOUBTFUL: Final = 0.7
#: With a larger one and a learned background, the network does not look at the frame a second time without it.
# that saves a third of a view's time; after hard changes, 98.0 % were decided right instead of 98.3 %
_CERTAIN: Final = 0.85
#: Smallest overlap of two boxes that count as one.
_SAME_BOX: Final = 0.85
# more: the right box is missed less often; each is described and compared with all enrolled views
MOST_HYPOTHESES: Final = 5


def segment(
    image_bgr: ImageArray | SegmentedFrame,
    *,
    empty_table: Background | ImageArray | None = None,
) -> Segmentation:
    """Find the object in a frame, crop it to a fixed size, and correct its illumination.

    1. With an empty-table image, the object is what differs from it. The frame's illumination is corrected to that of
       the image, and further to a plain grey backdrop if the image shows one. If the frame's border does not look like
       the image (the table has changed, the camera has moved), the image is not used.
    2. Otherwise the object is what differs from a plain background.
    3. If the background is not plain, the object is guessed: what has other colours than the frame's border.

    `Segmentation.method` says which of these found the object, `Segmentation.issues` why the others did not.

    Parameters
    ----------
    image_bgr : uint8 array (H, W, 3)
        The frame; or a `hbr.segmentation.background.SegmentedFrame`, if the frame is segmented more than once.
    empty_table : Background, or uint8 array (H, W, 3), optional
        The empty-table image. For many frames, pass a `Background`: it is prepared only once.

    Returns
    -------
    Segmentation
        Of the largest square in the middle of the frame if no object was found.

    Raises
    ------
    TypeError, ValueError
        The frame is no such image, or the empty-table image has another size.
    """
    frame = SegmentedFrame.of(image_bgr)
    background, difference = compared(frame, empty_table)
    return _found(_lit(frame, background, difference), difference).cut_out()


def compared(
    frame: SegmentedFrame, empty_table: Background | ImageArray | None
) -> tuple[Background | None, Difference | None]:
    """Return the prepared empty-table image, and the frame's difference from it."""
    if empty_table is None:
        return None, None
    background = Background(empty_table) if isinstance(empty_table, np.ndarray) else empty_table
    height, width = frame.image.shape[:2]
    if background.shape != (height, width):
        raise ValueError(
            f"the empty-table image has {background.shape[1]} x {background.shape[0]} pixels, the frame "
            f"{width} x {height}; take the image with the present camera settings"
        )
    return background, frame.difference(background)


def _lit(frame: SegmentedFrame, background: Background | None, difference: Difference | None) -> Found:
    """Return the illumination correction by the empty-table image, and its issues; the object is not found yet."""
    agreement = None if difference is None else difference.agreement
    nothing = Found(frame, None, None, agreement, BoxMethod.NONE, ())
    if background is None or difference is None:
        return nothing
    if not difference.reliable:
        return replace(nothing, issues=(Issue(IssueCode.TABLE_DIFFERS, {"agreement": round(difference.agreement, 3)}),))
    issues = () if background.issue is None else (Issue(background.issue),)
    return replace(nothing, correction=background.whole_correction(difference), issues=issues)


def _found(lit: Found, difference: Difference | None, *, guess: bool = True) -> Found:
    """Return the object by the empty-table image, before a plain background, or guessed if that is asked for."""
    frame, found, method = lit.frame, None, BoxMethod.EMPTY_TABLE
    issues: list[Issue] = []
    if difference is not None and difference.reliable:
        found = silhouette(difference.certain, difference.possible, framed=True)
        if found is None and not difference.is_enough:
            return replace(lit, issues=(*lit.issues, Issue(IssueCode.NO_DIFFERENCE)))
    if found is None:
        if frame.differs is not None:
            method = BoxMethod.PLAIN_BACKGROUND
            found = silhouette(frame.differs, framed=False)
            if found is None:
                issues.append(Issue(IssueCode.NO_DIFFERENCE))
        else:
            method = BoxMethod.GUESS
            issues.append(Issue(IssueCode.BACKGROUND_NOT_PLAIN))
            cut = guess_object(frame.small) if guess else None
            found = None if cut is None else silhouette(cut, framed=False)
            if found is None and guess:
                issues.append(Issue(IssueCode.NO_GUESS))
    if found is None:
        method = BoxMethod.NONE
    return replace(lit, silhouette=found, method=method, issues=(*lit.issues, *issues))


def hypotheses(
    image_bgr: ImageArray | SegmentedFrame,
    *,
    empty_table: Background | ImageArray | None = None,
    learned: Background | None = None,
    alone: Sequence[Segmentation] = (),
    most: int = MOST_HYPOTHESES,
) -> tuple[Segmentation, ...]:
    """Return several segmentations of a frame, the likeliest first, whose boxes differ.

    A search compares the enrolled views with all of them, and the most similar one counts
    (`hbr.DenseSession.add` takes the levels of several segmentations as rows). The network sees the frame with all that
    is known about its background. What does not rotate is not the object, also before a plain background: there the
    difference from the border contains a visible platter. It counts first only if the network confirms it.

    Parameters
    ----------
    image_bgr, empty_table
        As for `segment`; or a `hbr.segmentation.background.SegmentedFrame`, if the frame is segmented more than once.
    learned : Background, optional
        The background that the other views of the search show (`hbr.descriptors.together.LearnedBackground.of`). The
        object is not guessed then. It is not used if the frame's edge differs from it.
    alone : sequence of Segmentation
        What was returned for this frame while its background was not known. They count besides those with the learned
        background. By default the network's counts, if that with the learned background is not certain.
    most : int
        Largest number of segmentations.

    Raises
    ------
    TypeError, ValueError
        As for `segment`.
    """
    frame = SegmentedFrame.of(image_bgr)
    background, difference = compared(frame, empty_table)
    method, seen = BoxMethod.EMPTY_TABLE, difference
    if seen is None or not seen.reliable:
        method, seen = BoxMethod.ROTATION, None if learned is None else learned.difference(frame.small)
        # a camera that moves around the object shows other surroundings in each view: nothing is learned from them
        if seen is None or not seen.still:
            method, seen = BoxMethod.NETWORK, None
    rotated = method is BoxMethod.ROTATION
    share, platter = shares(frame, seen)
    if seen is not None and method is BoxMethod.EMPTY_TABLE:
        # a shadow never makes the table brighter: a thin handle of which the network sees a trace is part of the object
        share = np.where(seen.certain & (seen.evenly > _BRIGHTER) & (share > _TRACE), np.float32(1), share)
    levels = (_LEVELS if most > 1 else _LEVELS[:1]) if rotated else (_LEVEL,)
    masks = _masks(share, levels)
    if masks and not _is_there(frame, share > min(levels), share, seen):
        masks = []
    like = _found(_lit(frame, background, difference), difference, guess=not rotated)
    found: list[Segmentation | Found] = [replace(like, silhouette=mask, method=method) for mask in masks]
    only_platter = rotated and not found and like.silhouette is not None and _mean(platter, like.silhouette) > _MOST
    if like.box is not None and not only_platter:
        # the network may cut off a thin handle, which the difference from the empty-table image shows
        sure = like.method is BoxMethod.GUESS or (like.method is BoxMethod.EMPTY_TABLE and most > 1)
        first = not found or (not rotated and sure) or _same(like, found[0])
        found.insert(0 if first else len(found), like)
    # before a plain background, what the rotation does not show is not there
    if rotated and most > 1 and (found or frame.differs is None):
        certain = bool(masks) and _expected(masks[0], share) >= _CERTAIN
        found += alone or ([] if certain else _alone(frame, like))
    if not found:
        nothing = (Issue(IssueCode.NO_OBJECT),) if rotated else ()
        found = [replace(like, method=BoxMethod.NONE, issues=(*like.issues, *nothing))]
    overlap = _expected(found[0].silhouette, share)
    if found[0].method not in (BoxMethod.EMPTY_TABLE, BoxMethod.GUESS) and 0 < overlap < _DOUBTFUL:
        issue = Issue(IssueCode.DOUBTFUL_OUTLINE, {"overlap": round(overlap, 2)})
        found[0] = replace(found[0], issues=(*found[0].issues, issue))
    several: list[Segmentation | Found] = []
    for one in found:
        if not any(_same(other, one) for other in several):
            several.append(one)
    return tuple(map(_cut_out, several[:most]))


def _is_there(frame: SegmentedFrame, mask: Mask, share: Floats, seen: Difference | None) -> bool:
    """Return whether more than the network shows that there is something where it finds an object."""
    if seen is None:
        return frame.differs is None or _mean(frame.differs, mask) >= _SUPPORT
    rotated = seen.background.views > 0
    if _mean(seen.certain | seen.possible, mask) < _SUPPORT:
        return rotated and int(np.count_nonzero(share > _SURE)) >= _SURE_OF * share.size
    if not rotated or frame.differs is None or _mean(frame.differs, mask) > _MOST:
        return True
    # the other views show an object there, this one its background
    others = seen.background.differs
    return others is None or _mean(others & ~frame.differs, mask) <= _MOST


def _mean(values: Floats | Mask, mask: Mask) -> float:
    return float(values[mask].mean())


def _expected(found: Mask | None, share: Floats) -> float:
    """Return the expected overlap of a silhouette with the object, by the probability of each pixel; 0 without one."""
    if found is None:
        return 0.0
    both = float(share[found].sum())
    return both / (int(np.count_nonzero(found)) + float(share.sum()) - both)


def _cut_out(found: Segmentation | Found) -> Segmentation:
    return found.cut_out() if isinstance(found, Found) else found


def _alone(frame: SegmentedFrame, like: Found) -> list[Found]:
    """Return the network's silhouette of a frame whose background is not known, with the evidence of another one."""
    masks = _masks(shares(frame).object, (_LEVEL,))
    return [replace(like, silhouette=mask, method=BoxMethod.NETWORK) for mask in masks]


def _masks(share: Floats, levels: tuple[float, ...]) -> list[Mask]:
    """Return the silhouettes at these probabilities."""
    return [mask for level in levels if (mask := silhouette(share > level, framed=False)) is not None]


def _same(a: Segmentation | Found, b: Segmentation | Found) -> bool:
    """Return whether two segmentations have nearly the same box."""
    return a.box is not None and b.box is not None and _overlap(a.box, b.box) >= _SAME_BOX


def _overlap(a: Box, b: Box) -> float:
    """Return the intersection of two boxes over their union."""
    across = min(a[0] + a[2], b[0] + b[2]) - max(a[0], b[0])
    down = min(a[1] + a[3], b[1] + b[3]) - max(a[1], b[1])
    both = max(0, across) * max(0, down)
    return both / (a[2] * a[3] + b[2] * b[3] - both)


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
    image_bgr: ImageArray | SegmentedFrame,
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

    Raises `TypeError`, `ValueError`: as for `hbr.segment`, or the evidence is damaged.
    """
    if evidence is None or TOGETHER not in evidence:
        return segment(image_bgr, empty_table=empty_table)
    frame = SegmentedFrame.of(image_bgr)
    lit = _lit(frame, *compared(frame, empty_table))
    found = mask_from(evidence[MASK], frame.small.shape[:2]) if MASK in evidence else None
    issues = tuple(_issue(one) for one in evidence.get("issues", ()))
    return replace(lit, silhouette=found, method=BoxMethod(evidence["method"]), issues=issues).cut_out()


def mask_text(found: Mask) -> str:
    """Return a silhouette, bool (h, w), as text of about 200 characters: its packed bits, compressed, in Base64."""
    return b64encode(zlib.compress(np.packbits(found).tobytes(), 9)).decode()


def mask_from(text: str, shape: tuple[int, int]) -> Mask:
    """Return the silhouette of this height and width from its text."""
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
