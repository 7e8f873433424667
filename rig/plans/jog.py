"""The plan that rotates the table in steps while an operator watches it: `rig jog`."""

from collections.abc import Generator, Iterable
from enum import Enum

from rig.bench import Bench
from rig.core.errors import UsageError
from rig.events.events import Event
from rig.motion.turntable import Turntable
from rig.plans.steps import announced, moved

STEPS_DEG = (0.5, 1.0, 5.0, 15.0, 45.0, 90.0)  # from seeing whether the table moves to a quarter of a revolution


class JogKey(Enum):
    """The operator's keys."""

    FORWARD = "forward"
    BACK = "back"
    LARGER_STEP = "larger-step"
    SMALLER_STEP = "smaller-step"
    HOME = "home"
    END = "end"


def jog(bench: Bench, keys: Iterable[JogKey | None], *, step_deg: float = 5.0) -> Generator[Event | float, None, None]:
    """Rotate the table by one step for each key; yields the event of each rotation, or a new step in degrees.

    A step ends at the table's limits. The torque is on until the plan ends or is closed.

    The operator's ``keys`` are None several times a second while there is no key, so that `rig stop` is noticed.

    Raises `UsageError`: the step is not positive. `FaultLatched`, `Unreferenced`, `MotionStopped`, `Stalled`,
    `MotionTimeout`, `DeviceFault`, `DeviceSilent`: see `Turntable.goto`.
    """
    if not 0 < step_deg <= 360:
        raise UsageError(f"A step of {step_deg:g}° is not possible.", next_step="Give a step above 0° and up to 360°.")
    with Turntable(bench) as table:
        low_deg, high_deg = table.limits_deg
        number = 0
        for key in keys:
            match key:
                case None:
                    bench.safety.check_stop_request()
                    continue
                case JogKey.END:
                    return
                case JogKey.LARGER_STEP | JogKey.SMALLER_STEP:
                    if key is JogKey.LARGER_STEP:
                        step_deg = min((step for step in STEPS_DEG if step > step_deg), default=step_deg)
                    else:
                        step_deg = max((step for step in STEPS_DEG if step < step_deg), default=step_deg)
                    yield step_deg
                    continue
                case JogKey.HOME:
                    target_deg = 0.0
                case _:
                    target_deg = table.rest_deg + (step_deg if key is JogKey.FORWARD else -step_deg)
            target_deg = min(max(target_deg, low_deg), high_deg)
            yield moved(number, (yield from announced(number, table, target_deg, asked_deg=target_deg)))
            number += 1
