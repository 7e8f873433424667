"""The plan that takes the picture of the empty table, and sees that it is empty."""

from collections.abc import Generator
from typing import Final

import hbr
from hbr.segmentation import MIN_AGREEMENT
from rig.bench import Bench, TableClearer
from rig.core.clock import seconds_between
from rig.core.errors import TableNotEmpty, UsageError
from rig.events.events import EmptyTableImage, Event, Warned, plain
from rig.motion.turntable import Turntable
from rig.plans.capture import announced, capture
from rig.plans.enroll import SAME_SIMILARITY
from rig.views.capture import Viewer, image_similarity
from rig.views.description import within
from rig.views.empty_table import COMMAND, EmptyTable, EmptyTables
from rig.views.object_presence import GRID, changed_cells, picture

TURN_DEG: Final = 25.0
"""So far the table turns between two pictures: what stands on it shows another side, or stands elsewhere."""
LEAST_TURN_DEG: Final = 5.0
NOTICED_SHARE: Final = 0.004
"""Something stands on the table when this share of the picture changes with it: 2 cm on a picture of 24 cm."""


def photograph_table(bench: Bench, *, anyway: bool = False) -> Generator[Event, None, EmptyTableImage]:
    """Take the picture of the empty table and keep it beside the bench's state; yields events and returns the last.

    An operator who can empties the table; otherwise it is empty already. Two frames are taken, the table turned a
    little between them, and judged as views are: what changes stands on the table. Closing the generator takes the
    torque off.

    Parameters
    ----------
    bench
        An open one.
    anyway
        Keep the picture although something on the table turns with it: a pattern, or a screw that stays there.

    Raises
    ------
    TableNotEmpty
        Something turns with the table, or the surroundings are not still; the picture before this one stays.
    UsageError
        The camera goes around the object: its background is another in every view.
    StateNotStored
        The picture cannot be kept.
    ViewRejected, LimitExceeded, MotionTimeout, DeviceFault, DeviceSilent
        See `rig.views.capture` and `rig.motion.turntable`.
    """
    if bench.config.table.carries == "camera":
        raise UsageError(
            "The camera goes around the object, and its background is another in every view.",
            next_step="No picture of the empty table is needed; have a plain background.",
        )
    if isinstance(bench.operator, TableClearer) and not bench.operator.clear():
        raise UsageError(
            "What stands on this bench cannot be taken away.", next_step="No picture of the empty table is needed."
        )
    viewer = Viewer(bench.camera, bench.config.view)
    started_ns = bench.clock.now_ns()
    turned = None
    with Turntable(bench) as table:
        move = table.hold()
        begin_deg = table.rest_deg
        first = yield from capture(0, viewer, table, move.settled_ns)
        away_deg = _away_deg(begin_deg, table.limits_deg)
        if abs(away_deg - begin_deg) >= LEAST_TURN_DEG:
            move = yield from announced(1, table, away_deg)
            turned = yield from capture(1, viewer, table, move.settled_ns)
            yield from announced(1, table, begin_deg)
    config = bench.config.view
    share = agreement = None
    if turned is not None:
        pictures = [picture(shot.image_bgr, config) for shot in (first, turned)]
        share = changed_cells(*pictures) / GRID**2
        parts = [within(shot.image_bgr, config.roi) for shot in (first, turned)]
        agreement = hbr.segment(parts[1], empty_table=hbr.Background(parts[0])).agreement
        if not anyway:
            _check(share, agreement)
    before = EmptyTables.standing(bench)
    if before.table is not None and image_similarity(before.table.image_bgr, first.image_bgr, config) < SAME_SIMILARITY:
        yield Warned(
            None,
            f"the table does not look as it did at {before.table.taken_utc:%Y-%m-%d %H:%M} UTC; what is round turns "
            "unseen",
            f"See that it is empty; if it is not, take what is there off and run `{COMMAND}`.",
        )
    evidence = first.evidence
    taken = EmptyTable(
        image_bgr=first.image_bgr,
        taken_utc=bench.clock.utc(),
        camera=bench.camera.identity,
        locks=evidence.locks,
        evidence={**plain(evidence), "turning_share": share, "agreement": agreement},
    )
    EmptyTables.keep(bench, taken)
    done = EmptyTableImage(
        taken_utc=f"{taken.taken_utc:%Y-%m-%dT%H:%M:%SZ}",
        width=int(first.image_bgr.shape[1]),
        height=int(first.image_bgr.shape[0]),
        turning_share=share,
        agreement=agreement,
        evidence=evidence,
        replaced=before.doubts,
        seconds=seconds_between(started_ns, bench.clock.now_ns()),
        image_bgr=first.image_bgr,
    )
    yield done
    return done


def _away_deg(begin_deg: float, limits_deg: tuple[float, float]) -> float:
    low, high = limits_deg
    up_deg, down_deg = min(begin_deg + TURN_DEG, high), max(begin_deg - TURN_DEG, low)
    return up_deg if up_deg - begin_deg >= begin_deg - down_deg else down_deg


def _check(share: float, agreement: float | None) -> None:
    numbers = {"turning_share": round(share, 4), "most_turning_share": NOTICED_SHARE}
    if agreement is not None and agreement < MIN_AGREEMENT:
        raise TableNotEmpty(
            "The surroundings of the table are not the same in two pictures: somebody moved in them, or the table "
            "reaches to the border.",
            next_step=f"Stand back and take it again; let view.roi show a rim of the background: {COMMAND}",
            evidence={"agreement": round(agreement, 3), "least_agreement": MIN_AGREEMENT, **numbers},
        )
    if share > NOTICED_SHARE:
        raise TableNotEmpty(
            f"Something stands on the table: {share:.1%} of the picture changes as it turns.",
            next_step=f"Take it off and run `{COMMAND}`; if it stays there always, such as a pattern or a screw: "
            f"{COMMAND} --anyway",
            evidence=numbers,
        )
