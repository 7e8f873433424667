"""The complete plan of an evaluation: equal plans give equal results."""

from dataclasses import asdict, dataclass
from importlib.metadata import version
from typing import Any, Final

from hbr.descriptors import descriptor
from hbr.evaluation.condition import Condition
from hbr.evaluation.datasets import Dataset, Photograph, PhotographedObject, read_photograph
from hbr.evaluation.methods import Method
from hbr.evaluation.protocol import Protocol
from rig.catalog import Catalog

#: Increased if the same settings give other numbers.
FORMAT: Final = 6


@dataclass(frozen=True)
class Plan:
    """A data set, its condition, the methods and the trials; `size` is that of the first photograph."""

    dataset: Dataset
    size: tuple[int, int]
    condition: Condition
    methods: tuple[Method, ...]
    protocol: Protocol

    @classmethod
    def of(cls, dataset: Dataset, condition: Condition, methods: tuple[Method, ...], protocol: Protocol) -> "Plan":
        """Return the plan, with the size of the first photograph.

        Raises
        ------
        DatasetError
            The photograph cannot be read.
        """
        height, width = read_photograph(dataset.objects[0].photographs[0].path).shape[:2]
        return cls(dataset, (width, height), condition, methods, protocol)

    def settings(self) -> dict[str, Any]:
        """Return everything that determines the results, as JSON values with units in the keys."""
        dataset, condition = self.dataset, self.condition
        return {
            "format": FORMAT,
            "version": version("hbr-rig"),
            "dataset": {
                "name": dataset.name,
                "objects": [item.name for item in dataset.objects],
                "views": dataset.views,
                "missing_views": dataset.missing,
                "spacing_deg": dataset.spacing_deg,
                "width_px": self.size[0],
                "height_px": self.size[1],
            },
            "condition": {
                "noise": str(condition.noise),
                "size_px": condition.size_px,
                "rotation_deg": condition.rotation_deg,
                "background": condition.background,
                "prefilter_px": condition.prefilter_px,
                "perturbations": str(condition.perturbations),
                "reference": condition.reference,
                "enrolled_noise": str(condition.enrolled_noise),
                "descriptor": condition.descriptor,
                "descriptor_version": descriptor(condition.descriptor).version,
            },
            "protocol": asdict(self.protocol),
            "methods": [asdict(method) for method in self.methods],
        }


def load_catalog(catalog: Catalog, region: tuple[int, int, int, int] | None) -> Dataset:
    """Return the stored images of a catalog as a data set.

    Parameters
    ----------
    region
        The part that is described: x, y, width, height in pixels; None: the whole image.

    Raises
    ------
    DatasetError
        There are fewer than two objects, or two views of an object from the same angle.
    """
    objects = []
    for summary in catalog.objects():
        photographs = sorted(
            (
                Photograph(catalog.image_path(view.image), view.azimuth_deg)
                for view in catalog.object(summary.name).views
            ),
            key=lambda photograph: photograph.azimuth_deg,
        )
        if photographs:
            objects.append(PhotographedObject(summary.name, tuple(photographs)))
    return Dataset(str(catalog.place), tuple(objects), region=region)
