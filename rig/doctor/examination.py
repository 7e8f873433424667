"""Run the checks of a bench, each in a thread: a check that hangs or fails becomes a finding.

Decision: docs/decisions/0008.
"""

from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from queue import Empty, SimpleQueue
from threading import Thread

from rig.core.errors import RigError
from rig.doctor.context import DoctorContext
from rig.doctor.finding import Finding, FindingCode, Severity, of_error

EXIT_DEVICE, EXIT_BUSY = 4, 9  # as in `rig.cli.ui.exit_codes`


@dataclass(frozen=True, slots=True)
class Check:
    """A check of one topic.

    ``run`` yields findings, and texts about its progress; ``deadline_s`` is the longest time between two of them. Its
    bad findings have ``exit_code``. One that ``opens`` devices is left out while another program uses the bench.
    """

    topic: str
    run: Callable[[DoctorContext], Iterator[Finding | str]]
    deadline_s: float = 15.0
    exit_code: int = EXIT_DEVICE
    opens: bool = False


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
                late = FindingCode.CHECK_TIMED_OUT(deadline_s=check.deadline_s)
                yield replace(late, topic=check.topic, exit_code=EXIT_BUSY)
                break
            progress(item if isinstance(item, str) else "")
            if item is None:
                break
            if isinstance(item, Finding):
                steps = tuple(step if isinstance(step, str) else context.step(step) for step in item.steps)
                code = item.exit_code or (check.exit_code if item.level is Severity.BAD else 0)
                yield replace(item, steps=steps, topic=item.topic or check.topic, exit_code=code)


def _run(context: DoctorContext, check: Check, put: Callable[[Finding | str | None], None]) -> None:
    try:
        if check.opens and context.holder is not None:
            put(FindingCode.NOT_CHECKED())
            return
        for item in check.run(context):
            put(item)
    except RigError as error:
        put(of_error(error))
    except OSError as error:  # a device was unplugged, or a file cannot be read
        put(FindingCode.CHECK_INTERRUPTED(reason=str(error)))
    except Exception as error:  # a bug: report it as one, and continue with the other checks
        put(replace(FindingCode.CHECK_FAILED(error=repr(error)), exit_code=RigError.code // 100))
    finally:
        with suppress(RuntimeError):  # the interpreter is shutting down
            put(None)
