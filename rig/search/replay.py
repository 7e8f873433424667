"""Computes a saved run again from its frames, and compares the decisions."""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from math import isclose
from typing import Any, Final

from hbr.dense.pixel_fit import PixelFit
from hbr.dense.session import answered
from rig.core.errors import ReplayMismatch, RunIncomplete
from rig.core.json_form import plain
from rig.core.phrases import counted
from rig.events.events import (
    Accepted,
    Decided,
    Event,
    FrameUsed,
    Identified,
    Moved,
    ObjectChanged,
    Ranked,
    Verified,
    event_dict,
)
from rig.search.model import begin_search
from rig.search.saved_run import SavedRun
from rig.search.session import Finish, Search
from rig.views.description import SearchDescriber

TOLERANCE: Final = 1e-9
"""Largest difference of equal numbers, because another machine may sum in another order."""


@dataclass(frozen=True, slots=True)
class ReplayDifference:
    """Something that was computed differently; ``view`` counts from 1."""

    view: int
    what: str
    saved: Any
    computed: Any

    def __str__(self) -> str:
        return f"view {self.view}, {self.what}: saved {self.saved}, computed {self.computed}"


@dataclass(slots=True)
class ReplayCheck:
    """The result of checking a run; a complete one ends with an answer or an error."""

    views: int = 0
    decisions: int = 0
    is_complete: bool = False
    differences: list[ReplayDifference] = field(default_factory=list)

    def __str__(self) -> str:
        return f"Computed again: {counted(self.views, 'descriptor')} and {counted(self.decisions, 'decision')}."


def confirm(run: SavedRun) -> ReplayCheck:
    """Check a run, which must be whole, and of which every number must be computed as it was saved.

    Raises `ReplayMismatch`: numbers differ. `RunIncomplete`: the run has no end. `UsageError`: as for `check`.
    """
    with run.damage():
        found = check(run)
    if found.differences:
        raise ReplayMismatch(
            f"{counted(len(found.differences), 'number')} in the saved run differ from the computed ones. {found}",
            next_step="Check whether the files of the run were changed. If not, this version of the program decides "
            f"differently from {run.about.software}, which saved the run.",
            evidence={"differences": [str(one) for one in found.differences]},
        )
    if not found.is_complete:
        raise RunIncomplete(
            f"The saved run has no end: {'its last line is cut off' if run.is_cut else 'the answer is missing'}. "
            f"{found} All are as saved.",
            next_step="Search again, or take the run from a backup. The images and decisions so far are good.",
        )
    return found


def check(run: SavedRun) -> ReplayCheck:
    """Describe every frame, search and decide again, and compare with what was saved.

    Raises `UsageError`: the run cannot be read, or its strategy is not known.
    """
    started = run.started
    found = ReplayCheck(is_complete=run.error is not None and not run.is_cut)
    search = begin_search(run.model, run.config, started.strategy, seed=started.seed or 0)
    # A search in motion has too many frames to segment the earlier ones again.
    revise = not search.in_motion
    describe = SearchDescriber(run.config.view, run.views.descriptor, run.empty_table, revise=revise)
    table_deg = 0.0
    for event in run.events():
        computed: Event | dict[str, Any] | None = None
        search.notice(event)
        match event:
            case Moved():
                table_deg = event.encoder_deg
            case Accepted():
                view = describe(event.image_bgr, event.azimuth_deg)
                if event.evidence.motion is not None:
                    table_deg = event.evidence.motion.angle_deg
                known = replace(view, segmentation=event.segmentation, other_bench=event.other_bench)
                search.add(known, event.azimuth_deg, table_deg=table_deg)
                found.views += 1
                if event.segmentation is not None:
                    saved, again = event.segmentation, plain(view.segmentation)
                    found.differences += _compare(found.views, "segmentation", saved, again)
            case ObjectChanged():
                computed = search.changed() or {}
            case Ranked():
                computed, _ = search.decide()
            case FrameUsed() if search.in_motion:
                computed = search.frame_used(event.index, event.azimuth_deg, event.seconds, event.rejected)
            case Decided():
                found.decisions += 1
                computed = _decided(search, event)
            case Verified():
                # the enrolled images are not in the run, so their measured fit is used
                leader = search.names.index(event.name)
                measured = PixelFit(leader, event.fit, event.second, event.others, event.expected, event.light)
                computed = answered(search.verify((), measured))
            case Identified():
                found.decisions += 1
                computed = search.answer(travelled_deg=event.travelled_deg, seconds=event.seconds)
                found.is_complete = not run.is_cut
            case _:
                pass
        # Compare what the events of the run say with what the same search says now.
        if computed is not None:
            saved = event_dict(event)
            again = {"event": event.event, **computed} if isinstance(computed, dict) else event_dict(computed)
            found.differences += _compare(found.views, "", saved, again)
    return found


def _decided(search: Search, saved: Decided) -> Decided | dict[str, Any]:
    """Return the event of the computed step; the target angle is the turntable's, not the search's."""
    _, step = search.decide()
    if isinstance(step, Finish):
        return {"reason": plain(step.reason)}
    return search.decided(saved.index, saved.target_deg)


def _compare(view: int, where: str, saved: Any, computed: Any) -> Iterator[ReplayDifference]:
    if isinstance(saved, dict) and isinstance(computed, dict):
        for key in {**saved, **computed}:
            yield from _compare(view, f"{where}.{key}" if where else key, saved.get(key), computed.get(key))
    elif isinstance(saved, list) and isinstance(computed, list) and len(saved) == len(computed):
        for number, (a, b) in enumerate(zip(saved, computed, strict=True), 1):
            yield from _compare(view, f"{where} {number}", a, b)
    elif isinstance(saved, float) and isinstance(computed, float):
        if not isclose(saved, computed, rel_tol=TOLERANCE, abs_tol=TOLERANCE):
            yield ReplayDifference(view, where, saved, computed)
    elif saved != computed:
        yield ReplayDifference(view, where, saved, computed)
