"""The job that checks everything that a bench needs."""

from typing import Any

from rig.config import RigConfig
from rig.core.phrases import counted
from rig.jobs.desk import Remark, Result, Steps


def examine(bench: str, config: RigConfig, *, seed: int | None, options: tuple[str, ...]) -> Steps[None]:
    """Check a bench that this program has closed, with all checks of `rig doctor`; nothing moves.

    Parameters
    ----------
    bench, config, seed
        The bench.
    options
        Options of `rig` that select it.
    """
    from rig.doctor.checks import CHECKS
    from rig.doctor.context import open_context
    from rig.doctor.examination import run_checks

    findings: list[dict[str, Any]] = []
    with open_context(bench, config, seed=seed, options=options) as context:
        context.holder = None  # the holder is this program, which has closed its devices
        for finding in run_checks(context, CHECKS):
            values = finding.as_dict()
            findings.append(values)
            yield Remark(f"{values['topic']}: {values['finding']}", is_warning=False)
    bad = sum(values["level"] == "bad" for values in findings)
    yield Result({"findings": findings}, f"{counted(bad, 'problem') if bad else 'No problems'} found.")
