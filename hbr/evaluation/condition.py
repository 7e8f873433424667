"""The condition of an evaluation: how the images of queries differ from those of enrolled views."""

from dataclasses import dataclass, field
from functools import cache
from typing import Final, Literal, NamedTuple, TypeVar, get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from hbr.core.arrays import ImageArray
from hbr.descriptors import descriptor
from hbr.evaluation.noise import Noise
from hbr.evaluation.perturb import Perturbations
from hbr.evaluation.scenes import Picture, other_bench, plain_bench

Background = Literal["same", "uniform", "textured", "bench", "other-bench"]
Reference = Literal["own", "enrollment", "none"]
_T = TypeVar("_T", np.uint8, np.float32)

#: Largest level of COIL's black background, with sensor noise and glow.
_DARK: Final = 45
_TEXTURE_OCTAVES: Final = (4, 8, 16, 32)


class EvaluationImage(NamedTuple):
    """An image and its empty-table image, if there is one."""

    image: ImageArray
    empty: ImageArray | None = None


@dataclass(frozen=True)
class Condition:
    """The differences between an enrolled view and a query.

    Attributes
    ----------
    size_px : int or None
        Longer side of all images, also of enrolled views; None: the size of the file.
    noise : Noise
        Noise of the queries, applied at that size.
    rotation_deg : float
        Largest rotation of a query in the image plane, to either side; the angle is random.
    background : {"same", "uniform", "textured", "bench", "other-bench"}
        Background of a query instead of the dark surroundings. ``bench`` puts enrolled objects and queries on the same
        plain bench, ``other-bench`` the queries on one of several benches with patterns and clutter. Both provide an
        empty-table image.
    prefilter_px : float
        Standard deviation of a Gaussian blur of all images, also of enrolled views; 0: no blur.
    perturbations : Perturbations
        Perturbations of the queries.
    descriptor : str
        Descriptor of enrolled views and queries.
    reference : {"own", "enrollment", "none"}
        Empty-table image of queries on a bench: of their own bench and illumination, of the enrollment's bench, or no
        such image for queries and enrolled views.
    enrolled_noise : Noise
        Noise of the enrolled views.
    """

    size_px: int | None = None
    noise: Noise = field(default_factory=Noise)
    rotation_deg: float = 0.0
    background: Background = "same"
    prefilter_px: float = 0.0
    perturbations: Perturbations = field(default_factory=Perturbations)
    descriptor: str = "cedd"
    reference: Reference = "own"
    enrolled_noise: Noise = field(default_factory=Noise)

    def __post_init__(self) -> None:
        if self.size_px is not None and self.size_px < 2:
            raise ValueError(f"an image size of {self.size_px} pixels; at least 2 are needed, 480 is the paper's")
        if not 0 <= self.rotation_deg <= 180:
            raise ValueError(f"a rotation of {self.rotation_deg} degrees; 0 to 180 are possible")
        if not (np.isfinite(self.prefilter_px) and self.prefilter_px >= 0):
            raise ValueError(f"a prefilter of {self.prefilter_px} pixels; at least 0 is needed")
        if self.background not in get_args(Background):
            raise ValueError(f"background {self.background!r} is unknown; use one of {', '.join(get_args(Background))}")
        if self.reference not in get_args(Reference):
            raise ValueError(f"reference {self.reference!r} is unknown; use one of {', '.join(get_args(Reference))}")
        if (self.on_bench or self.perturbations) and (self.rotation_deg or self.background in ("uniform", "textured")):
            raise ValueError(
                "a rotation in the plane, and a uniform or textured background, cannot be combined with perturbations "
                "or a bench; leave out one of them"
            )
        descriptor(self.descriptor)

    @property
    def on_bench(self) -> bool:
        """Whether objects stand on a drawn bench."""
        return self.background in ("bench", "other-bench")

    @property
    def same_bench(self) -> bool | None:
        """Whether a search knows that its bench is that of the enrollment; None: not known."""
        return True if self.background in ("same", "bench") else None

    def enrolled(self, image_bgr: ImageArray, rng: np.random.Generator | None = None) -> EvaluationImage:
        """Return the image of an enrolled view; `rng` draws its noise."""
        image = self._sized(image_bgr)
        empty: ImageArray | None = None
        if self.on_bench:
            image, empty = Perturbations().photograph(
                image, object_mask(image), np.random.default_rng(0), _benches()[0]
            )
        noisy = self.enrolled_noise.apply(image, rng or np.random.default_rng(0))
        return EvaluationImage(self._prefiltered(noisy), None if self.reference == "none" else empty)

    def query(self, image_bgr: ImageArray, rng: np.random.Generator) -> EvaluationImage:
        """Return the image of a query; equal states of `rng` give equal images."""
        image = self._sized(image_bgr)
        if self.on_bench or self.perturbations:
            first, *others = _benches()
            bench = {"bench": first, "other-bench": others[int(rng.integers(len(others)))]}.get(self.background)
            image, empty = self.perturbations.photograph(image, object_mask(image), rng, bench)
            if self.reference != "own":
                empty = _shown(first) if self.on_bench and self.reference == "enrollment" else None
            return EvaluationImage(self._prefiltered(self.noise.apply(image, rng)), empty)
        if self.rotation_deg or self.background != "same":
            mask = object_mask(image).astype(np.float32)
            if self.rotation_deg:
                angle_deg = rng.uniform(-self.rotation_deg, self.rotation_deg)
                image, mask = _rotated(image, angle_deg), _rotated(mask, angle_deg)
            if self.background != "same":
                behind = _uniform(image, rng) if self.background == "uniform" else _textured(image, rng)
                share = mask[:, :, None]
                image = np.rint(share * image + (1 - share) * behind).astype(np.uint8)
        return EvaluationImage(self._prefiltered(self.noise.apply(image, rng)))

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


def object_mask(image_bgr: ImageArray) -> NDArray[np.bool_]:
    """Return the pixels of the object, (H, W): all except the dark region that is connected with the image's border."""
    dark = (image_bgr.max(axis=2) <= _DARK).astype(np.uint8)
    # a frame of dark pixels joins all regions that touch the border
    labels = cv2.connectedComponents(cv2.copyMakeBorder(dark, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=1))[1]
    outside: NDArray[np.bool_] = labels[1:-1, 1:-1] == labels[0, 0]
    return ~outside


@cache
def _benches() -> tuple[Picture, ...]:
    """Return the plain bench, and eight others."""
    rng = np.random.default_rng(801)
    return (plain_bench(rng), *(other_bench(rng) for _ in range(8)))


def _shown(bench: Picture) -> ImageArray:
    return np.clip(np.rint(bench), 0, 255).astype(np.uint8)


def _rotated(image: NDArray[_T], angle_deg: float) -> NDArray[_T]:
    """Rotate an image counter-clockwise about its centre; pixels from outside are black."""
    height, width = image.shape[:2]
    matrix = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), angle_deg, 1.0)
    return cv2.warpAffine(image, matrix, (width, height), flags=cv2.INTER_LINEAR).astype(image.dtype, copy=False)


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
