"""A bench that is not open, and its checks, each in a thread: one that hangs or fails becomes a finding.

Decision: docs/decisions/0008.
"""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from queue import Empty, SimpleQueue
from threading import Thread
from typing import Any

from rig.bench import bench_kind
from rig.bench.computer import Computer
from rig.config import RigConfig
from rig.config.values import validate
from rig.core.errors import RigError
from rig.core.next_steps import Do, NextStep
from rig.doctor.finding import Finding, Severity, bad, of_error, warning
from rig.safety.saved_state import Holder, busy, holder

EXIT_DEVICE, EXIT_BUSY = 4, 9  # as in `rig.cli.ui.exit_codes`


@dataclass
class DoctorContext:
    """A bench that is not open, and the computer to which its devices are connected."""

    computer: Computer
    config: RigConfig
    bench: str
    options: tuple[str, ...] = ()
    """Options of `rig` that select this bench: ``--bench sim``."""
    file_options: tuple[str, ...] = ()
    """Options of `rig config set` that select this configuration file."""
    holder: Holder | None = None
    """The program that uses the bench now."""
    identities: dict[str, dict[str, Any]] = field(default_factory=dict)
    """The devices that the checks found, for later checks."""

    def step(self, step: NextStep) -> NextStep:
        """Return a step whose command is for this bench."""
        return step.with_options(self.file_options if step.action is Do.SET_KEY else self.options)

    def require_free(self) -> None:
        """Raise `BenchBusy` while another program works with the bench."""
        if self.holder is not None:
            raise busy(self.config.state_path(self.bench), self.holder)


@contextmanager
def open_context(
    bench: str,
    config: RigConfig,
    *,
    seed: int | None = None,
    options: tuple[str, ...] = (),
    file_options: tuple[str, ...] = (),
    is_held: bool = False,
) -> Iterator[DoctorContext]:
    """Yield a bench to check; its computer is this one unless the bench provides another.

    ``is_held`` says that this program holds the bench, and has closed its devices.

    Raises `ConfigError`: there is no such bench, or its options have mistakes.
    """
    kind = bench_kind(bench)
    chosen = validate(kind.options, config.bench.get(bench, {}), where="the configuration", prefix=f"bench.{bench}")
    config = kind.fitted(config, chosen)
    try:
        who = None if is_held else holder(config.state_path(bench))
    except OSError:  # the folder is not readable: the check of the bench's state reports it
        who = None
    with kind.computer(config, chosen, seed) as computer:
        yield DoctorContext(computer, config, bench, options, file_options, who)


@dataclass(frozen=True, slots=True)
class Check:
    """A check of one topic.

    ``run`` yields findings; ``deadline_s`` is the longest time between two of them. Its bad findings have
    ``exit_code``. One that ``opens`` devices is left out while another program uses the bench.
    """

    topic: str
    run: Callable[[DoctorContext], Iterator[Finding]]
    deadline_s: float = 15.0
    exit_code: int = EXIT_DEVICE
    opens: bool = False


def run_checks(
    context: DoctorContext, checks: Iterable[Check], progress: Callable[[str], None] = lambda _: None
) -> Iterator[Finding]:
    """Yield the findings of the checks, in their order; no check can stop the others.

    ``progress`` is called with the topic of the check that runs, and with an empty text before each finding. A check
    runs in its own thread, because a kernel driver may never return: after the deadline the thread is abandoned.
    """
    for check in checks:
        items: SimpleQueue[Finding | None] = SimpleQueue()
        Thread(target=_run, args=(context, check, items.put), name=check.topic, daemon=True).start()
        while True:
            progress(f"{check.topic} ...")
            try:
                item = items.get(timeout=check.deadline_s)
            except Empty:
                text = "the check did not end within {deadline_s:g} s"
                fix = "Unplug the device, plug it in again, and start over"
                late = bad("check_timed_out", text, fix, deadline_s=check.deadline_s)
                item = replace(late, exit_code=EXIT_BUSY)
            progress("")
            if item is None:
                break
            # A finding does not know its check, nor the options that select this bench.
            steps = tuple(step if isinstance(step, str) else context.step(step) for step in item.steps)
            code = item.exit_code or (check.exit_code if item.level is Severity.BAD else 0)
            yield replace(item, steps=steps, topic=item.topic or check.topic, exit_code=code)
            if item.code == "check_timed_out":
                break


def _run(context: DoctorContext, check: Check, put: Callable[[Finding | None], None]) -> None:
    try:
        if check.opens and context.holder is not None:
            put(warning("not_checked", "not checked: the bench is in use", Do.STOP()))
            return
        for item in check.run(context):
            put(item)
    except RigError as error:
        put(of_error(error))
    except OSError as error:  # a device was unplugged, or a file cannot be read
        put(bad("check_interrupted", "the check stopped: {reason}", Do.DOCTOR(), reason=str(error)))
    except Exception as error:  # a bug: report it as one, and continue with the other checks
        failed = bad("check_failed", "the check has an error: {error}", Do.REPORT_DEFECT(), error=repr(error))
        put(replace(failed, exit_code=RigError.code // 100))
    finally:
        with suppress(RuntimeError):  # the interpreter is shutting down
            put(None)
