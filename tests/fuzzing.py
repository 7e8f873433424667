"""Numbers of cases of property tests: tens by default, thousands in the nightly profile, each with limits."""

import resource
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NoReturn

from hypothesis import HealthCheck, settings

CASES, NIGHTLY_CASES = 12, 20_000


def fuzz_settings(share: float = 1.0) -> settings:
    """Return settings for ``share`` of the cases of the profile in force (`--hypothesis-profile=nightly`: 20,000)."""
    cases = round(share * (NIGHTLY_CASES if _is_nightly() else CASES))
    return settings(
        max_examples=max(cases, 5),
        deadline=None,
        suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
    )


def examples(count: int) -> settings:
    """Return settings for ``count`` cases, and 40 times as many in the nightly profile."""
    return settings(max_examples=count * (40 if _is_nightly() else 1), deadline=None)


def _is_nightly() -> bool:
    return settings.get_current_profile_name() == "nightly"


MAX_MEMORY = 1 << 30
MAX_CPU_S = 10


class LimitExceeded(BaseException):
    """A case takes too long; no code under test handles it."""


@contextmanager
def limited(cpu_s: float = MAX_CPU_S, memory: int = MAX_MEMORY) -> Iterator[None]:
    """Limit the processor time, and the memory that this process may allocate, in a ``with`` block (MemoryError)."""

    def too_long(*_: object) -> NoReturn:
        raise LimitExceeded

    status = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    used = next(int(line.split()[1]) * 1024 for line in status if line.startswith("VmData"))
    before = resource.getrlimit(resource.RLIMIT_DATA)
    handler = signal.signal(signal.SIGPROF, too_long)
    resource.setrlimit(resource.RLIMIT_DATA, (used + memory, before[1]))
    signal.setitimer(signal.ITIMER_PROF, cpu_s)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        resource.setrlimit(resource.RLIMIT_DATA, before)
        signal.signal(signal.SIGPROF, handler)
