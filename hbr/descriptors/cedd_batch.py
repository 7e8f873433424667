"""CEDD of many images in several processes."""

from collections.abc import Iterable
from functools import partial
from os import PathLike

import cv2
import numpy as np

from hbr.core.arrays import ImageArray, LevelArray
from hbr.descriptors.cedd import BINS, describe

#: Images that a process gets at once.
_CHUNK = 16


def describe_all(
    images: Iterable[ImageArray | str | PathLike[str]],
    *,
    size: tuple[int, int] | None = None,
    processes: int | None = None,
) -> LevelArray:
    """Return the CEDD levels of many images, like `hbr.describe`.

    The processes import the calling program. Protect its own work by ``if __name__ == "__main__":``. Paths are faster
    than arrays, because the processes read the files themselves.

    Parameters
    ----------
    images : iterable of uint8 arrays (H, W, 3), or of paths of image files
        The images. All are submitted at once.
    size : (int, int), optional
        As for `describe`.
    processes : int, optional
        Number of processes, by default one for each core; 1 uses the calling process.

    Returns
    -------
    uint8 array (n, 144)
        In the order of the images.

    Raises
    ------
    TypeError, ValueError
        As `describe`, or a file cannot be read; the message names it.
    """
    if processes is not None and processes < 1:
        raise ValueError(f"processes is {processes}; at least 1 is needed, or None for one a core")
    work = partial(_describe, size=size)
    if processes == 1:
        levels = list(map(work, images))
    else:
        from concurrent.futures import ProcessPoolExecutor
        from multiprocessing import get_context

        with ProcessPoolExecutor(processes, get_context("spawn"), cv2.setNumThreads, (1,)) as pool:
            levels = list(pool.map(work, images, chunksize=_CHUNK))
    return np.stack(levels) if levels else np.empty((0, BINS), np.uint8)


def _describe(image: ImageArray | str | PathLike[str], size: tuple[int, int] | None) -> LevelArray:
    if isinstance(image, np.ndarray):
        return describe(image, size=size)
    read = cv2.imread(str(image), cv2.IMREAD_COLOR)
    if read is None:
        raise ValueError(f"{image} is missing, or no image that OpenCV can read; check the path")
    return describe(read.astype(np.uint8, copy=False), size=size)
