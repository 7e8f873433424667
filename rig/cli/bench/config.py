"""Show, check and change the configuration."""

from collections.abc import Iterator, Mapping
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any

import typer
from pydantic import BaseModel

from rig.bench import check_config
from rig.bench.bench import set_key
from rig.calibrations import CalibrationResult, CalibrationStatus, CalibrationStore, apparatus, apply_results
from rig.cli.ui.command import Group
from rig.cli.ui.settings import Settings
from rig.config import RigConfig
from rig.config.values import FILE_NAME, default_path, read_values, search_paths
from rig.config.wording import KeyInfo, key_info, setting_line
from rig.core.clock import SystemClock
from rig.core.errors import ConfigError
from rig.core.masking import masked
from rig.core.next_steps import Do
from rig.core.phrases import counted

app = Group(__doc__)


@app.command("check")
def check(settings: Settings) -> None:
    """Check the whole configuration and list all mistakes. Exit code 3 if there is one.

    Example: rig config check --config rig.toml
    """
    values = read_values(settings.config, settings.overrides)
    config, _ = check_config(values)
    given = sum(values.origin(info.key) != "default" for info in key_info(type(config)))
    where = str(values.path) if values.path else "No file: every key has its default"
    text = f"{where}: no mistakes, {counted(given, 'key')} given."
    settings.say(text, {"path": values.path, "valid": True, "keys_given": given})


@app.command("show")
def show(
    settings: Settings,
    wanted: Annotated[
        list[str] | None, typer.Argument(metavar="[KEY]...", help="Keys or sections (default: all).")
    ] = None,
) -> None:
    """Show every key as TOML: its value, where the value comes from, and a description.

    A value comes from the defaults, a calibration, the file, or --set; each of them overrides those before it. The
    bench is not opened: a calibration counts here if it belongs to its present devices (rig calibrate show).

    Example: rig config show servo table.limits_deg
    """
    values = read_values(settings.config, settings.overrides)
    config, options = check_config(values)
    # A calibration sets only what the file and --set leave at its default, as when the bench is opened.
    in_force = _calibrations_in_force(settings, config)
    applied, _ = apply_results(config, in_force)

    def origin(info: KeyInfo) -> str:
        calibrated = [one.id for one in in_force if info.name in one.settings]
        return values.origin(info.key) if not calibrated or values.origin(info.key) != "default" else calibrated[-1]

    def is_wanted(name: str) -> bool:
        return not wanted or any(name == one or name.startswith(f"{one}.") for one in wanted)

    every = list(_keys(applied, options))
    rows = [
        (info, masked({info.name: value})[info.name], origin(info)) for info, value in every if is_wanted(info.name)
    ]
    if wanted and not rows:
        names = [info.name for info, _ in every]
        near = get_close_matches(wanted[0], [*names, *{name.rpartition(".")[0] for name in names}], n=1)
        step = f"Did you mean {near[0]}?" if near else Do.SHOW_CONFIGURATION()
        raise ConfigError(f"There is no key {wanted[0]!r}.", next_step=step)
    if settings.json:
        about = ("default", "allowed", "unit", "description")
        keys = {
            info.name: {"value": value, "origin": source, **{name: getattr(info, name) for name in about}}
            for info, value, source in rows
        }
        settings.print_json({"path": values.path, "keys": keys})
        return
    # As TOML, so that it can become a file.
    none = f"no file: the defaults. Looked for: {', '.join(map(str, search_paths()))}"
    print(f"# {values.path or none}")
    section = None
    for info, value, source in rows:
        if info.key[:-1] != section:
            section = info.key[:-1]
            print(f"\n[{'.'.join(section)}]" if section else "")
        print(setting_line(info, value, source))


@app.command("set", context_settings={"ignore_unknown_options": True})
def set_(
    settings: Settings,
    key: Annotated[str, typer.Argument(metavar="KEY", help="Key with its section, for example servo.port.")],
    value: Annotated[
        str,
        typer.Argument(metavar="VALUE", help="New value as in TOML; quotes are optional. none clears an optional key."),
    ],
) -> None:
    """Change one key in the file. Comments and all other keys stay as they are.

    Example: rig config set servo.port /dev/ttyUSB1
    """
    target = settings.config or default_path() or Path(FILE_NAME)
    changed = set_key(target, key, value, settings.overrides)
    text = "\n".join([f"{target}:", *changed]) if changed else f"{target}: no change, the key has this value already."
    settings.say(text, {"path": target, "key": key, "changed": changed})


def _calibrations_in_force(settings: Settings, config: RigConfig) -> list[CalibrationResult]:
    """Return the bench's calibrations in force, as far as it is known without opening the bench."""
    name = settings.bench or config.default_bench
    mounted = apparatus(name, {part: {} for part in ("servo", "imu", "camera")}, config, {})
    found = CalibrationStore(config.calibration_path(name)).on_bench(mounted, SystemClock().utc())
    return [one.result for one in found if one.status is CalibrationStatus.IN_FORCE]


def _keys(config: RigConfig, options: Mapping[str, BaseModel]) -> Iterator[tuple[KeyInfo, Any]]:
    """Yield description and value of every key; the options of benches come last."""
    for info in key_info(type(config)):
        if info.key != ("bench",):
            yield info, info.value(config)
    for name, model in options.items():
        for info in key_info(type(model), ("bench", name)):
            yield info, info.value({"bench": options})
