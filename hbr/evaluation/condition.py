"""The condition of an experiment: how the images of queries differ from those of enrolled views."""

from dataclasses import dataclass, field
from typing import Any, Final, Literal, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from hbr.core.arrays import ImageArray, LevelArray
from hbr.descriptors import descriptor
from hbr.descriptors.registry import describe
from hbr.drawing.noise import Noise
from hbr.evaluation.perturb import Perturbations
from hbr.evaluation.photographs import Dataset, object_mask
from hbr.evaluation.protocol import generator
from hbr.segmentation import segment

Background = Literal["same", "uniform", "textured"]
_T = TypeVar("_T", np.uint8, np.float32)

_TEXTURE_OCTAVES: Final = (4, 8, 16, 32)  # coarse to fine; each octave is weaker, as in photographs of surfaces


@dataclass(frozen=True)
class Condition:
    """The differences between an enrolled view and a query."""

    size_px: int | None = None
    """Longer side of all images, also of enrolled views; None: the size of the file."""
    noise: Noise = field(default_factory=Noise)
    """Noise of the queries, applied at that size."""
    rotation_deg: float = 0.0
    """Largest rotation of a query in the image plane, to either side; the angle is random."""
    background: Background = "same"
    """Background of a query instead of the dark surroundings."""
    prefilter_px: float = 0.0
    """Standard deviation of a Gaussian blur of all images, also of enrolled views; 0: no blur."""
    perturbations: Perturbations = field(default_factory=Perturbations)
    """Perturbations of the queries."""
    descriptor: str = "cedd"
    """Descriptor of enrolled views and queries."""
    enrolled_noise: Noise = field(default_factory=Noise)
    """Noise of the enrolled views."""
    enrolled_background: Background = "same"
    """Background of the enrolled views instead of the dark surroundings; each view has its own."""
    cut_out: bool = False
    """Whether the object is cut out of every image as on the rig, and described before an even grey."""

    def __post_init__(self) -> None:
        if self.size_px is not None and self.size_px < 2:
            raise ValueError(f"an image size of {self.size_px} pixels; at least 2 are needed, 480 is the paper's")
        if not 0 <= self.rotation_deg <= 180:
            raise ValueError(f"a rotation of {self.rotation_deg} degrees; 0 to 180 are possible")
        if not (np.isfinite(self.prefilter_px) and self.prefilter_px >= 0):
            raise ValueError(f"a prefilter of {self.prefilter_px} pixels; at least 0 is needed")
        if self.cut_out and not descriptor(self.descriptor).whole_image:
            raise ValueError(f"{self.descriptor} cuts the object out itself; leave cut_out out")
        if self.perturbations and (self.rotation_deg or self.background != "same"):
            raise ValueError(
                "a rotation in the plane, and a uniform or textured background, cannot be combined with perturbations; "
                "leave out one of them"
            )
        descriptor(self.descriptor)

    def enrolled(self, image_bgr: ImageArray, rng: np.random.Generator | None = None) -> ImageArray:
        """Return the image of an enrolled view; `rng` draws its noise."""
        image = self._sized(image_bgr)
        if self.enrolled_background != "same":
            image = _before(image, object_mask(image), self.enrolled_background, rng or np.random.default_rng(0))
        return self._prefiltered(self.enrolled_noise.apply(image, rng or np.random.default_rng(0)))

    def query(self, image_bgr: ImageArray, rng: np.random.Generator) -> ImageArray:
        """Return the image of a query; equal states of `rng` give equal images."""
        image = self._sized(image_bgr)
        if self.perturbations:
            rng.integers(8)  # has no use any more, but without it the figures in docs/results.md would change
            image = self.perturbations.photograph(image, object_mask(image), rng)
        elif self.rotation_deg or self.background != "same":
            mask = object_mask(image).astype(np.float32)
            if self.rotation_deg:
                angle_deg = rng.uniform(-self.rotation_deg, self.rotation_deg)
                image, mask = _rotated(image, angle_deg), _rotated(mask, angle_deg)
            if self.background != "same":
                image = _before(image, mask, self.background, rng)
        return self._prefiltered(self.noise.apply(image, rng))

    def shown(self, image_bgr: ImageArray, name: str, number: int, seed: int | None = None) -> ImageArray:
        """Return a photograph of an object as an enrolled view, or with a ``seed`` as a query."""
        if seed is None:
            return self.enrolled(image_bgr, generator(0, name, "enrolled", number))
        return self.query(image_bgr, generator(seed, name, "photograph", number))

    def _sized(self, image_bgr: ImageArray) -> ImageArray:
        height, width = image_bgr.shape[:2]
        if self.size_px is None or max(height, width) == self.size_px:
            return image_bgr
        scale = self.size_px / max(height, width)
        size = max(1, round(width * scale)), max(1, round(height * scale))
        # bicubic like MATLAB's imresize
        method = cv2.INTER_CUBIC if scale > 1 else cv2.INTER_AREA
        return cv2.resize(image_bgr, size, interpolation=method).astype(np.uint8, copy=False)

    def _prefiltered(self, image_bgr: ImageArray) -> ImageArray:
        if not self.prefilter_px:
            return image_bgr
        blurred = cv2.GaussianBlur(image_bgr, (0, 0), self.prefilter_px, borderType=cv2.BORDER_REPLICATE)
        return blurred.astype(np.uint8, copy=False)


def _rotated(image: NDArray[_T], angle_deg: float) -> NDArray[_T]:
    """Rotate an image counter-clockwise about its centre; pixels from outside are black."""
    height, width = image.shape[:2]
    matrix = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), angle_deg, 1.0)
    return cv2.warpAffine(image, matrix, (width, height), flags=cv2.INTER_LINEAR).astype(image.dtype, copy=False)


def _before(image: ImageArray, share: NDArray[Any], background: Background, rng: np.random.Generator) -> ImageArray:
    """Return the object before a random background; ``share`` (H, W) is the object's share of each pixel."""
    behind = _uniform(image, rng) if background == "uniform" else _textured(image, rng)
    own = share.astype(np.float32)[:, :, None]
    return np.rint(own * image + (1 - own) * behind).astype(np.uint8)


def _uniform(image: ImageArray, rng: np.random.Generator) -> ImageArray:
    return np.broadcast_to(rng.integers(0, 256, 3, dtype=np.uint8), image.shape)


def _textured(image: ImageArray, rng: np.random.Generator) -> ImageArray:
    """Return coloured noise around a random colour, with several grain sizes; the coarse ones are the strongest."""
    height, width = image.shape[:2]
    texture = np.broadcast_to(rng.uniform(64, 192, 3), image.shape).astype(np.float32)
    for cells in _TEXTURE_OCTAVES:
        grain = rng.normal(0, 48 / np.sqrt(cells / _TEXTURE_OCTAVES[0]), (cells, cells, 3)).astype(np.float32)
        texture = texture + cv2.resize(grain, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.clip(texture, 0, 255).astype(np.uint8)


def levels_of(dataset: Dataset, j: int, condition: Condition, seed: int | None = None) -> LevelArray:
    """Return the descriptors of all photographs of object `j` as enrolled views, uint8 (n, length).

    With a ``seed``: as queries, each with its own noise.

    Raises
    ------
    DatasetError
        A photograph cannot be used, or has another size.
    """
    name = dataset.objects[j].name
    images = (condition.shown(dataset.image(j, i), name, i, seed) for i in range(len(dataset.objects[j].photographs)))
    seen = (segment(image).alone for image in images) if condition.cut_out else images
    return np.stack([describe(image, descriptor=condition.descriptor) for image in seen])
