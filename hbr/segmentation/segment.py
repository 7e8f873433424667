"""The object in a frame."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from hbr.core.arrays import ImageArray
from hbr.core.validation import check_frame
from hbr.segmentation.background import Background, Light, shrunk
from hbr.segmentation.guess import guessed
from hbr.segmentation.plain import plain_difference
from hbr.segmentation.silhouette import silhouette

#: Sides of the square that an object is brought to.
CROP_PX: Final = 160
#: The square is this much larger than the box.
_MARGIN: Final = 1.1
#: Grey levels of a patch that differ by more than this are no patch.
_PATCH_SPREAD: Final = 12.0
#: What takes the background's place, as a share of the object's own brightness.
_SURROUND: Final = 0.5

Box = tuple[int, int, int, int]


@dataclass(frozen=True, eq=False)
class Segmentation:
    """An object cut out of its frame, and on what evidence.

    Attributes
    ----------
    crop : uint8 array (160, 160, 3)
        The square around the object, in BGR, in the light that it was brought to.
    cover : uint8 array (160, 160)
        How much of each pixel the object covers, 0..255; 255 everywhere where it was not found.
    box : (int, int, int, int) or None
        The object's x, y, width and height in pixels of the frame; None where it was not found.
    gains : (float, float, float) or None
        Factors of B, G, R by which the frame was brought to its light; None where nothing was changed.
    agreement : float or None
        Share of the frame's border that looks like the reference; None without one.
    refused : tuple of str
        What could not be done, each with its reason.
    """

    crop: ImageArray
    cover: NDArray[np.uint8]
    box: Box | None
    gains: tuple[float, float, float] | None
    agreement: float | None
    refused: tuple[str, ...] = ()

    def evidence(self) -> dict[str, Any]:
        """Return what was found and refused as JSON values, to be stored with the view."""
        return {
            "box_px": None if self.box is None else list(self.box),
            "gains_bgr": None if self.gains is None else [round(gain, 4) for gain in self.gains],
            "agreement": None if self.agreement is None else round(self.agreement, 3),
            "refused": list(self.refused),
        }

    @cached_property
    def alone(self) -> ImageArray:
        """The crop with an even grey behind the object, half as bright as the object itself, uint8 (160, 160, 3)."""
        if self.box is None:
            return self.crop
        share = cv2.GaussianBlur(self.cover, (0, 0), 2.5)
        level = _SURROUND * float(np.mean(cv2.mean(self.crop, mask=(self.cover > 127).astype(np.uint8))[:3]))
        ground = np.full_like(self.crop, round(level))
        weight = share.astype(np.float32) * np.float32(1 / 255)
        return cv2.blendLinear(self.crop, ground, weight, 1 - weight).astype(np.uint8, copy=False)


def segment(
    image_bgr: ImageArray,
    *,
    reference: Background | ImageArray | None = None,
    box: Box | None = None,
    grey_patch: Box | None = None,
) -> Segmentation:
    """Find the object in a frame, bring it to one scale, and its light to that of the empty table.

    With a reference the object is what differs from it, whatever pattern the table and the wall have. The frame's light
    is brought to the reference's, as far as the frame's border shows the same background; and to a plain grey backdrop,
    if the reference shows one. A border that does not look like the reference (the table was changed, the camera was
    moved) is noticed, and the reference is left alone. Without a reference, or where it is refused, the object is what
    differs from a plain background, and where there is none, what has other colours than the frame's border: a guess.
    What was refused, and what is a guess, stands in `Segmentation.refused`.

    Parameters
    ----------
    image_bgr : uint8 array (H, W, 3)
        The frame.
    reference : Background, or uint8 array (H, W, 3), optional
        The empty table. For many frames pass a `Background`, which is made ready once.
    box : (int, int, int, int), optional
        Where the object is, x, y, width, height in pixels, if that is known; it is not looked for then.
    grey_patch : (int, int, int, int), optional
        Where the frame shows a neutral grey; exposure and white balance are taken from there, not from the reference.

    Returns
    -------
    Segmentation
        Where no object was found, of the largest square in the middle of the frame.

    Raises
    ------
    TypeError, ValueError
        The frame is no such image, the reference has another size, or a box lies outside.
    """
    check_frame(image_bgr)
    background = Background(reference) if isinstance(reference, np.ndarray) else reference
    height, width = image_bgr.shape[:2]
    if background is not None and background.shape != (height, width):
        raise ValueError(
            f"the reference has {background.shape[1]} x {background.shape[0]} pixels, the frame {width} x {height}; "
            "take the reference with the camera's present settings"
        )
    for name, part in (("box", box), ("grey_patch", grey_patch)):
        if part is not None:
            _check_box(name, part, width, height)

    small = shrunk(image_bgr)
    refused: list[str] = []
    agreement: float | None = None
    light: Light | None = None
    found: NDArray[np.bool_] | None = None
    if background is not None:
        difference = background.difference(small)
        agreement = difference.agreement
        if difference.trusted:
            found = silhouette(difference.surely, difference.perhaps, framed=True)
            light = difference.light
            if background.words:
                refused.append(background.words)
            if background.light is not None:
                light = Light(light.slopes + background.light.slopes)
        else:
            refused.append(f"the reference: only {agreement:.0%} of the frame's border looks like it")
    if found is None and box is None:
        differs = plain_difference(small)
        if differs is None:
            refused.append("the silhouette: the background is not plain enough; guessed from colours")
            cut = guessed(small)
            found = None if cut is None else silhouette(cut, framed=False)
            if found is None:
                refused.append("the guess: no part of the frame stands out")
        else:
            found = silhouette(differs, framed=False)
            if found is None:
                refused.append("the silhouette: nothing differs from the background")
    if grey_patch is not None:
        light, words = _patch_light(image_bgr, grey_patch)
        refused.extend(words)
    return _cut_out(image_bgr, found, box, light, agreement, tuple(refused))


def _cut_out(
    image: ImageArray,
    found: NDArray[np.bool_] | None,
    box: Box | None,
    light: Light | None,
    agreement: float | None,
    refused: tuple[str, ...],
) -> Segmentation:
    height, width = image.shape[:2]
    if box is None and found is not None:
        box = _box_of(found, width, height)
    if box is None:
        side = float(min(height, width))
        left, top = (width - side) / 2, (height - side) / 2
    else:
        side = max(box[2], box[3]) * _MARGIN
        left, top = box[0] + (box[2] - side) / 2, box[1] + (box[3] - side) / 2
    crop = _square(image, left, top, side)
    if light is not None:
        crop = _lit(crop, light, left, top, side, width, height)
    if found is None:
        cover = np.full((CROP_PX, CROP_PX), 255, np.uint8)
        if box is not None:
            cover = _covered(box, left, top, side)
    else:
        ratio = found.shape[1] / width
        cover = _square(found.astype(np.uint8) * 255, left * ratio, top * ratio, side * ratio, cv2.BORDER_CONSTANT)
    return Segmentation(crop, cover, box, None if light is None else light.gains, agreement, refused)


def _box_of(found: NDArray[np.bool_], width: int, height: int) -> Box:
    x, y, w, h = cv2.boundingRect(found.astype(np.uint8))
    across, down = width / found.shape[1], height / found.shape[0]
    left, top = int(x * across), int(y * down)
    return left, top, min(width, round((x + w) * across)) - left, min(height, round((y + h) * down)) - top


def _covered(box: Box, left: float, top: float, side: float) -> NDArray[np.uint8]:
    scale = CROP_PX / side
    cover = np.zeros((CROP_PX, CROP_PX), np.uint8)
    x, y = round((box[0] - left) * scale), round((box[1] - top) * scale)
    cover[y : y + round(box[3] * scale), x : x + round(box[2] * scale)] = 255
    return cover


def _square(
    image: NDArray[np.uint8], left: float, top: float, side: float, border: int = cv2.BORDER_REPLICATE
) -> NDArray[np.uint8]:
    """A square of the image, brought to one size: by area where it shrinks, linearly where it grows."""
    scale = CROP_PX / side
    if scale < 1:
        # to whole pixels, so that the areas can be averaged
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


def _lit(crop: ImageArray, light: Light, left: float, top: float, side: float, width: int, height: int) -> ImageArray:
    """The crop in the light, whose planes lie over the whole frame."""
    local = light.slopes.copy()
    local[0] += local[1] * ((left + side / 2) / width - 0.5) + local[2] * ((top + side / 2) / height - 0.5)
    local[1] *= side / width
    local[2] *= side / height
    coarse = cv2.exp(Light(local).over(8, 8))
    factors = cv2.resize(coarse, (CROP_PX, CROP_PX), interpolation=cv2.INTER_LINEAR)
    return cv2.multiply(crop, factors, dtype=cv2.CV_8U).astype(np.uint8, copy=False)


def _patch_light(image: ImageArray, patch: Box) -> tuple[Light | None, list[str]]:
    x, y, w, h = patch
    pixels = image[y : y + h, x : x + w].reshape(-1, 3).astype(np.float64)
    level = np.median(pixels, axis=0)
    spread = np.quantile(np.abs(pixels - level), 0.9)
    if spread > _PATCH_SPREAD:
        return None, ["the grey patch: it is not even"]
    if level.max() >= 250 or level.min() < 16:
        return None, ["the grey patch: it is overexposed or too dark"]
    slopes = np.zeros((3, 3))
    slopes[0] = np.log(128.0 / level)
    return Light(slopes), []


def _check_box(name: str, box: Box, width: int, height: int) -> None:
    x, y, w, h = box
    if w < 2 or h < 2 or x < 0 or y < 0 or x + w > width or y + h > height:
        raise ValueError(f"{name} {box} is not within the frame of {width} x {height} pixels; x, y, width, height")
