"""Time of CEDD, compared with OpenCV's resize of the same frame to 80 x 80, in one thread.

If the mean luminance of a quarter of a block is an integer, CEDD adds its pixels one by one to reproduce the rounding.
That happens for one of n quarters of n pixels in grey frames, and for all quarters of flat frames and of noise in
multiples of 48.
"""

from collections.abc import Callable

import cv2
import numpy as np

from benchmarks.record import record, times_ms
from hbr import cedd, describe
from hbr.core.arrays import ImageArray

REPEATS = 300
PEER = "cv2.resize to 80 x 80"


def frame(width: int, height: int) -> ImageArray:
    """Return a textured, coloured scene with sensor noise on a plain background."""
    rng = np.random.default_rng(0)
    scene = cv2.resize(
        rng.integers(0, 256, (12, 16, 3), dtype=np.uint8), (width, height), interpolation=cv2.INTER_CUBIC
    )
    scene[: height // 4] = (60, 80, 70)
    noisy: ImageArray = np.clip(scene + rng.normal(0, 3, scene.shape), 0, 255).astype(np.uint8)
    return noisy


def main() -> None:
    cv2.setNumThreads(1)
    for width, height in ((640, 480), (160, 160), (128, 128)):
        image = frame(width, height)
        grey = image[:, :, 1:2].repeat(3, axis=2)
        flat = np.full_like(image, 127)
        posterised = (grey + np.random.default_rng(1).integers(0, 64, (height, width, 1), dtype=np.uint8)) // 48 * 48
        calls: dict[str, Callable[[], object]] = {
            PEER: lambda image=image: cv2.resize(image, (80, 80), interpolation=cv2.INTER_AREA),  # type: ignore[misc]
            "hbr.cedd": lambda image=image: cedd(image),  # type: ignore[misc]
            "hbr.cedd, grey": lambda grey=grey: cedd(grey),  # type: ignore[misc]
            "hbr.cedd, flat grey": lambda flat=flat: cedd(flat),  # type: ignore[misc]
            "hbr.cedd, noise in 6 greys": lambda posterised=posterised: cedd(posterised),  # type: ignore[misc]
            "hbr.describe": lambda image=image: describe(image),  # type: ignore[misc]
        }
        least_ms = {name: min(times_ms(call, REPEATS)) for name, call in calls.items()}
        for name, one_ms in least_ms.items():
            record(f"{width}x{height}: {name}", one_ms, PEER, least_ms[PEER])


if __name__ == "__main__":
    main()
