"""Record the answers of identifications in a catalog."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rig.bench import Bench
from rig.catalog import Catalog, Provenance
from rig.catalog.journal import open_for_enrollment
from rig.catalog.records import Outcome
from rig.catalog.results import Answer, NewResult, record
from rig.config.catalog_place import CatalogPlace
from rig.core.clock import Clock
from rig.core.errors import CatalogUnavailable, RigError
from rig.core.next_steps import steps_as_json
from rig.events.events import Accepted, Event, Failed, Identified, Note, NoteCode, Recorded, Started, Warned, event_dict


@dataclass(eq=False)
class ResultRecorder:
    """Records each answer of `identify` or `watch`, with the image of its first view.

    An answer is never lost: show it before it is recorded. A catalog that cannot be written is a `Warned`.

    Parameters
    ----------
    place
        Place of the catalog.
    bench
        The bench that takes the views.
    clock
        Clock for the civil time of the results.
    catalog_version
        Returns `Catalog.version` of the views that the search has loaded.
    operator
        None for the user's account.
    with_image
        Whether to store images.

    Attributes
    ----------
    sample
        The sample on the table, None if it has no name. It is for one object: give it before each answer.
    """

    place: CatalogPlace | Path
    bench: Bench
    clock: Clock
    catalog_version: Callable[[], str]
    operator: str | None = None
    with_image: bool = True
    sample: str | None = field(default=None, init=False)
    _image: NDArray[np.uint8] | None = field(default=None, init=False)
    _azimuths_deg: list[float] = field(default_factory=list, init=False)

    def add(self, event: Event) -> Recorded | Warned | None:
        """Take the next event; record an answer, and return the event about it."""
        match event:
            case Started():
                self._image, self._azimuths_deg = None, []
            case Accepted():
                if self.with_image and self._image is None:
                    self._image = event.image_bgr
                self._azimuths_deg.append(event.azimuth_deg)
            case Identified():
                recorded = self._record(event)
                self.sample = None
                return recorded
            case Failed():
                self.sample = None
            case _:
                pass
        return None

    def _record(self, answer: Identified) -> Recorded | Warned:
        try:
            new = NewResult(
                Answer(Outcome(answer.outcome.value), next(iter(answer.possible), None), self.sample),
                event_dict(answer),
                tuple(self._azimuths_deg),
                Provenance(self.bench.name, self.bench.devices(), self.bench.conditions),
                self.catalog_version(),
                self.operator,
            )
            try:
                with Catalog.open(self.place, clock=self.clock, create=False) as catalog:
                    return Recorded(record(catalog, new, self._image), self.sample)
            except CatalogUnavailable:
                with open_for_enrollment(CatalogPlace.of(self.place), self.clock) as journal:
                    return Recorded(record(journal, new, self._image), self.sample)
        except RigError as error:
            return Warned(
                None,
                Note(
                    NoteCode.NOT_RECORDED,
                    {"what": error.what, "next_step": error.next_step, "steps": steps_as_json(error.steps)},
                ),
            )
