"""Photographs to descriptors: as they are enrolled, and as queries see them."""

from collections.abc import Iterator

import numpy as np

from hbr.core.arrays import ImageArray, LevelArray
from hbr.descriptors.describe import describe
from hbr.evaluation.condition import Condition
from hbr.evaluation.datasets import Dataset, read_photograph
from hbr.evaluation.draws import generator


def enrolled_levels(dataset: Dataset, j: int, condition: Condition, size: tuple[int, int]) -> LevelArray:
    """Descriptors of all views of object `j` as they are enrolled, uint8 (n, length).

    Raises
    ------
    DatasetError
        A photograph cannot be used; `size` is the width and height that all must have.
    """
    name = dataset.objects[j].name
    shots = (
        condition.enrolled(image, generator(0, name, "enrolled", i))
        for i, image in enumerate(_images(dataset, j, size))
    )
    return np.stack([describe(image, descriptor=condition.descriptor, empty_table=empty) for image, empty in shots])


def query_levels(dataset: Dataset, j: int, condition: Condition, size: tuple[int, int], seed: int) -> LevelArray:
    """Descriptors of all views of object `j` as queries, uint8 (n, length); each photograph has noise of its own."""
    name = dataset.objects[j].name
    shots = (
        condition.query(image, generator(seed, name, "photograph", i))
        for i, image in enumerate(_images(dataset, j, size))
    )
    return np.stack([describe(image, descriptor=condition.descriptor, empty_table=empty) for image, empty in shots])


def _images(dataset: Dataset, j: int, size: tuple[int, int]) -> Iterator[ImageArray]:
    for photograph in dataset.objects[j].photographs:
        image = read_photograph(photograph.path, size)
        if dataset.region is not None:
            x, y, width, height = dataset.region
            image = image[y : y + height, x : x + width]
        yield image
