"""Changes one key in a configuration file, if the whole configuration stays valid."""

from collections.abc import Iterable
from pathlib import Path

from rig.bench.bench import check_config
from rig.config.toml_file import changed_lines, read_text, save, with_values
from rig.config.values import parsed, read_values
from rig.core.errors import ConfigError
from rig.core.masking import masked
from rig.core.next_steps import Do


def set_key(target: Path, key: str, value: str, overrides: Iterable[str] = ()) -> list[str]:
    """Set a key in a file to a value as in TOML, and return the changed lines; comments and other keys stay.

    Raises `ConfigError`: there is no such key, or the configuration would have mistakes.
    """
    there = target.exists()
    old = read_text(target) if there else ""
    try:
        check_config(read_values(target if there else None, [*overrides, f"{key}={value}"]))
    except ConfigError as error:
        raise ConfigError(
            f"{target} is unchanged: it would have mistakes.",
            next_step=("Give another value. To choose one,", Do.SHOW_CONFIGURATION()),
            evidence=error.evidence,
        ) from error
    new = with_values(old, {tuple(key.split(".")): parsed(value)})
    if new != old:
        save(target, new)
    changed: list[str] = masked(changed_lines(old, new))
    return changed
