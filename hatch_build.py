"""Build hook: the wheel and the editable installation bring compiled kernels, if there is a C compiler."""

import importlib.util
import os
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

LIBRARY = "hbr/kernels/_kernels.so"


class KernelsHook(BuildHookInterface[Any]):
    """Compiles the kernels, and names the machine in the name of the wheel.

    The library needs nothing newer than the C library of manylinux 2014. ``HBR_KERNELS=numpy`` builds a wheel without
    it, for every machine.
    """

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        path = Path(self.root, "hbr", "kernels", "compile.py")
        spec = importlib.util.spec_from_file_location("compile_kernels", path)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        machine = None if os.environ.get("HBR_KERNELS") == "numpy" else module.compile_kernels()
        if machine is None:
            self.app.display_warning("Without a C compiler: NumPy does the work of the kernels.")
        if version == "editable" or machine is None or not machine.endswith("linux-gnu"):
            return
        build_data["artifacts"].append(LIBRARY)
        build_data["pure_python"] = False
        build_data["tag"] = f"py3-none-manylinux_2_17_{machine.partition('-')[0]}"
