"""The controller of a turntable rig: open a bench, enroll objects, identify them."""

# This module imports nothing, so that the program `rig` handles Ctrl+C as early as possible (`rig.cli.start`).
TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

    from rig.bench import Bench, open_bench
    from rig.catalog import Catalog
    from rig.plans.enroll import enroll
    from rig.plans.identify import identify
    from rig.plans.photograph_table import photograph_table
    from rig.search.model import load_model

__all__ = ["Bench", "Catalog", "enroll", "identify", "load_model", "open_bench", "photograph_table"]

_HOMES = {
    "Bench": "rig.bench",
    "Catalog": "rig.catalog",
    "enroll": "rig.plans.enroll",
    "identify": "rig.plans.identify",
    "load_model": "rig.search.model",
    "open_bench": "rig.bench",
    "photograph_table": "rig.plans.photograph_table",
}


def __getattr__(name: str) -> "Any":
    """Import a public name when it is first used: `rig --help` must not load numpy, cv2 and sqlalchemy."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(_HOMES[name]), name)
