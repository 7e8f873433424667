"""Run the checks of a bench, each in a thread: a check that hangs or fails becomes a finding.

Decision: docs/decisions/0008.
"""

from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from queue import Empty, SimpleQueue
from threading import Thread

from rig.core.errors import RigError
from rig.core.next_steps import Do
from rig.doctor.context import DoctorContext
from rig.doctor.finding import Finding, FindingCode, bad, of_error


@dataclass(frozen=True, slots=True)
class Check:
    """A check of one topic.

    ``run`` yields findings, and texts about its progress; ``deadline_s`` is the longest time between two of them.
    """

    topic: str
    run: Callable[[DoctorContext], Iterator[Finding | str]]
    deadline_s: float = 15.0
    if_it_hangs: str = "Unplug the device, plug it in again, and start over"


def run_checks(
    context: DoctorContext, checks: Iterable[Check], progress: Callable[[str], None] = lambda _: None
) -> Iterator[Finding]:
    """Yield the findings of the checks, in their order; no check can stop the others.

    ``progress`` is called with texts about the progress, and with an empty text before each finding. A check runs in
    its own thread, because a kernel driver may never return: after the deadline the thread is abandoned.
    """
    for check in checks:
        items: SimpleQueue[Finding | str | None] = SimpleQueue()
        Thread(target=_run, args=(context, check, items.put), name=check.topic, daemon=True).start()
        while True:
            try:
                item = items.get(timeout=check.deadline_s)
            except Empty:
                progress("")
                code = FindingCode.CHECK_TIMED_OUT
                yield bad(check.topic, code, check.if_it_hangs, 9, deadline_s=check.deadline_s)
                break
            progress(item if isinstance(item, str) else "")
            if item is None:
                break
            if isinstance(item, Finding):
                steps = (step if isinstance(step, str) else context.step(step) for step in item.steps)
                yield replace(item, steps=tuple(steps))


def _run(context: DoctorContext, check: Check, put: Callable[[Finding | str | None], None]) -> None:
    try:
        for item in check.run(context):
            put(item)
    except RigError as error:
        put(of_error(check.topic, error))
    except OSError as error:  # a device was unplugged, or a file cannot be read
        put(bad(check.topic, FindingCode.CHECK_INTERRUPTED, Do.DOCTOR(), reason=str(error)))
    except Exception as error:  # a bug: report it as one, and continue with the other checks
        fix = Do.REPORT_DEFECT()
        put(bad(check.topic, FindingCode.CHECK_FAILED, fix, 1, error=repr(error)))
    finally:
        with suppress(RuntimeError):  # the interpreter is shutting down
            put(None)
