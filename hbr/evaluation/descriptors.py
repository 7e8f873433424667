"""Descriptors of photographs, as enrolled views and as queries."""

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np

from hbr.core.arrays import ImageArray, LevelArray
from hbr.descriptors import descriptor
from hbr.descriptors.registry import describe
from hbr.evaluation.condition import Condition, EvaluationImage
from hbr.evaluation.datasets import Dataset, read_photograph
from hbr.evaluation.draws import generator
from hbr.segmentation import segment


class Queries(NamedTuple):
    """The views of an object as queries: levels, uint8 (n, length), and how each was segmented ("": it was not)."""

    levels: LevelArray
    methods: tuple[str, ...]


def enrolled_levels(dataset: Dataset, j: int, condition: Condition, size: tuple[int, int]) -> LevelArray:
    """Return the descriptors of all enrolled views of object `j`, uint8 (n, length).

    Raises
    ------
    DatasetError
        A photograph cannot be used, or does not have the width and height `size`.
    """
    name = dataset.objects[j].name
    images = enumerate(_images(dataset, j, size))
    return _levels((condition.enrolled(image, generator(0, name, "enrolled", i)) for i, image in images), condition)


def query_levels(dataset: Dataset, j: int, condition: Condition, size: tuple[int, int], seed: int) -> LevelArray:
    """Return the descriptors of all views of object `j` as queries, uint8 (n, length). Each has its own noise."""
    return _levels(_queries(dataset, j, condition, size, seed), condition)


def segmented_queries(dataset: Dataset, j: int, condition: Condition, size: tuple[int, int], seed: int) -> Queries:
    """Return the same descriptors as `query_levels`, and the methods of segmentation (`hbr.segmentation.Method`)."""
    kind = descriptor(condition.descriptor)
    if kind.whole_image:
        levels = query_levels(dataset, j, condition, size, seed)
        return Queries(levels, ("",) * len(levels))
    found = [segment(image, empty_table=empty) for image, empty in _queries(dataset, j, condition, size, seed)]
    return Queries(np.stack([kind.describe(one) for one in found]), tuple(one.method.value for one in found))


def _queries(
    dataset: Dataset, j: int, condition: Condition, size: tuple[int, int], seed: int
) -> Iterator[EvaluationImage]:
    name = dataset.objects[j].name
    for i, image in enumerate(_images(dataset, j, size)):
        yield condition.query(image, generator(seed, name, "photograph", i))


def _levels(images: Iterable[EvaluationImage], condition: Condition) -> LevelArray:
    return np.stack([describe(image, descriptor=condition.descriptor, empty_table=empty) for image, empty in images])


def _images(dataset: Dataset, j: int, size: tuple[int, int]) -> Iterator[ImageArray]:
    for i in range(len(dataset.objects[j].photographs)):
        yield photograph(dataset, j, i, size)


def photograph(dataset: Dataset, j: int, i: int, size: tuple[int, int]) -> ImageArray:
    """Return the described part of photograph `i` of object `j`; errors as for `enrolled_levels`."""
    image = read_photograph(dataset.objects[j].photographs[i].path, size)
    if dataset.region is not None:
        x, y, width, height = dataset.region
        image = image[y : y + height, x : x + width]
    return image
