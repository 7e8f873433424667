"""Segmentation of a frame: the object's box, mask and illumination, and a crop of fixed size."""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from hbr.core.arrays import ImageArray
from hbr.core.deprecation import renamed_keyword
from hbr.core.validation import check_frame
from hbr.segmentation.background import Background, Illumination, Mask, shrunk
from hbr.segmentation.evidence import Issue, IssueCode, Method
from hbr.segmentation.guess import guess_object
from hbr.segmentation.network import shares
from hbr.segmentation.plain import plain_difference
from hbr.segmentation.silhouette import silhouette

#: Side of the square crop around an object.
CROP_PX: Final = 160
#: Side of the crop, as a multiple of the longer side of the box.
_MARGIN: Final = 1.1
#: A patch whose grey levels differ by more than this is uneven.
_PATCH_SPREAD: Final = 12.0
#: Brightness of the grey that replaces the background, as a share of the object's brightness.
_SURROUND: Final = 0.5

#: Probabilities above which a pixel belongs to the object: of the first segmentation, and of further ones.
_LEVELS: Final = (0.5, 0.2, 0.8)
#: Boxes that overlap by more are one.
_SAME_BOX: Final = 0.85
MOST_HYPOTHESES: Final = 4

Box = tuple[int, int, int, int]


@dataclass(frozen=True, eq=False)
class Segmentation:
    """An object cut out of its frame, with the evidence.

    Attributes
    ----------
    crop : uint8 array (160, 160, 3)
        Square around the object, in BGR, after illumination correction.
    mask : uint8 array (160, 160)
        Share of each pixel that belongs to the object, 0..255; 255 everywhere if no object was found.
    box : (int, int, int, int) or None
        The object's x, y, width and height in pixels of the frame; None if no object was found.
    gains : (float, float, float) or None
        Factors of the illumination correction for B, G, R; None without correction.
    agreement : float or None
        Share of the frame's border that looks like the empty-table image; None without such an image.
    method : Method
        How the box was found.
    issues : tuple of Issue
        What could not be done, and why.
    correction : Illumination or None
        The illumination correction.
    """

    crop: ImageArray
    mask: NDArray[np.uint8]
    box: Box | None
    gains: tuple[float, float, float] | None
    agreement: float | None
    method: Method
    issues: tuple[Issue, ...] = ()
    correction: Illumination | None = field(default=None, repr=False)

    def evidence(self) -> dict[str, Any]:
        """Return method, box, gains, agreement and issues as JSON values, to be stored with the view."""
        return {
            "method": self.method.value,
            "box_px": None if self.box is None else list(self.box),
            "gains_bgr": None if self.gains is None else [round(gain, 4) for gain in self.gains],
            "agreement": None if self.agreement is None else round(self.agreement, 3),
            "issues": [issue.as_json() for issue in self.issues],
        }

    def frame_mask(self, width: int, height: int) -> NDArray[np.bool_]:
        """Return the object's pixels in its frame of this size, bool (height, width); none if no object was found."""
        whole = np.zeros((height, width), np.bool_)
        if self.box is None:
            return whole
        left, top, side = _square_around(self.box)
        scale = CROP_PX / side
        move = np.array([[scale, 0, scale * (0.5 - left) - 0.5], [0, scale, scale * (0.5 - top) - 0.5]])
        share = cv2.warpAffine(self.mask, move, (width, height), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
        x, y, w, h = self.box
        whole[y : y + h, x : x + w] = share[y : y + h, x : x + w] > 127
        return whole

    @cached_property
    def alone(self) -> ImageArray:
        """The crop with an even grey instead of the background, half as bright as the object, uint8 (160, 160, 3)."""
        if self.box is None:
            return self.crop
        share = cv2.GaussianBlur(self.mask, (0, 0), 2.5)
        level = _SURROUND * float(np.mean(cv2.mean(self.crop, mask=(self.mask > 127).astype(np.uint8))[:3]))
        ground = np.full_like(self.crop, round(level))
        weight = share.astype(np.float32) * np.float32(1 / 255)
        return cv2.blendLinear(self.crop, ground, weight, 1 - weight).astype(np.uint8, copy=False)


@renamed_keyword("reference", "empty_table")
def segment(
    image_bgr: ImageArray,
    *,
    empty_table: Background | ImageArray | None = None,
    box: Box | None = None,
    grey_patch: Box | None = None,
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
        The frame.
    empty_table : Background, or uint8 array (H, W, 3), optional
        The empty-table image. For many frames, pass a `Background`: it is prepared only once.
    box : (int, int, int, int), optional
        The object's x, y, width, height in pixels, if they are known. The object is not searched for then.
    grey_patch : (int, int, int, int), optional
        Box of a neutral grey in the frame. Exposure and white balance are corrected by it, not by the empty-table
        image.

    Returns
    -------
    Segmentation
        Of the largest square in the middle of the frame if no object was found.

    Raises
    ------
    TypeError, ValueError
        The frame is no such image, the empty-table image has another size, or a box is outside the frame.
    """
    check_frame(image_bgr)
    background = Background(empty_table) if isinstance(empty_table, np.ndarray) else empty_table
    height, width = image_bgr.shape[:2]
    if background is not None and background.shape != (height, width):
        raise ValueError(
            f"the empty-table image has {background.shape[1]} x {background.shape[0]} pixels, the frame "
            f"{width} x {height}; take the image with the present camera settings"
        )
    for name, part in (("box", box), ("grey_patch", grey_patch)):
        if part is not None:
            _check_box(name, part, width, height)

    small = shrunk(image_bgr)
    issues: list[Issue] = []
    agreement: float | None = None
    correction: Illumination | None = None
    found: NDArray[np.bool_] | None = None
    method = Method.EMPTY_TABLE
    if background is not None:
        difference = background.difference(small)
        agreement = difference.agreement
        if difference.reliable:
            found = silhouette(difference.certain, difference.possible, framed=True)
            correction = difference.correction
            if background.issue is not None:
                issues.append(Issue(background.issue))
            if background.correction is not None:
                correction = Illumination(correction.slopes + background.correction.slopes)
        else:
            issues.append(Issue(IssueCode.TABLE_DIFFERS, {"agreement": round(agreement, 3)}))
    if found is None and box is None:
        differs = plain_difference(small)
        if differs is not None:
            method = Method.PLAIN_BACKGROUND
            found = silhouette(differs, framed=False)
            if found is None:
                issues.append(Issue(IssueCode.NO_DIFFERENCE))
        else:
            method = Method.GUESS
            issues.append(Issue(IssueCode.BACKGROUND_NOT_PLAIN))
            cut = guess_object(small)
            found = None if cut is None else silhouette(cut, framed=False)
            if found is None:
                issues.append(Issue(IssueCode.NO_GUESS))
    if box is not None:
        method = Method.GIVEN_BOX
    elif found is None:
        method = Method.NONE
    if grey_patch is not None:
        correction, problem = _patch_correction(image_bgr, grey_patch)
        if problem is not None:
            issues.append(Issue(problem))
    return _cut_out(image_bgr, found, box, correction, agreement, method, tuple(issues))


def hypotheses(
    image_bgr: ImageArray,
    *,
    empty_table: Background | ImageArray | None = None,
    learned: Background | None = None,
    most: int = MOST_HYPOTHESES,
) -> tuple[Segmentation, ...]:
    """Return several segmentations of a frame, the likeliest first, whose boxes differ.

    A search compares the enrolled views with all of them, and the most similar one counts
    (`hbr.DenseSession.add` takes the levels of several segmentations as rows). Before a plain background there is one.

    Parameters
    ----------
    image_bgr, empty_table
        As for `segment`.
    learned : Background, optional
        The background that the other views of the search show (`hbr.segmentation.learned.LearnedBackground.of`). The
        object is not guessed then.
    most : int
        Largest number of segmentations.

    Raises
    ------
    TypeError, ValueError
        As for `segment`.
    """
    check_frame(image_bgr)
    small = shrunk(image_bgr)
    background = Background(empty_table) if isinstance(empty_table, np.ndarray) else empty_table
    difference = None
    if background is not None and background.shape == image_bgr.shape[:2]:
        difference = background.difference(small)
    by_picture = difference is not None and difference.reliable
    if learned is None or by_picture or plain_difference(small) is not None:
        first = segment(image_bgr, empty_table=background)
        if first.method is Method.PLAIN_BACKGROUND or (most == 1 and not by_picture):
            return (first,)
        share = shares(small, difference if by_picture else None).object
        if by_picture:
            found = [first, *_by_network(image_bgr, share, Method.EMPTY_TABLE, first)]
            if most == 1:  # an enrollment: the network's box is right more often
                found.reverse()
        else:
            found = [first, *_by_network(image_bgr, share, Method.NETWORK, first)]
    else:
        issues = [Issue(IssueCode.BACKGROUND_NOT_PLAIN)]
        if difference is not None:
            issues.insert(0, Issue(IssueCode.TABLE_DIFFERS, {"agreement": round(difference.agreement, 3)}))
        agreement = None if difference is None else difference.agreement
        nothing = _cut_out(image_bgr, None, None, None, agreement, Method.NONE, (*issues, Issue(IssueCode.NO_OBJECT)))
        like = replace(nothing, issues=tuple(issues))
        share = shares(small, learned.difference(small), learned=True).object
        found = _by_network(image_bgr, share, Method.ROTATION, like, levels=_LEVELS[: max(1, most - 1)])
        if most > 1:
            found += _by_network(image_bgr, shares(small).object, Method.NETWORK, like)
        found = found or [nothing]
    several: list[Segmentation] = []
    for one in found:
        if all(one.box is None or known.box is None or _overlap(known.box, one.box) < _SAME_BOX for known in several):
            several.append(one)
    return tuple(several[:most])


def _by_network(
    image: ImageArray,
    share: NDArray[np.float32],
    method: Method,
    like: Segmentation,
    levels: tuple[float, ...] = _LEVELS[:1],
) -> list[Segmentation]:
    """Return the segmentations at these probabilities, with the illumination and the evidence of another one."""
    masks = [mask for level in levels if (mask := _object_in(share, level)) is not None]
    return [_cut_out(image, mask, None, like.correction, like.agreement, method, like.issues) for mask in masks]


def _object_in(share: NDArray[np.float32], level: float) -> Mask | None:
    """Return the object's silhouette where its probability is above a level."""
    return silhouette(share > level, framed=False)


def _overlap(a: Box, b: Box) -> float:
    """Return the intersection of two boxes over their union."""
    across = min(a[0] + a[2], b[0] + b[2]) - max(a[0], b[0])
    down = min(a[1] + a[3], b[1] + b[3]) - max(a[1], b[1])
    both = max(0, across) * max(0, down)
    return both / (a[2] * a[3] + b[2] * b[3] - both)


def _cut_out(
    image: ImageArray,
    found: NDArray[np.bool_] | None,
    box: Box | None,
    correction: Illumination | None,
    agreement: float | None,
    method: Method,
    issues: tuple[Issue, ...],
) -> Segmentation:
    height, width = image.shape[:2]
    if box is None and found is not None:
        box = _box_of(found, width, height)
    if box is None:
        side = float(min(height, width))
        left, top = (width - side) / 2, (height - side) / 2
    else:
        left, top, side = _square_around(box)
    crop = _square(image, left, top, side)
    if correction is not None:
        crop = _corrected(crop, correction, left, top, side, width, height)
    if found is not None:
        ratio = found.shape[1] / width
        mask = _square(found.astype(np.uint8) * 255, left * ratio, top * ratio, side * ratio, cv2.BORDER_CONSTANT)
    elif box is not None:
        mask = _box_mask(box, left, top, side)
    else:
        mask = np.full((CROP_PX, CROP_PX), 255, np.uint8)
    gains = None if correction is None else correction.gains
    return Segmentation(crop, mask, box, gains, agreement, method, issues, correction)


def _square_around(box: Box) -> tuple[float, float, float]:
    """Return left, top and side of the square that is cropped."""
    side = max(box[2], box[3]) * _MARGIN
    return box[0] + (box[2] - side) / 2, box[1] + (box[3] - side) / 2, side


def _box_of(found: NDArray[np.bool_], width: int, height: int) -> Box:
    x, y, w, h = cv2.boundingRect(found.astype(np.uint8))
    across, down = width / found.shape[1], height / found.shape[0]
    left, top = int(x * across), int(y * down)
    return left, top, min(width, round((x + w) * across)) - left, min(height, round((y + h) * down)) - top


def _box_mask(box: Box, left: float, top: float, side: float) -> NDArray[np.uint8]:
    scale = CROP_PX / side
    mask = np.zeros((CROP_PX, CROP_PX), np.uint8)
    x, y = round((box[0] - left) * scale), round((box[1] - top) * scale)
    mask[y : y + round(box[3] * scale), x : x + round(box[2] * scale)] = 255
    return mask


def _square(
    image: NDArray[np.uint8], left: float, top: float, side: float, border: int = cv2.BORDER_REPLICATE
) -> NDArray[np.uint8]:
    """Return a square of the image, scaled to `CROP_PX`: averaged by area if it shrinks, linearly if it grows."""
    scale = CROP_PX / side
    if scale < 1:
        # whole pixels, because INTER_AREA needs an integer region
        x, y, size = round(left), round(top), max(1, round(side))
        height, width = image.shape[:2]
        out = max(0, -x), max(0, -y), max(0, x + size - width), max(0, y + size - height)
        part = image[max(0, y) : y + size, max(0, x) : x + size]
        if any(out):
            part = cv2.copyMakeBorder(part, out[1], out[3], out[0], out[2], border).astype(np.uint8, copy=False)
        return cv2.resize(part, (CROP_PX, CROP_PX), interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False)
    shift = (scale - 1) / 2
    move = np.array([[scale, 0, shift - scale * left], [0, scale, shift - scale * top]])
    return cv2.warpAffine(image, move, (CROP_PX, CROP_PX), flags=cv2.INTER_LINEAR, borderMode=border).astype(
        np.uint8, copy=False
    )


def _corrected(
    crop: ImageArray, correction: Illumination, left: float, top: float, side: float, width: int, height: int
) -> ImageArray:
    """Apply to the crop the correction, whose planes extend over the whole frame."""
    local = correction.slopes.copy()
    local[0] += local[1] * ((left + side / 2) / width - 0.5) + local[2] * ((top + side / 2) / height - 0.5)
    local[1] *= side / width
    local[2] *= side / height
    coarse = cv2.exp(Illumination(local).over(8, 8))
    factors = cv2.resize(coarse, (CROP_PX, CROP_PX), interpolation=cv2.INTER_LINEAR)
    return cv2.multiply(crop, factors, dtype=cv2.CV_8U).astype(np.uint8, copy=False)


def _patch_correction(image: ImageArray, patch: Box) -> tuple[Illumination | None, IssueCode | None]:
    x, y, w, h = patch
    pixels = image[y : y + h, x : x + w].reshape(-1, 3).astype(np.float64)
    level = np.median(pixels, axis=0)
    spread = np.quantile(np.abs(pixels - level), 0.9)
    if spread > _PATCH_SPREAD:
        return None, IssueCode.PATCH_UNEVEN
    if level.max() >= 250 or level.min() < 16:
        return None, IssueCode.PATCH_EXPOSURE
    slopes = np.zeros((3, 3))
    slopes[0] = np.log(128.0 / level)
    return Illumination(slopes), None


def _check_box(name: str, box: Box, width: int, height: int) -> None:
    x, y, w, h = box
    if w < 2 or h < 2 or x < 0 or y < 0 or x + w > width or y + h > height:
        raise ValueError(f"{name} {box} is not within the frame of {width} x {height} pixels; give x, y, width, height")
