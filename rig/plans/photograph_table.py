"""The plan that takes the empty-table image and checks that the table is empty."""

from collections.abc import Generator
from typing import Final

import hbr
from hbr.segmentation import MIN_AGREEMENT
from rig.bench import Bench
from rig.core.clock import seconds_between
from rig.core.errors import TableNotEmpty, UsageError
from rig.core.json_form import plain
from rig.core.next_steps import Do
from rig.core.phrases import percent
from rig.events.events import EmptyTableImage, Event, Note, NoteCode, Warned
from rig.motion.turntable import Turntable
from rig.plans.enroll import SAME_SIMILARITY
from rig.plans.steps import announced, capture
from rig.views.capture import Viewer, image_similarity
from rig.views.description import within
from rig.views.empty_table import EmptyTable, empty_table_status, store_empty_table
from rig.views.object_presence import GRID, changed_cells, shrunk

ROTATION_DEG: Final = 25.0
"""The table rotates by this angle between two images, so that an object shows another side or moves in the image."""
MIN_ROTATION_DEG: Final = 5.0  # less: an object in the middle of the table hardly changes the image
MAX_CHANGED_SHARE: Final = 0.004
"""If a larger share of the image changes with the rotation, something is on the table: 2 cm in an image of 24 cm."""


def photograph_table(bench: Bench, *, anyway: bool = False) -> Generator[Event, None, EmptyTableImage]:
    """Take the empty-table image and store it beside the bench's state. Yields events and returns the last one.

    An operator that can clear the table does so; otherwise the table must be empty already. The plan takes two frames
    and rotates the table a little between them. If something is on the table, the image changes. The frames are checked
    like those of views. Closing the generator switches the torque off.

    Parameters
    ----------
    bench
        An open bench.
    anyway
        Store the image although something rotates with the table: a pattern, or a screw that stays there.

    Raises
    ------
    TableNotEmpty
        Something rotates with the table, or the surroundings moved. The previous image stays.
    UsageError
        The camera moves around the object, so every view has another background; or the object cannot be removed.
    StateNotStored
        The image cannot be stored.
    ViewRejected, LimitExceeded, MotionTimeout, DeviceFault, DeviceSilent
        See `rig.views.capture` and `rig.motion.turntable`.
    """
    if bench.config.table.carries == "camera":
        raise UsageError(
            "The camera moves around the object, so every view has another background.",
            next_step="Use a plain background. This bench needs no empty-table image.",
        )
    if bench.placer is not None and not bench.placer.clear():
        raise UsageError(
            "The object on this bench cannot be taken away.", next_step="Continue without an empty-table image."
        )
    # Two frames with a rotation between them, if the cable leaves room for it.
    viewer = Viewer(bench.camera, bench.config)
    started_ns = bench.clock.now_ns()
    rotated = None
    with Turntable(bench) as table:
        move = table.hold()
        start_deg = table.rest_deg
        first = yield from capture(0, viewer, table, move.settled_ns)
        target_deg = _rotated_deg(start_deg, table.limits_deg)
        if abs(target_deg - start_deg) >= MIN_ROTATION_DEG:
            move = yield from announced(1, table, target_deg)
            rotated = yield from capture(1, viewer, table, move.settled_ns)
            yield from announced(1, table, start_deg)

    # Compare the two frames: the table must not have changed, the surroundings must not have moved.
    config = bench.config.view
    share = agreement = None
    if rotated is not None:
        frames = [first.image_bgr, rotated.image_bgr]
        share = changed_cells(*(shrunk(frame, config) for frame in frames)) / GRID**2
        before_bgr, after_bgr = (within(frame, config.roi) for frame in frames)
        agreement = hbr.segment(after_bgr, empty_table=hbr.Background(before_bgr)).agreement
        if not anyway:
            _check(share, agreement)

    # A round object does not change with the rotation, but the image differs from the previous one.
    before = empty_table_status(bench)
    if before.table is not None and image_similarity(before.table.image_bgr, first.image_bgr, config) < SAME_SIMILARITY:
        taken_utc = f"{before.table.taken_utc:%Y-%m-%d %H:%M} UTC"
        yield Warned(None, Note(NoteCode.TABLE_DIFFERS, {"taken_utc": taken_utc}))
    evidence = first.evidence
    taken = EmptyTable(
        image_bgr=first.image_bgr,
        taken_utc=bench.clock.utc(),
        camera=bench.camera.identity,
        locks=evidence.locks,
        evidence={**plain(evidence), "turning_share": share, "agreement": agreement},
    )
    store_empty_table(bench, taken)
    done = EmptyTableImage(
        taken_utc=f"{taken.taken_utc:%Y-%m-%dT%H:%M:%SZ}",
        width=int(first.image_bgr.shape[1]),
        height=int(first.image_bgr.shape[0]),
        turning_share=share,
        agreement=agreement,
        evidence=evidence,
        replaced=tuple(problem.as_json() for problem in before.problems),
        seconds=seconds_between(started_ns, bench.clock.now_ns()),
        image_bgr=first.image_bgr,
    )
    yield done
    return done


def _rotated_deg(start_deg: float, limits_deg: tuple[float, float]) -> float:
    """Return the table angle of the second frame: in the direction with more room."""
    low, high = limits_deg
    up_deg, down_deg = min(start_deg + ROTATION_DEG, high), max(start_deg - ROTATION_DEG, low)
    return up_deg if up_deg - start_deg >= start_deg - down_deg else down_deg


def _check(share: float, agreement: float | None) -> None:
    numbers = {"turning_share": round(share, 4), "most_turning_share": MAX_CHANGED_SHARE}
    if agreement is not None and agreement < MIN_AGREEMENT:
        raise TableNotEmpty(
            "The surroundings of the table differ between two images: something moved there, or the table reaches the "
            "border of the image.",
            next_step=("Stand back.", Do.EMPTY_TABLE(), "Choose view.roi with background on all sides."),
            evidence={"agreement": round(agreement, 3), "least_agreement": MIN_AGREEMENT, **numbers},
        )
    if share > MAX_CHANGED_SHARE:
        raise TableNotEmpty(
            f"Something is on the table: {percent(share)} of the image changes as the table rotates.",
            next_step=(
                "Clear the table.",
                Do.EMPTY_TABLE(),
                "If it always stays there, such as a pattern or a screw,",
                Do.EMPTY_TABLE(anyway=True),
            ),
            evidence=numbers,
        )
