"""Run all checks of a bench, each by itself: what hangs or fails is one more finding."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from queue import Empty, SimpleQueue
from threading import Thread

from rig.core.errors import RigError
from rig.doctor.context import DoctorContext
from rig.doctor.finding import Finding, bad, of_error


@dataclass(frozen=True, slots=True)
class Check:
    """Something to look at.

    ``look`` yields findings as they are made, and now and then what it is about to do, in words; ``deadline_s`` is how
    long after the last of these the next one may take.
    """

    topic: str
    look: Callable[[DoctorContext], Iterator[Finding | str]]
    deadline_s: float = 15.0
    if_it_hangs: str = "Unplug the device, plug it in again, and start over"


def run_checks(
    context: DoctorContext, checks: Iterable[Check], say: Callable[[str], None] = lambda _: None
) -> Iterator[Finding]:
    """Yield what the checks find, in their order; none of them can stop the others.

    ``say`` is called with what is being done, for those who wait, and with nothing before each finding.
    A check runs in a thread of its own, because a driver in the kernel may never return: after the deadline it is left
    to itself, and ends with the program.
    """
    for check in checks:
        told: SimpleQueue[Finding | str | None] = SimpleQueue()
        Thread(target=_run, args=(context, check, told.put), name=check.topic, daemon=True).start()
        while True:
            try:
                item = told.get(timeout=check.deadline_s)
            except Empty:
                say("")
                text = f"the check did not come to an end within {check.deadline_s:g} s and was given up"
                yield bad(check.topic, text, check.if_it_hangs, exit_code=9)
                break
            say(item if isinstance(item, str) else "")
            if item is None:
                break
            if isinstance(item, Finding):
                yield item


def _run(context: DoctorContext, check: Check, tell: Callable[[Finding | str | None], None]) -> None:
    try:
        for item in check.look(context):
            tell(item)
    except RigError as error:
        tell(of_error(check.topic, error))
    except OSError as error:  # a device that was pulled out meanwhile, a file that cannot be read
        tell(bad(check.topic, f"the check broke off: {error}", context.rig("doctor"), error=repr(error)))
    except Exception as error:  # a doctor must not die of what it finds; this is a bug, and is told as one
        text = f"the check itself failed: {type(error).__name__}: {error}"
        tell(bad(check.topic, text, "Report this with the output of `rig doctor --json`", exit_code=1))
    finally:
        with suppress(RuntimeError):  # the interpreter is going down
            tell(None)
