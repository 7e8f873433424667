"""Photographs that show only noise, for commands that import them."""

from pathlib import Path

import cv2
import numpy as np


def photographs(folder: Path, *objects: str, step_deg: int = 90, side: int = 24) -> Path:
    """Write photographs of the objects at every ``step_deg`` (°), ``side`` pixels wide and high, to a new folder."""
    folder.mkdir()
    for seed, name in enumerate(objects):
        for angle in range(0, 360, step_deg):
            picture = np.random.default_rng([seed, angle]).integers(0, 256, (side, side, 3), np.uint8)
            cv2.imwrite(str(folder / f"{name}__{angle}.png"), picture)
    return folder
