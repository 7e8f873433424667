"""The folder of a simulated bench: which program runs it, its configuration, and the names of its ports."""

import shutil
from contextlib import ExitStack
from itertools import count
from pathlib import Path
from typing import Any

from rig.bench import check_config
from rig.cli.ui.settings import Settings
from rig.config import RigConfig
from rig.config.toml_file import Key, loads, read_text, save, with_values
from rig.config.values import default_path, parsed, read_values
from rig.config.wording import blank_file
from rig.core.clock import SystemClock
from rig.core.errors import BenchBusy, UsageError, os_errors_as
from rig.core.next_steps import Do
from rig.safety.saved_state import BenchLock, holder
from sim.bench import SimOptions
from sim.realtime.wire import COMPUTER, CONFIG, DEFAULT_FOLDER, HEAD, SERVO, SOCKET, STATE

LOCK = "lock"


def reserve(folder: Path | None, ends: ExitStack) -> Path:
    """Create a folder, reserve it for this program until ``ends``, and remove files that a killed program left there.

    Without a ``folder`` it is `DEFAULT_FOLDER`, or the first of those with a number that no program uses.

    Raises `BenchBusy`: another program runs the bench in this folder. `UsageError`: the folder cannot be written, or
    holds other files.
    """
    if folder is None:
        names = (DEFAULT_FOLDER.with_name(f"{DEFAULT_FOLDER}-{n}") for n in count(2))
        folder = DEFAULT_FOLDER
        while holder(folder) is not None:
            folder = next(names)
    folder = folder.absolute()
    step = Do.SIM_BENCH(folder="FOLDER")
    with os_errors_as(UsageError, f"The folder {folder} cannot be written.", next_step=step):
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        there = {path.name for path in folder.iterdir()} - {LOCK}
    if there and not _is_ours(folder / CONFIG):
        raise UsageError(f"The folder {folder} has other files than those of a simulated bench.", next_step=step)
    try:
        ends.callback(BenchLock(folder, SystemClock()).close)
    except BenchBusy as busy:
        who = holder(folder)
        raise BenchBusy(
            f"The simulated bench in {folder} is running already{f', in process {who.pid}' if who else ''}.",
            next_step=("Use it, or", Do.END_SIM_BENCH(folder=str(folder)), "A second bench needs its own folder."),
            evidence=busy.evidence,
        ) from busy
    _clean(folder)
    ends.callback(_clean, folder)
    return folder


def configure(folder: Path, settings: Settings) -> tuple[RigConfig, SimOptions]:
    """Write the folder's rig.toml, with which other programs use the bench; return the configuration in it.

    Its settings are those of the file there, else those of the configuration in force. ``--config`` and ``--set`` of
    the command line replace them.

    Raises `ConfigError`: the configuration has mistakes.
    """
    path = folder / CONFIG
    source = settings.config or (path if path.exists() else default_path())
    changes: dict[Key, Any] = {}
    for override in settings.overrides:
        key, _, value = override.partition("=")
        changes[tuple(key.strip().split("."))] = parsed(value)
    changes |= {
        ("default_bench",): "sim-bench",
        ("state_dir",): str(folder / STATE),
        ("calibration_dir",): str(folder / "calibration"),
        ("catalog", "path"): str(folder / "catalog"),
        ("servo", "port"): str(folder / SERVO),
        ("head", "port"): str(folder / HEAD),
        ("bench", "sim-bench", "folder"): str(folder),
    }
    text = with_values(read_text(source) if source else blank_file(RigConfig), changes)
    save(path, text)
    config, kinds = check_config(read_values(path))
    chosen = kinds["sim"]
    assert isinstance(chosen, SimOptions)
    return config, chosen


def _is_ours(path: Path) -> bool:
    try:
        return "sim-bench" in loads(read_text(path)).get("bench", {})
    except Exception:
        return False


def _clean(folder: Path) -> None:
    """Remove the names of ports, the socket, and the files of the simulated computer."""
    for name in (SERVO, HEAD, SOCKET):
        if (folder / name).is_symlink() or (folder / name).is_socket():
            (folder / name).unlink()
    shutil.rmtree(folder / COMPUTER, ignore_errors=True)
