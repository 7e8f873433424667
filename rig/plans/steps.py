"""The steps that the plans share: rotate, capture an accepted view, warn of a changed bench."""

from collections.abc import Collection, Generator, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hbr.core.angles import wrap180
from rig.bench import Bench
from rig.core.errors import CameraSettingsDiffer, NoObject, ViewRejected
from rig.core.next_steps import Do, SomeSteps
from rig.events.events import Accepted, Event, Moved, Note, NoteCode, Rejected, Unwinding, Warned
from rig.motion.move import Move
from rig.motion.turntable import Turntable
from rig.safety.gyro_rotation import finite
from rig.views.capture import Attempt, RejectReason, Viewer, rejection_text
from rig.views.description import DescribedView
from rig.views.empty_table import store_table_problem
from rig.views.object_presence import LEAST_ROTATION_DEG, is_empty_table, probability_of_nothing
from rig.views.table_sheet import table_image


def moved(index: int, move: Move) -> Moved:
    """Return the event of a finished move."""
    gyro = move.gyro
    return Moved(
        index=index,
        commanded_deg=move.commanded_deg,
        encoder_deg=move.encoder_deg,
        rotation_encoder_deg=move.rotation_encoder_deg,
        rotation_imu_deg=gyro.angle_deg if gyro.valid else None,
        imu_sigma_deg=gyro.sigma_deg if gyro.valid else None,
        bound_deg=move.agreement.bound_deg if move.agreement else None,
        agrees=move.agrees,
        seconds=move.seconds,
    )


def announced(
    index: int, table: Turntable, target_deg: float, *, asked_deg: float | None = None
) -> Generator[Event, None, Move]:
    """Rotate the table to ``target_deg``. Yield an event first if it unwinds the cable by whole revolutions.

    No event is yielded if ``asked_deg`` is the same angle, because the long way was asked for.

    Raises `LimitExceeded`, `MotionTimeout`, `DeviceFault`, `DeviceSilent`: see `Turntable.goto`.
    """
    if target_deg != asked_deg and (rotations := table.unwound_revolutions(target_deg)):
        yield Unwinding(index, table.rest_deg, target_deg, rotations, table.limits_deg)
    return table.goto(target_deg)


def check_camera(bench: Bench, settings: Collection[Mapping[str, Any]]) -> None:
    """Check that the camera has one of these settings (`rig.devices.camera.CameraLocks`), which earlier views had."""
    now = asdict(bench.camera.read_locks())
    differing = [
        {key: value for key, value in before.items() if None not in (value, now.get(key)) and value != now[key]}
        for before in settings
    ]
    if not differing or not all(differing):
        return
    nearest = min(differing, key=len)
    keys = type(bench.config.camera).model_fields
    changes = [Do.SET_KEY(key=f"camera.{key}", value=f"{value:g}") for key, value in nearest.items() if key in keys]
    raise CameraSettingsDiffer(
        "The camera has other settings than at the enrollment.",
        next_step=(*(changes or ("Lock the camera.",)), "Otherwise,", Do.ENROLL_AGAIN()),
        evidence={key: f"{now[key]} now, {value} at the enrollment" for key, value in nearest.items()},
    )


@dataclass(eq=False)
class ObjectCheck:
    """Checks that an object is on the table; called with the views of one search or enrollment.

    The first view must show more than the empty table; without an empty-table image for it, more than one colour. Then
    it is also compared, once, with the first view that is `LEAST_ROTATION_DEG` away: something must rotate with the
    table, or look like an object.

    ``empty_table`` is a sheet (`rig.views.table_sheet`).
    """

    bench: Bench
    empty_table: NDArray[np.uint8] | None
    _first: tuple[NDArray[np.uint8], float] | None = field(default=None, init=False)
    _is_done: bool = field(default=False, init=False)

    def __call__(self, image_bgr: NDArray[np.uint8], azimuth_deg: float) -> None:
        """Check the next view. Raises `NoObject`: no object is on the table."""
        if self._is_done:
            return
        config = self.bench.config.view
        if self._first is None:
            self._first = image_bgr, azimuth_deg
            table_bgr = table_image(self.empty_table, image_bgr, azimuth_deg)
            if is_empty_table(image_bgr, table_bgr, config):
                raise _no_object("nothing in the image differs from the background")
            self._is_done = table_bgr is not None  # the image has decided, also for what the network does not know
            return
        first_bgr, first_deg = self._first
        rotated_deg = abs(wrap180(azimuth_deg - first_deg))
        if rotated_deg < LEAST_ROTATION_DEG:
            return
        self._is_done = True
        probability = probability_of_nothing(first_bgr, image_bgr, config)
        if probability is not None:
            raise _no_object(
                "nothing in the image rotates with the table, or looks like an object",
                {"rotated_deg": round(rotated_deg, 1), "highest_probability": round(probability, 4)},
            )


def _no_object(reason: str, evidence: Mapping[str, float] | None = None) -> NoObject:
    return NoObject(
        f"No object is on the table: {reason}.",
        next_step=(
            "Put the object on the table, where the camera sees it, and repeat. If it is there already, take it off, "
            "and",
            Do.EMPTY_TABLE(),
        ),
        evidence=evidence,
    )


def warn_of_table(bench: Bench, index: int, view: DescribedView) -> Generator[Event, None, None]:
    """Store and report that the bench no longer looks like its empty-table image, if this view has shown it."""
    if view.table_problem is not None:
        store_table_problem(bench, view.table_problem.parameters["agreement"])
        yield Warned(index, Note(NoteCode.EMPTY_TABLE_CHANGED, {"problem": view.table_problem.as_json()}))


def accepted(index: int, azimuth_deg: float, attempt: Attempt, described: DescribedView) -> Accepted:
    """Return the event of an accepted view."""
    return Accepted(
        index, azimuth_deg, attempt.evidence, attempt.image_bgr, described.segmentation, described.other_bench
    )


def capture(index: int, viewer: Viewer, table: Turntable, settled_ns: int) -> Generator[Event, None, Attempt]:
    """Yield an event for each rejected frame and return the accepted frame.

    Raises `ViewRejected`: all frames were rejected. The evidence is that of the last one.
    """
    attempts = viewer.attempts(settled_ns, table.check_still, table.collect_gyro)
    for attempt in attempts:
        if attempt.accepted:
            return attempt
        yield Rejected(index, attempt.number, attempt.reasons, attempt.evidence)
    evidence = attempt.evidence
    assert evidence.stillness is not None
    texts = "; ".join(rejection_text(reason, evidence) for reason in attempt.reasons)
    next_step: SomeSteps = "Check the light, the focus and the scene. The limits and view.retakes are in [view]."
    if RejectReason.LOCKS_CHANGED in attempt.reasons:
        next_step = ("Lock the camera: set camera.exposure_us and camera.white_balance_k to numbers.", Do.DOCTOR())
    elif attempt.reasons == (RejectReason.REPEATED_FRAME,):
        next_step = "Reconnect the camera. If it happens again, use another USB port, without a hub."
    raise ViewRejected(
        f"View {index + 1} was rejected: {texts}.",
        next_step=next_step,
        evidence={
            "reasons": [reason.value for reason in attempt.reasons],
            "sharpness": round(evidence.sharpness, 1),
            "mean_level": round(evidence.mean_level, 1),
            "dark_share": round(evidence.dark_share, 3),
            "saturated_share": round(evidence.saturated_share, 3),
            "peak_rate_dps": finite(evidence.stillness.peak_rate_dps),
            "platter_change_deg": finite(evidence.stillness.platter_change_deg),
        },
    )
