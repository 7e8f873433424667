"""The steps that searches at rest and in motion share: they give a search what it needs, and yield its events."""

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hbr.dense.last_steps import NeedEnrolledViews
from hbr.dense.local_difference import LocalView
from rig.bench import Bench
from rig.core.errors import CatalogError, RigError
from rig.events.events import Decided, Event, Identified, Note, NoteCode, Warned
from rig.motion.turntable import Turntable
from rig.plans.capture import accepted, capture, unwind, warn_of_table
from rig.search.model import Model
from rig.search.session import Search
from rig.search.strategies import Rotate
from rig.views.capture import Attempt, Viewer
from rig.views.description import SearchDescriber


class Searched(NamedTuple):
    """The motion of a search, and the error of the unwinding after it: the answer is reported first."""

    travelled_deg: float
    seconds: float
    failed: RigError | None


@dataclass
class SearchSteps:
    """A search on a bench.

    Attributes
    ----------
    check
        Gets the image of the first view, and raises an error if it shows no object.
    top
        The number of candidates that the events name.
    decided_ns
        When the last view at rest was decided.
    """

    bench: Bench
    model: Model
    search: Search
    viewer: Viewer
    describe: SearchDescriber
    check: Callable[[NDArray[np.uint8]], None]
    top: int
    decided_ns: int = 0

    def view(
        self, number: int, table: Turntable, settled_ns: int, azimuth_deg: float
    ) -> Generator[Event, None, Attempt]:
        """Add an acceptable frame at rest to the search; errors as for `rig.plans.capture.capture`."""
        captured = yield from capture(number, self.viewer, table, settled_ns)
        described = self.describe(captured.image_bgr)
        yield accepted(number, azimuth_deg, captured, described)
        if number == 0:
            self.check(captured.image_bgr)
        yield from warn_of_table(self.bench, number, described)
        ranked, _ = self.search.add(described, azimuth_deg, table_deg=table.rest_deg)
        self.decided_ns = self.bench.clock.now_ns()
        if self.search.is_new_decision:
            yield ranked
        return captured

    def decided(self, number: int, step: Rotate, target_deg: float) -> Decided:
        """Return the event of a decision to rotate."""
        return Decided(
            index=number,
            side="left" if step.rotation_deg >= 0 else "right",
            rotation_deg=step.rotation_deg,
            target_deg=target_deg,
            s_left=step.s_left,
            s_right=step.s_right,
            candidates=step.candidates[: self.top],
            reason=step.reason,
            note=step.note,
            weighed=step.weighed,
        )

    def end(self, *, travelled_deg: float, seconds: float) -> Generator[Event, None, Identified]:
        """End the search; return its answer. If an enrolled image is missing, the answer is the one without it."""
        steps = self.search.end(self.describe.hypotheses, travelled_deg=travelled_deg, seconds=seconds)
        views: Sequence[LocalView] | None = None
        while True:
            try:
                asked = steps.send(views)
            except StopIteration as end:
                answer: Identified = end.value
                return answer
            views = None
            if not isinstance(asked, NeedEnrolledViews):
                yield asked
            elif self.model.leader_views is not None:
                try:
                    views = self.model.leader_views(self.search.names[asked.object_index], asked.azimuths_deg)
                except CatalogError as error:
                    values = {"what": error.what, "next_step": error.next_step}
                    yield Warned(self.search.ranked.index, Note(NoteCode.NOT_COMPARED, values))


def unwound(number: int, table: Turntable) -> Generator[Event, None, RigError | None]:
    """Unwind the cable, as `rig.plans.capture.unwind`; return its error."""
    try:
        yield from unwind(number, table)
    except RigError as error:
        return error
    return None
