"""The step that both plans share: take one accepted view at the table's present rest."""

from collections.abc import Generator

from rig.core.errors import ViewRejected
from rig.events.events import Event, Moved, Rejected, Unwinding
from rig.motion.turntable import Move, Turntable
from rig.safety.gyro_rotation import finite
from rig.views.capture import Attempt, Viewer


def moved(index: int, move: Move) -> Moved:
    """Return the event that tells of a finished move."""
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
    """Turn the table to ``target_deg``; that it goes the long way round, unwinding its cable, is said before.

    Where ``asked_deg`` is the same angle, the long way is what was asked for.

    Raises
    ------
    LimitExceeded, MotionTimeout, DeviceFault, DeviceSilent
        See `Turntable.goto`.
    """
    if target_deg != asked_deg and (turns := table.unwound_revolutions(target_deg)):
        yield Unwinding(index, table.rest_deg, target_deg, turns, table.limits_deg)
    return table.goto(target_deg)


def unwind(index: int, table: Turntable) -> Generator[Event, None, None]:
    """Leave the table with the same view before the camera and its cable unwound, whoever comes next."""
    target_deg = table.unwound_deg()
    if table.unwound_revolutions(target_deg):
        yield from announced(index, table, target_deg)


def capture(index: int, viewer: Viewer, table: Turntable, settled_ns: int) -> Generator[Event, None, Attempt]:
    """Yield the rejected frames and return the accepted one.

    Raises
    ------
    ViewRejected
        No frame was acceptable; the evidence is that of the last.
    """
    attempts = viewer.attempts(settled_ns, table.check_still, table.attend)
    for attempt in attempts:
        if attempt.accepted:
            return attempt
        yield Rejected(index, attempt.number, attempt.reasons, attempt.evidence)
    evidence = attempt.evidence
    raise ViewRejected(
        f"View {index} was not acceptable: {'; '.join(attempt.reasons)}.",
        next_step="Look at light, focus and what stands before the camera; view.retakes and the limits are in [view].",
        evidence={
            "sharpness": round(evidence.sharpness, 1),
            "mean_level": round(evidence.mean_level, 1),
            "dark_share": round(evidence.dark_share, 3),
            "saturated_share": round(evidence.saturated_share, 3),
            "peak_rate_dps": finite(evidence.stillness.peak_rate_dps),
            "platter_change_deg": finite(evidence.stillness.platter_change_deg),
        },
    )
