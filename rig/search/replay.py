"""Compute a saved run again, from its frames: the same program must decide the same."""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from math import isclose
from typing import Any, Final

from rig.events.events import Accepted, Decided, Identified, Moved, Ranked, plain
from rig.search.saved_run import SavedRun
from rig.search.session import Search, begin_search
from rig.search.strategies import AnyStrategy, Finish, Rotate
from rig.views.description import ViewDescriber

TOLERANCE = 1e-9
"""Numbers that differ less are equal: another machine may sum in another order."""


@dataclass(frozen=True, slots=True)
class Difference:
    """Something that came out otherwise; ``view`` counts from 1."""

    view: int
    what: str
    saved: Any
    computed: Any

    def __str__(self) -> str:
        return f"view {self.view}, {self.what}: saved {self.saved}, computed {self.computed}"


@dataclass(slots=True)
class Check:
    """What the check of a run found."""

    views: int = 0
    decisions: int = 0
    differences: list[Difference] = field(default_factory=list)


def check(run: SavedRun, *, by: AnyStrategy | None = None) -> Check:
    """Describe every frame again, vote again and decide again, and compare with what was saved.

    Parameters
    ----------
    run
        The run.
    by
        The strategy, where it has no name that this program knows.

    Raises
    ------
    UsageError
        The run cannot be read, or its strategy is not known.
    """
    started = run.started
    found = Check()
    search: Search | None = None
    describe = ViewDescriber(run.config.view, (run.views.descriptor,), run.empty_table)
    ranked: Ranked | None = None
    step: Rotate | Finish | None = None
    table_deg = 0.0
    for event in run.events():
        match event:
            case Moved():
                table_deg = event.encoder_deg
            case Accepted():
                seen = describe(event.image_bgr)
                if search is None:
                    search, _ = begin_search(
                        run.model,
                        run.config,
                        by or started.strategy,
                        seed=started.seed or 0,
                        top=len(run.views.object_names),
                    )
                levels = seen.levels[search.descriptor]
                ranked, step = search.look(levels, event.azimuth_deg, table_deg=table_deg)
                found.views += 1
                if event.segmentation is not None:
                    found.differences += _compare(
                        found.views, "segmentation", event.segmentation, plain(seen.segmentation)
                    )
            case Ranked() if ranked is not None:
                # As many candidates as the run was asked to name.
                top = len(event.candidates)
                again = replace(ranked, candidates=ranked.candidates[:top])
                found.differences += _compare(found.views, "", plain(event), plain(again))
            case Decided():
                found.decisions += 1
                found.differences += _compare(found.views, "", _saved_step(event), _computed_step(step, event))
            case Identified() if ranked is not None and search is not None:
                found.decisions += 1
                found.differences += _compare(
                    found.views, "", _saved_answer(event), _computed_answer(search, ranked, step)
                )
            case _:
                pass
    return found


def _saved_step(event: Decided) -> dict[str, Any]:
    return {
        "what": "turn",
        "rotation_deg": event.rotation_deg,
        "s_left": event.s_left,
        "s_right": event.s_right,
        "rivals": list(event.rivals),
        "why": event.why,
        "weighed": plain(event.weighed),
    }


def _computed_step(step: Rotate | Finish | None, saved: Decided) -> dict[str, Any]:
    if not isinstance(step, Rotate):
        return {"what": "stop", "why": step.why if step else "no view was taken"}
    rivals = list(step.rivals[: len(saved.rivals)])
    return {"what": "turn", **plain(step), "rivals": rivals}


_ANSWER: Final = (
    "name",
    "score",
    "margin",
    "min_score",
    "pose_deg",
    "yaw_deg",
    "reason",
    "probability",
    "familiarity",
    "min_familiarity",
)


def _saved_answer(event: Identified) -> dict[str, Any]:
    return {"what": "stop", **{key: getattr(event, key) for key in _ANSWER}}


def _computed_answer(search: Search, ranked: Ranked, step: Rotate | Finish | None) -> dict[str, Any]:
    answer = search.answer(ranked, step.why if step else "")
    return {
        "what": "stop" if isinstance(step, Finish) else "turn",
        **{key: getattr(answer, key) for key in _ANSWER},
    }


def _compare(view: int, where: str, saved: Any, computed: Any) -> Iterator[Difference]:
    """Yield what differs, field by field."""
    if isinstance(saved, dict) and isinstance(computed, dict):
        for key in {**saved, **computed}:
            yield from _compare(view, f"{where}.{key}" if where else key, saved.get(key), computed.get(key))
    elif isinstance(saved, list) and isinstance(computed, list) and len(saved) == len(computed):
        for number, (a, b) in enumerate(zip(saved, computed, strict=True), 1):
            yield from _compare(view, f"{where} {number}", a, b)
    elif isinstance(saved, float) and isinstance(computed, float):
        if not isclose(saved, computed, rel_tol=TOLERANCE, abs_tol=TOLERANCE):
            yield Difference(view, where, saved, computed)
    elif saved != computed:
        yield Difference(view, where, saved, computed)
