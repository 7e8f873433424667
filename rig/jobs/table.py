"""The jobs that rotate the table, set its angle, and acknowledge a fault."""

from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum
from typing import Final

from rig.bench import Bench
from rig.catalog import Action
from rig.config import MAX_LIMIT_DEG
from rig.core.errors import RigError, Unreferenced, UsageError
from rig.core.next_steps import Do, SomeSteps
from rig.core.phrases import angle_words, counted, signed
from rig.jobs.desk import Desk, JobResult, Remark, Steps
from rig.motion.turntable import Turntable
from rig.plans.operator import Choice, Question, Subject
from rig.plans.steps import announced, moved
from rig.safety.angle_reference import AngleFinding, SavedAngleCheck
from rig.safety.saved_state import LatchedFault
from rig.safety.supervisor import TableState
from rig.views.charuco_board import CharucoBoard, detect_board, mark_angle_deg

DEVICES: Final = ("imu",)
"""The devices that a rotation needs besides the servo."""
STEPS_DEG: Final = (0.5, 1.0, 5.0, 15.0, 45.0, 90.0)
"""Steps of jog, from seeing whether the table moves to a quarter of a revolution."""


@dataclass(frozen=True, slots=True)
class TableAngle:
    """The angle of the table after it was set."""

    table_deg: float


@dataclass(frozen=True, slots=True)
class Acknowledged:
    """The fault that was acknowledged, if one was latched, and the state of the table since then."""

    acknowledged: LatchedFault | None
    state: TableState
    doubt: str | None


class JogKey(Enum):
    """The operator's keys."""

    FORWARD = "forward"
    BACK = "back"
    LARGER_STEP = "larger-step"
    SMALLER_STEP = "smaller-step"
    HOME = "home"
    END = "end"


def goto(desk: Desk, angle_deg: float) -> Steps[None]:
    """Rotate the table to an angle, and write the rotation into the log of the catalog."""
    if not abs(angle_deg) <= MAX_LIMIT_DEG:  # also true for nan
        raise UsageError(f"{angle_deg:g} is not an angle of the table.", next_step="Give the angle in degrees.")
    with desk.open_bench(DEVICES) as bench:
        yield from _rotated(desk, bench, angle_deg)


def home(desk: Desk, *, revolutions: int | None = None) -> Steps[bool]:
    """Rotate the table to home, after ``revolutions`` were set as by `refer`; return whether it may.

    If the angle is in doubt and the home mark is calibrated, the camera sees the angle within the revolution, and the
    operator is asked for the revolution only. The operator is also asked before a rotation by more than half a
    revolution that follows from ``revolutions``.
    """
    with desk.open_bench(DEVICES) as bench:
        safety, seen_deg, subject = bench.safety, None, Subject.LONG_WAY
        # The angle: by the home mark if it is in doubt, otherwise by the encoder.
        if safety.doubt and bench.config.mark.card[0]:
            seen_deg = _seen_deg(bench, safety.doubt, required=revolutions is None)
            if seen_deg is not None and revolutions is None:
                subject, revolutions = Subject.REVOLUTION, round((_last_deg(bench, safety.doubt) - seen_deg) / 360.0)
        # The revolution: only the operator sees the cable.
        if revolutions is not None:
            if seen_deg is not None:
                angle_deg = seen_deg + 360.0 * revolutions
            else:
                position_deg = bench.servo.read_state().position_deg
                angle_deg = safety.angle_reference.with_revolutions(position_deg, revolutions)
            text = f"The table is then at {angle_words(angle_deg, 0)} and rotates by {signed(-angle_deg, 0)}° to home."
            otherwise: SomeSteps = ()
            if subject is Subject.REVOLUTION:
                otherwise = "Otherwise leave it, and give its revolutions:", Do.SET_REVOLUTIONS(revolutions=0)
                text = f"Look at the cable. Is it wound up by {counted(revolutions, 'revolution')}? {text}"
            choices = {Choice.CONTINUE: "rotate", Choice.STOP: "leave it"}
            question = Question(subject, text, choices, default=Choice.STOP, steps=otherwise)
            asks = subject is Subject.REVOLUTION or abs(angle_deg) > 180.0
            if asks and not safety.beyond_limits(angle_deg) and desk.operator.choose(question) is Choice.STOP:
                return False
            if seen_deg is None:
                safety.set_revolutions(revolutions)
            else:
                safety.set_angle(angle_deg)
        yield from _rotated(desk, bench, 0.0)
    return True


def _seen_deg(bench: Bench, doubt: SavedAngleCheck, *, required: bool) -> float | None:
    """Return the table's angle within a revolution by the home mark; None if that is not seen and not required."""
    image_bgr = bench.camera.capture(bench.clock.now_ns()).image_bgr
    angle_deg = mark_angle_deg(detect_board(CharucoBoard(*bench.config.mark.card), image_bgr), bench.config.mark)
    if angle_deg is None and required:
        raise Unreferenced(
            f"The table's angle is in doubt: {doubt}. The camera does not see the home mark at its place.",
            next_step=(
                "Rotate the table by hand, with the servo's supply on, until the card faces the camera.",
                Do.RUN_AGAIN(),
                "Or look at the cable. If it hangs free,",
                Do.SET_REVOLUTIONS(revolutions=0),
                "If the card or the camera was moved, calibrate the mark again afterwards.",
            ),
        )
    return angle_deg


def _last_deg(bench: Bench, doubt: SavedAngleCheck) -> float:
    """Return the last known angle of the table, from which the cable is probably not far; 0 if there is none."""
    unknown = AngleFinding.NEVER_REFERENCED, AngleFinding.OTHER_SERVO, AngleFinding.SETTINGS_CHANGED
    return 0.0 if doubt.finding in unknown else bench.safety.angle_reference.to_table(doubt.saved_position_deg)


def _rotated(desk: Desk, bench: Bench, angle_deg: float) -> Steps[None]:
    try:
        with Turntable(bench) as table:
            yield moved(0, (yield from announced(0, table, angle_deg)))
    except RigError as error:
        yield from desk.log(Action.MOVED, to_deg=angle_deg, ended=error.what)
        raise
    yield from desk.log(Action.MOVED, to_deg=angle_deg)


def jog(desk: Desk, keys: Iterable[JogKey | None], *, step_deg: float = 5.0) -> Steps[None]:
    """Rotate the table by one step for each key, within its limits; the log of the catalog gets the last angle.

    The torque is on until the job ends. The operator's ``keys`` are None several times a second while there is no key,
    so that `rig stop` is noticed.

    Raises `UsageError`: the step is not positive. Other errors are those of `Turntable.goto`.
    """
    if not 0 < step_deg <= 360:
        raise UsageError(f"A step of {step_deg:g}° is not possible.", next_step="Give a step above 0° and up to 360°.")
    angle_deg = None
    with desk.open_bench(DEVICES) as bench:
        try:
            with Turntable(bench) as table:
                number, target_deg = 0, table.rest_deg
                for key in keys:
                    match key:
                        case None:
                            bench.safety.check_stop_request()
                            continue
                        case JogKey.END:
                            break
                        case JogKey.LARGER_STEP:
                            step_deg = min((step for step in STEPS_DEG if step > step_deg), default=step_deg)
                            yield Remark(f"step {step_deg:g}°", is_warning=False)
                            continue
                        case JogKey.SMALLER_STEP:
                            step_deg = max((step for step in STEPS_DEG if step < step_deg), default=step_deg)
                            yield Remark(f"step {step_deg:g}°", is_warning=False)
                            continue
                        case JogKey.HOME:
                            target_deg = 0.0
                        case _:
                            # From the last target: friction holds the table short of it; steps must not add that up.
                            target_deg += step_deg if key is JogKey.FORWARD else -step_deg
                    low_deg, high_deg = table.limits_deg
                    target_deg = min(max(target_deg, low_deg), high_deg)
                    event = moved(number, (yield from announced(number, table, target_deg, asked_deg=target_deg)))
                    yield event
                    number += 1
                    angle_deg = event.encoder_deg
        except RigError as error:
            yield from desk.log(Action.MOVED, to_deg=angle_deg, ended=error.what)
            raise
    if angle_deg is not None:
        yield from desk.log(Action.MOVED, to_deg=angle_deg)


def refer(desk: Desk, *, revolutions: int | None = None, here: bool = False) -> Steps[None]:
    """Set the table's angle after the operator has looked at the cable; nothing moves.

    Either ``here`` makes the present angle home, or ``revolutions`` is how many the cable is wound up.
    """
    if here == (revolutions is not None):
        raise UsageError("revolutions and here are both given, or both missing.", next_step="Give one of them.")
    with desk.open_bench(DEVICES) as bench:
        if revolutions is None:
            bench.safety.set_angle(0.0)
        else:
            bench.safety.set_revolutions(revolutions)
        table_deg = bench.safety.angle_reference.to_table(bench.servo.read_state().position_deg)
    text = "The present angle is home now." if here else "The table's angle is set."
    yield JobResult(TableAngle(0.0 if here else table_deg), text)


def acknowledge(desk: Desk, *, reboot: bool = False) -> Steps[None]:
    """Acknowledge the latched fault; ``reboot`` restarts the servo first, which clears its hardware errors."""
    with desk.open_bench(DEVICES) as bench:
        fault = bench.safety.fault
        state, doubt = bench.safety.acknowledge(reboot=reboot), bench.safety.doubt
    text = f"Acknowledged: {fault.detail}" if fault else "No fault was latched."
    values = Acknowledged(fault, state, str(doubt) if doubt else None)
    yield JobResult(values, f"{text}\nThe table is {state}{f': {doubt}' if doubt else ''}.")
