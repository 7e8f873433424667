"""An experiment: everything that decides its results besides the photographs."""

from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any, Final, Literal, NamedTuple

from hbr.descriptors import descriptor
from hbr.evaluation.condition import Condition
from hbr.evaluation.photographs import Dataset
from hbr.evaluation.protocol import Method, Protocol

Change = Literal["none", "mild", "hard"]
#: Increased if the same settings give other numbers.
FORMAT: Final = 13


@dataclass(frozen=True)
class Experiment:
    """An experiment; equal ones give equal results on equal photographs."""

    name: str
    """Name in files and reports."""
    condition: Condition = field(default_factory=Condition)
    """How the images of queries differ from those of enrolled views."""
    protocol: Protocol = field(default_factory=Protocol)
    """The settings of the trials."""
    methods: tuple[Method, ...] = ()
    """The methods that are compared, if the bench does not change."""
    objects: tuple[int, int] | None = None
    report: tuple[int, int] | None = None
    """(int, int) or None: first and last object of the data set that takes part, and that is reported, counted from 1;
    None: all."""
    every: int = 1
    """Step between the photographs of an object that are used: with 2, every second one."""
    change: Change | None = None
    """None: trials that compare methods. Else searches of the rig, also for objects that are left out, after this
    change of a whole drawn bench; none: the photographs as they are, with the noise of the condition, and queries that
    are not enrolled."""
    picture: bool = True
    """Whether enrollment and searches use a picture of their empty table, if the bench changes."""
    plain: bool = False
    """Whether all drawn benches have a plain backdrop and a visible platter."""
    margin: float = 0.02
    min_views: int = 2
    """Lead per view, and number of views, that end a search of the paper."""

    def __post_init__(self) -> None:
        if self.change == "none" and self.picture:
            raise ValueError("photographs as they are have no empty-table image; give picture = false")
        if self.every < 1:
            raise ValueError(f"every is {self.every}; at least 1 is needed")
        if self.change is not None and self.protocol.enrolled is None:
            raise ValueError("a change of the bench needs the number of enrolled views; give enrolled = 18")

    def settings(self, dataset: Dataset) -> dict[str, Any]:
        """Return everything that determines the results, as JSON values with units in the keys."""
        condition, (width, height) = self.condition, dataset.size
        return {
            "format": FORMAT,
            "dataset": {
                "name": dataset.name,
                "objects": [item.name for item in dataset.objects],
                "views": dataset.views,
                "missing_views": dataset.missing,
                "spacing_deg": dataset.spacing_deg,
                "width_px": width,
                "height_px": height,
            },
            "condition": {
                **{name: getattr(condition, name) for name in condition.__dataclass_fields__},
                **{name: str(getattr(condition, name)) for name in ("noise", "enrolled_noise", "perturbations")},
                "descriptor_version": descriptor(condition.descriptor).version,
            },
            "protocol": asdict(self.protocol),
            "methods": [asdict(method) for method in self.methods],
            "every": self.every,
            "change": self.change,
            "picture": self.picture,
            "plain": self.plain,
        }


class Kind(NamedTuple):
    """The steps of a kind of experiment; objects are numbered from 0, each can be worked on in a process of its own."""

    enroll: Callable[[Experiment, Dataset, int], Any]
    """Describes the enrolled views of one object: experiment, data set, object."""
    model: Callable[[Experiment, Dataset, list[Any]], Any]
    """Makes the model of all objects: experiment, data set, what `enroll` returned for each."""
    search: Callable[[Experiment, Dataset, Any, Callable[[], int], int], Any]
    """Searches for one object: experiment, data set, model, monotonic time in ns, object."""
    results: Callable[[Experiment, Dataset, Any, list[Any]], dict[str, Any]]
    """The results as JSON values: experiment, data set, model, what `search` returned for each object."""
