"""Old import paths of public modules: they work for one version, with a `DeprecationWarning`."""

import sys
from collections.abc import Sequence
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Final
from warnings import warn

MOVED: Final = {
    "rig.clock": "rig.core.clock",
    "rig.errors": "rig.core.errors",
    "rig.hardware": "rig.bench.hardware",
    "rig.plans.events": "rig.events.events",
    "rig.plans.model": "rig.search.model",
    "rig.plans.rules": "rig.search.stopping_rules",
    "rig.plans.strategies": "rig.search.strategies",
    "rig.presence": "rig.views.object_presence",
    "rig.stop": "rig.motion.stop_request",
    "rig.turntable": "rig.motion.turntable",
    "rig.view": "rig.views.capture",
}
"""Modules in the documentation of version 0.1, and their present names."""


class _MovedModules(MetaPathFinder, Loader):
    def find_spec(
        self,
        fullname: str,
        path: Sequence[str] | None,  # noqa: ARG002
        target: ModuleType | None = None,  # noqa: ARG002
    ) -> ModuleSpec | None:
        return ModuleSpec(fullname, self) if fullname in MOVED else None

    def exec_module(self, module: ModuleType) -> None:
        """Replace the empty module, which the import system created, by the new one."""
        new = MOVED[module.__name__]
        warn(f"{module.__name__} is now {new}; version 0.3 removes the old path", DeprecationWarning, stacklevel=2)
        sys.modules[module.__name__] = import_module(new)


def keep_old_paths() -> None:
    """Make the old paths importable."""
    sys.meta_path.append(_MovedModules())
