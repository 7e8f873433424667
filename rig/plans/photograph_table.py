"""The plan that takes the empty-table image, or one for each azimuth, and checks that the table is empty."""

from collections.abc import Generator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

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
from rig.plans.estimate import even_azimuths, table_angles
from rig.plans.steps import announced, capture, moved
from rig.views.capture import Attempt, Viewer, ViewEvidence, image_similarity
from rig.views.description import within
from rig.views.empty_table import EmptyTable, empty_table_status, store_empty_table
from rig.views.image_files import MAX_PIXELS
from rig.views.object_presence import GRID, changed_cells, shrunk
from rig.views.table_sheet import TableSheet

ROTATION_DEG: Final = 25.0
"""The table rotates by this angle between two images, so that an object shows another side or moves in the image."""
MIN_ROTATION_DEG: Final = 5.0  # less: an object in the middle of the table hardly changes the image
MAX_CHANGED_SHARE: Final = 0.004
"""If a larger share of the image changes with the rotation, something is on the table: 2 cm in an image of 24 cm."""


@dataclass(frozen=True, eq=False)
class _Taken:
    """The images at even steps from the azimuth 0, with the number and evidence of one, and what the checks found."""

    images: list[NDArray[np.uint8]]
    number: int
    evidence: ViewEvidence
    share: float | None
    agreement: float | None


def photograph_table(
    bench: Bench, *, anyway: bool = False, views: int | None = None
) -> Generator[Event, None, EmptyTableImage]:
    """Take the empty-table images and store them beside the bench's state. Yields events and returns the last one.

    An operator that can clear the table does so; otherwise the table must be empty already. For a turntable the plan
    takes two frames and rotates the table a little between them. If something is on the table, the image changes. If
    the camera moves around the object, the plan takes an image at each azimuth of an enrollment with ``views`` views,
    by default ``enroll.views``. Then each image shows another background, so an object that was forgotten is not
    found. The frames are checked like those of views. Closing the generator switches the torque off.

    ``anyway`` stores the image although something rotates with the table: a pattern, or a screw that stays there.
    ``views`` is the number of images in a revolution of the camera.

    Raises `TableNotEmpty`: something rotates with the table, or the surroundings moved. The previous images stay.
    `UsageError`: the object cannot be removed, or the images together are too large. `StateNotStored`: the images
    cannot be stored. `ViewRejected`, `LimitExceeded`, `MotionTimeout`, `DeviceFault`, `DeviceSilent`: see
    `rig.views.capture` and `rig.motion.turntable`.
    """
    if bench.placer is not None and not bench.placer.clear():
        raise UsageError(
            "The object on this bench cannot be taken away.",
            next_step=(
                "Continue without an empty-table image. If the bench shows photographs, name one:",
                Do.SET_KEY(key="bench.photographs.empty_table", value="FILE"),
            ),
        )
    started_ns = bench.clock.now_ns()
    if bench.config.table.carries == "camera":
        found = yield from _around(bench, views or bench.config.enroll.views, anyway=anyway)
    else:
        found = yield from _two_frames(bench, anyway=anyway)

    # A round object does not change with the rotation, but the image differs from the previous one.
    status, shown_bgr = empty_table_status(bench), found.images[found.number]
    height, width = shown_bgr.shape[:2]
    if (before := status.table) is not None:
        known = TableSheet.of(before.image_bgr, height, width)
        assert known is not None  # it is usable
        same_grid = len(known) == len(found.images)
        if same_grid and image_similarity(known[found.number], shown_bgr, bench.config.view) < SAME_SIMILARITY:
            taken_utc = f"{before.taken_utc:%Y-%m-%d %H:%M} UTC"
            yield Warned(None, Note(NoteCode.TABLE_DIFFERS, {"taken_utc": taken_utc}))
    checks = {"turning_share": found.share, "agreement": found.agreement}
    taken = EmptyTable(
        image_bgr=TableSheet.joined(found.images).image_bgr,
        taken_utc=bench.clock.utc(),
        camera=bench.camera.identity,
        locks=found.evidence.locks,
        evidence={**plain(found.evidence), **checks},
    )
    store_empty_table(bench, taken)
    done = EmptyTableImage(
        taken_utc=f"{taken.taken_utc:%Y-%m-%dT%H:%M:%SZ}",
        width=width,
        height=height,
        images=len(found.images),
        **checks,
        evidence=found.evidence,
        replaced=tuple(problem.as_json() for problem in status.problems),
        seconds=seconds_between(started_ns, bench.clock.now_ns()),
        image_bgr=shown_bgr,
    )
    yield done
    return done


def _two_frames(bench: Bench, *, anyway: bool) -> Generator[Event, None, _Taken]:
    """Take the image of a turntable, and another one after a rotation, if the cable leaves room for it."""
    viewer = Viewer(bench.camera, bench.config)
    rotated = None
    with Turntable(bench) as table:
        move = table.hold()
        start_deg = table.return_deg
        first = yield from capture(0, viewer, table, move.settled_ns)
        target_deg = _rotated_deg(start_deg, table.limits_deg)
        if abs(target_deg - start_deg) >= MIN_ROTATION_DEG:
            move = yield from announced(1, table, target_deg)
            rotated = yield from capture(1, viewer, table, move.settled_ns)
            yield from announced(1, table, start_deg)
            table.approach(start_deg)

    # Compare the two frames: the table must not have changed, the surroundings must not have moved.
    share = agreement = None
    if rotated is not None:
        frames = [first.image_bgr, rotated.image_bgr]
        share = changed_cells(*(shrunk(frame, bench.config.view) for frame in frames)) / GRID**2
        agreement = _agreement(bench, *frames)
        if not anyway:
            _check(share, agreement)
    return _Taken([first.image_bgr], 0, first.evidence, share, agreement)


def _around(bench: Bench, views: int, *, anyway: bool) -> Generator[Event, None, _Taken]:
    """Take an image at each azimuth that the camera reaches, and again the one nearest to the table angle 0."""
    limits_deg, sign = bench.config.table.limits_deg, bench.config.table.orientation_sign
    camera = bench.camera.identity
    if views * (camera.width + 1) * (camera.height + 1) > MAX_PIXELS:
        raise UsageError(
            f"{views} images of {camera.width} x {camera.height} pixels are too large together.",
            next_step=(
                "Use fewer views or smaller frames.",
                Do.SET_KEY(key="enroll.views", value=str(views // 2)),
            ),
        )
    azimuths_deg = even_azimuths(views, limits_deg, sign)
    angles_deg = table_angles(azimuths_deg, limits_deg, sign)
    viewer = Viewer(bench.camera, bench.config)
    taken: list[Attempt] = []
    with Turntable(bench) as table:
        for index, angle_deg in enumerate(angles_deg):
            move = yield from announced(index, table, angle_deg)
            yield moved(index, move)
            taken.append((yield from capture(index, viewer, table, move.settled_ns)))
        front = min(range(len(taken)), key=lambda index: abs(angles_deg[index]))
        move = yield from announced(len(taken), table, angles_deg[front])
        again = yield from capture(len(taken), viewer, table, move.settled_ns)
    agreement = _agreement(bench, taken[front].image_bgr, again.image_bgr)
    if not anyway:
        _check(0.0, agreement)
    numbers = [round(azimuth_deg * views / 360.0) % views for azimuth_deg in azimuths_deg]
    images = [np.zeros_like(again.image_bgr)] * views  # black: not taken
    for number, one in zip(numbers, taken, strict=True):
        images[number] = one.image_bgr
    return _Taken(images, numbers[front], taken[front].evidence, None, agreement)


def _agreement(bench: Bench, before_bgr: NDArray[np.uint8], after_bgr: NDArray[np.uint8]) -> float | None:
    before, after = (within(frame, bench.config.view.roi) for frame in (before_bgr, after_bgr))
    return hbr.segment(after, empty_table=hbr.Background(before)).agreement


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
