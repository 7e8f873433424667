"""The jobs that find the connected devices, and write them into a configuration file; nothing moves."""

from collections.abc import Callable, Generator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, Final

from rig.config import RigConfig, load_config
from rig.config.toml_file import Key, read_text, save, stated, with_values
from rig.config.wording import blank_file
from rig.doctor.device_scan import DeviceScan
from rig.doctor.examination import DoctorContext, run_checks
from rig.doctor.finding import Finding
from rig.jobs.desk import JobResult, Remark, Steps

_PORT: Final = ("servo", "port")


def find(opened: AbstractContextManager[DoctorContext], progress: Callable[[str], None]) -> Steps[None]:
    """Search all ports, buses and cameras, and report the settings of the devices found."""
    findings = []
    with opened as context:
        scan = _scan(context, progress)
        try:
            while True:
                step = next(scan)
                findings += [step.reported] if isinstance(step, Finding) else []
                yield step
        except StopIteration as end:
            wanted: dict[Key, Any] = end.value
    text = f"\nFor rig.toml (`rig setup` writes it):\n\n{with_values('', wanted)}".removesuffix("\n") if wanted else ""
    yield JobResult({"findings": findings, "settings": _by_name(wanted)}, text)


def set_up(path: Path, opened: AbstractContextManager[DoctorContext], progress: Callable[[str], None]) -> Steps[None]:
    """Search the devices, and write those into the file ``path`` that no other one could replace.

    A new file has all keys as comments. An existing one keeps its comments and all other settings.
    """
    there = path.exists()
    stored = load_config(path) if there else RigConfig()
    with opened as context:
        wanted = yield from _scan(context, progress)
        computer, bench = context.computer, context.bench
    is_named = "port" in stored.servo.model_fields_set
    if is_named and _PORT in wanted and computer.same_file(wanted[_PORT], stored.servo.port):
        wanted[_PORT] = stored.servo.port  # keep the configured name
    if ("imu", "address") in wanted:
        wanted["imu", "connection"] = "i2c"
    if computer.simulated:  # the devices in the file are real ones
        wanted = {key: value for key, value in wanted.items() if key[-1] not in _at(stored, key[:-1]).model_fields_set}
        if "--bench" not in context.options:
            yield Remark("These devices are simulated. For the real bench: rig setup --bench hardware")
    wanted["default_bench",] = bench
    changes = {key: value for key, value in wanted.items() if not there or _at(stored, key) != value}
    written = bool(changes) or not there
    if written:
        save(path, with_values(read_text(path) if there else blank_file(RigConfig), changes))
    lines = [f"  {'.'.join(key)} = {stated(key, value)}" for key, value in changes.items()]
    lines += [f"Wrote {path}." if written else f"{path} is unchanged.", ""]
    yield JobResult({"path": path, "written": written, "settings": _by_name(changes)}, "\n".join(lines))


def _scan(context: DoctorContext, progress: Callable[[str], None]) -> Generator[Finding | Remark, None, dict[Key, Any]]:
    """Search all ports, buses and cameras; return the settings of the unambiguous devices."""
    context.require_free()
    scan = DeviceScan()
    yield from run_checks(context, scan.checks, progress)
    several = [what for what, found in scan.candidates.items() if len(found) > 1]
    if several:
        yield Remark(f"Several devices could be the {' or the '.join(several)}; name one in the file.")
    return scan.settings


def _by_name(settings: dict[Key, Any]) -> dict[str, Any]:
    return {".".join(key): value for key, value in settings.items()}


def _at(config: Any, key: Key) -> Any:
    """Return a value of a configuration, or a section of it."""
    for part in key:
        config = getattr(config, part)
    return list(config) if isinstance(config, tuple) else config
