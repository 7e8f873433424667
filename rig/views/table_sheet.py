"""The empty-table images of a bench, in one image: a turntable needs one, an orbiting camera one for each azimuth.

A camera that moves around the object sees another background at each azimuth. Its images, at even steps from the
azimuth 0, lie row by row on one sheet, with a black line of one pixel between them. So the size of a sheet tells their
number, and they are stored, transferred and replaced together, under one digest.

Decision: docs/decisions/0012.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import isqrt
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

MAX_AWAY_DEG: Final = 1.0
"""Largest distance of a view from its image: at 1 degree 5 % of a simulated frame differ by the background alone."""


@dataclass(frozen=True, slots=True, eq=False)
class TableSheet:
    """A sheet, uint8 (H, W, 3), with its images, uint8 (h, w, 3), in rows and columns.

    An image that is black was not taken: the cable does not reach its azimuth.
    """

    image_bgr: NDArray[np.uint8]
    rows: int
    columns: int

    @classmethod
    def of(cls, image_bgr: NDArray[np.uint8], height: int, width: int) -> Self | None:
        """Return the sheet for frames of this size; None if it is for frames of another size."""
        (rows, below), (columns, beside) = (
            divmod(side + 1, part + 1) for side, part in zip(image_bgr.shape, (height, width), strict=False)
        )
        return None if below or beside or not rows or not columns else cls(image_bgr, rows, columns)

    @classmethod
    def joined(cls, images: Sequence[NDArray[np.uint8]]) -> Self:
        """Return the sheet of images of one size, at even steps from the azimuth 0."""
        count = len(images)
        rows = next(rows for rows in range(isqrt(count), 0, -1) if not count % rows)
        height, width = images[0].shape[:2]
        columns = count // rows
        sheet = cls(np.zeros((rows * (height + 1) - 1, columns * (width + 1) - 1, 3), np.uint8), rows, columns)
        for number, image in enumerate(images):
            sheet[number][:] = image
        return sheet

    def __len__(self) -> int:
        return self.rows * self.columns

    def __getitem__(self, number: int) -> NDArray[np.uint8]:
        height = (self.image_bgr.shape[0] + 1) // self.rows
        width = (self.image_bgr.shape[1] + 1) // self.columns
        top, left = number // self.columns * height, number % self.columns * width
        return self.image_bgr[top : top + height - 1, left : left + width - 1]

    @property
    def step_deg(self) -> float:
        return 360.0 / len(self)

    def nearest(self, azimuth_deg: float) -> tuple[int, float]:
        """Return the number of the nearest image, and its distance in degrees; a single image is for all azimuths."""
        if len(self) == 1:
            return 0, 0.0
        place = round(azimuth_deg / self.step_deg)
        return place % len(self), abs(azimuth_deg - place * self.step_deg)

    def at(self, azimuth_deg: float) -> NDArray[np.uint8] | None:
        """Return the image for a view at this azimuth; None if no image was taken near it (`MAX_AWAY_DEG`)."""
        number, away_deg = self.nearest(azimuth_deg)
        return self[number] if away_deg <= MAX_AWAY_DEG and self[number].any() else None

    def rotation_deg(self, azimuth_deg: float, rotation_deg: float) -> float:
        """Return the rotation of the camera, from this azimuth, that ends at an image and is nearest to the given one.

        It leads to another image than the nearest one to ``azimuth_deg``.
        """
        if len(self) == 1:
            return rotation_deg
        here = round(azimuth_deg / self.step_deg)
        place = round((azimuth_deg + rotation_deg) / self.step_deg)
        if place == here:
            place += 1 if rotation_deg > 0 else -1
        return place * self.step_deg - azimuth_deg


def table_image(
    sheet_bgr: NDArray[np.uint8] | None, frame_bgr: NDArray[np.uint8], azimuth_deg: float
) -> NDArray[np.uint8] | None:
    """Return the empty-table image for a frame at this azimuth; None if the sheet has none for it."""
    sheet = None if sheet_bgr is None else TableSheet.of(sheet_bgr, *frame_bgr.shape[:2])
    return None if sheet is None else sheet.at(azimuth_deg)
