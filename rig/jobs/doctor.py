"""The job that checks everything that a bench needs."""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from pathlib import Path

from rig.config import RigConfig
from rig.core.errors import ConfigError, RigError
from rig.core.next_steps import Do
from rig.doctor import examination
from rig.doctor.checks import CHECKS
from rig.doctor.context import DoctorContext
from rig.doctor.finding import Finding, FindingCode, Severity, bad, fine, of_error
from rig.jobs.desk import Result, Steps


def check_configuration(
    load: Callable[[], RigConfig], path: Path | None
) -> tuple[RigConfig | None, tuple[Finding, ...]]:
    """Return the configuration, None if it has mistakes, and the findings about it; ``path`` is its file, if any."""
    try:
        config = load()
    except ConfigError as error:
        mistakes = error.evidence.get("mistakes") or [f"{key}: {value}" for key, value in error.evidence.items()]
        what = error.what.rstrip(".")
        return None, tuple(
            bad(
                "config",
                FindingCode.CONFIG_MISTAKE,
                Do.CHECK_CONFIGURATION(),
                error.exit_code,
                what=what,
                mistake=mistake,
            )
            for mistake in mistakes or [error.what]
        )
    return config, (fine("config", FindingCode.CONFIG_VALID if path else FindingCode.CONFIG_MISSING, path=path),)


def examine(
    bench: str,
    opened: AbstractContextManager[DoctorContext],
    *,
    known: Sequence[Finding] = (),
    progress: Callable[[str], None] = lambda _: None,
) -> Steps[None]:
    """Check a bench that is not open, and yield the findings; nothing moves.

    Parameters
    ----------
    bench
        Its name.
    opened
        The bench to check, and its computer.
    known
        The findings about its configuration, which come first.
    progress
        As for `rig.doctor.examination.run_checks`.
    """
    findings = []
    for finding in _findings(opened, known, progress):
        findings.append(finding)
        yield finding
    count = Counter(finding.level for finding in findings)
    problems, warnings = count[Severity.BAD], count[Severity.WARNING]
    values = {
        "bench": bench,
        "bad": problems,
        "warnings": warnings,
        "exit_code": next((finding.exit_code for finding in findings if finding.level is Severity.BAD), 0),
        "findings": [finding.as_dict() for finding in findings],
    }
    yield Result(
        values,
        f"{problems or 'No'} problem{'s' * (problems != 1)}, {warnings or 'no'} warning{'s' * (warnings != 1)}, "
        f"{count[Severity.FINE]} fine.",
    )


def _findings(
    opened: AbstractContextManager[DoctorContext], known: Sequence[Finding], progress: Callable[[str], None]
) -> Iterator[Finding]:
    yield from known
    try:
        with opened as context:
            yield from examination.run_checks(context, CHECKS, progress)
    except RigError as error:  # there is no such bench, or no such part of it
        yield of_error("bench", error)
