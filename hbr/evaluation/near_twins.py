"""The images of a data set as views for the comparison of two leaders (`hbr.dense.session`)."""

from collections.abc import Sequence

from hbr.core.arrays import IndexArray
from hbr.dense.local_difference import LocalView
from hbr.dense.session import near
from hbr.descriptors import descriptor
from hbr.evaluation.condition import Condition, EvaluationImage
from hbr.evaluation.datasets import Dataset
from hbr.evaluation.descriptors import photograph
from hbr.evaluation.draws import generator
from hbr.segmentation import segment


class LocalPhotographs:
    """The photographs of a data set, cut out when they are asked for.

    Parameters
    ----------
    dataset : Dataset
    condition : Condition
        Changes of the images of queries and of enrolled views.
    size : (int, int)
        Width and height of each photograph.
    seed : int
        Of the queries, as for `hbr.evaluation.descriptors.query_levels`.
    """

    def __init__(self, dataset: Dataset, condition: Condition, size: tuple[int, int], seed: int) -> None:
        self._dataset, self._condition, self._size, self._seed = dataset, condition, size, seed
        self._known: dict[tuple[int, int], LocalView] = {}

    @property
    def possible(self) -> bool:
        """Whether the descriptor describes an object that is cut out, as on the bench."""
        return not descriptor(self._condition.descriptor).whole_image

    def query(self, object_index: int, number: int, azimuth_deg: float) -> LocalView:
        """Return a photograph of an object, counted from 0, as a view of a search at this orientation.

        Raises
        ------
        DatasetError
            The photograph cannot be used.
        """
        name = self._dataset.objects[object_index].name
        rng = generator(self._seed, name, "photograph", number)
        image = photograph(self._dataset, object_index, number, self._size)
        return _local_view(self._condition.query(image, rng), azimuth_deg)

    def enrolled(self, object_index: int, numbers: IndexArray, azimuths_deg: Sequence[float]) -> list[LocalView]:
        """Return the enrolled views nearest to each azimuth, of the photographs with these numbers, by azimuth.

        There is one more than `NEAREST` for each azimuth, because a comparison leaves one out.

        Raises
        ------
        DatasetError
            A photograph cannot be used.
        """
        own_deg = self._dataset.objects[object_index].azimuth_deg[numbers]
        return [self._enrolled(object_index, number) for number in numbers[near(own_deg, azimuths_deg)].tolist()]

    def _enrolled(self, object_index: int, number: int) -> LocalView:
        if (object_index, number) not in self._known:
            item = self._dataset.objects[object_index]
            image = photograph(self._dataset, object_index, number, self._size)
            shown = self._condition.enrolled(image, generator(0, item.name, "enrolled", number))
            self._known[object_index, number] = _local_view(shown, item.photographs[number].azimuth_deg)
        return self._known[object_index, number]


def _local_view(shown: EvaluationImage, azimuth_deg: float) -> LocalView:
    cut = segment(shown.image, empty_table=shown.empty)
    return LocalView(cut.crop, cut.mask, azimuth_deg)
