"""The job that checks everything that a bench needs, and the support bundle with what it found."""

import json
import platform
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from importlib.metadata import distributions
from io import BytesIO
from pathlib import Path
from typing import Any
from zipfile import ZIP_DEFLATED, ZipFile

from rig.catalog import Catalog
from rig.config import RigConfig
from rig.core.errors import ConfigError, RigError
from rig.core.json_form import plain
from rig.core.masking import masked
from rig.core.next_steps import Do
from rig.doctor import examination
from rig.doctor.checks import CHECKS
from rig.doctor.examination import DoctorContext
from rig.doctor.finding import Finding, Severity, bad, fine, of_error
from rig.jobs.desk import JobResult, Steps
from rig.safety.saved_state import FileStore


@dataclass(frozen=True, slots=True)
class Examined:
    """What was found on a bench, the number of problems and of warnings, and the exit code of the first problem."""

    bench: str
    bad: int
    warnings: int
    exit_code: int
    findings: list[dict[str, Any]]


def check_configuration(
    load: Callable[[], RigConfig], path: Path | None
) -> tuple[RigConfig | None, tuple[Finding, ...]]:
    """Return the configuration, None if it has mistakes, and the findings about it; ``path`` is its file, if any."""
    try:
        config = load()
    except ConfigError as error:
        mistakes = error.evidence.get("mistakes") or [f"{key}: {value}" for key, value in error.evidence.items()]
        what = error.what.rstrip(".")
        text, fix = "{what}: {mistake}", Do.CHECK_CONFIGURATION()
        found = (bad("config_mistake", text, fix, what=what, mistake=one) for one in mistakes or [error.what])
        return None, tuple(replace(one, topic="config", exit_code=error.exit_code) for one in found)
    code, text = "config_missing", "no rig.toml: the defaults are used (rig setup writes a file)"
    if path:
        code, text = "config_valid", "{path}: no mistakes"
    return config, (replace(fine(code, text, path=path), topic="config"),)


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
    findings = list(known)
    yield from known
    try:
        with opened as context:
            for finding in examination.run_checks(context, CHECKS, progress):
                findings.append(finding)
                yield finding
    except RigError as error:  # there is no such bench, or no such part of it
        findings.append(replace(of_error(error), topic="bench"))
        yield findings[-1]
    count = Counter(finding.level for finding in findings)
    problems, warnings = count[Severity.BAD], count[Severity.WARNING]
    exit_code = next((finding.exit_code for finding in findings if finding.level is Severity.BAD), 0)
    yield JobResult(
        Examined(bench, problems, warnings, exit_code, [finding.reported for finding in findings]),
        f"{problems or 'No'} problem{'s' * (problems != 1)}, {warnings or 'no'} warning{'s' * (warnings != 1)}, "
        f"{count[Severity.FINE]} fine.",
    )


def support_bundle(
    findings: Sequence[dict[str, Any]],
    load: Callable[[], RigConfig],
    file: Path | None,
    bench: str | None,
    open_catalog: Callable[[], Catalog],
    trace: Callable[[], bytes] | None = None,
) -> bytes:
    """Return a ZIP file for a person who helps without seeing the bench: findings, log, configuration and versions.

    ``trace`` records one for it. Passwords and tokens are masked. What cannot be read is left out; the list ``missing``
    in ``versions.json`` has the reason.
    """

    def log() -> bytes:
        with open_catalog() as catalog:
            return _masked_json([plain(entry) | {"time_utc": entry.time_utc.isoformat()} for entry in catalog.log()])

    def state() -> bytes:
        path = load().state_path(bench or load().default_bench)
        return _masked_json(FileStore(path).load().model_dump(mode="json"))

    parts = {
        "configuration.json": lambda: _masked_json(load().model_dump(mode="json")),
        "state.json": state,
        "log.json": log,
    }
    if file is not None:
        parts["rig.toml"] = lambda: str(masked(file.read_text("utf-8"))).encode()
    if trace is not None:
        parts["trace.jsonl"] = trace
    contents: dict[str, bytes] = {"findings.json": _masked_json(plain(findings))}
    missing: list[str] = []
    for name, read in parts.items():
        try:
            contents[name] = read()
        except (RigError, OSError) as error:
            missing.append(f"{name}: {error}")
    versions = {one.metadata["Name"]: one.version for one in distributions()}
    system = {"python": platform.python_version(), "system": platform.platform(), "machine": platform.machine()}
    contents["versions.json"] = _masked_json({**system, "packages": versions, "missing": missing})
    packed = BytesIO()
    with ZipFile(packed, "w", ZIP_DEFLATED) as bundle:
        for name, content in contents.items():
            bundle.writestr(name, content)
    return packed.getvalue()


def _masked_json(value: Any) -> bytes:
    return json.dumps(masked(value), indent=1, default=str).encode()
