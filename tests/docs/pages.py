"""Runs the code blocks of a documentation page."""

import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

DOCS = Path(__file__).parents[2] / "docs"


def blocks(page: str, language: str = "python") -> list[str]:
    """Return the blocks of a language on a page below ``docs/how-to``."""
    return re.findall(
        rf"```{language}\n(.*?)```", (DOCS / "how-to" / f"{page}.md").read_text(encoding="utf-8"), re.DOTALL
    )


def run(code: str, namespace: dict[str, Any] | None = None) -> dict[str, Any]:
    """Execute ``code`` and return its namespace."""
    namespace = {"__name__": "page"} if namespace is None else namespace
    exec(compile(code, "page", "exec", dont_inherit=True), namespace)
    return namespace


def install(folder: Path, modules: Mapping[str, str], pyproject: str) -> Path:
    """Install a package with these modules and the entry points of its ``pyproject`` into a new folder; return it."""
    info = folder / "example_plugin-1.0.dist-info"
    info.mkdir(parents=True)
    for name, code in modules.items():
        (folder / f"{name}.py").write_text(code, encoding="utf-8")
    points = tomllib.loads(pyproject)["project"]["entry-points"]
    lines = [f"[{group}]\n" + "".join(f"{k} = {v}\n" for k, v in rows.items()) for group, rows in points.items()]
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: example-plugin\nVersion: 1.0\n", encoding="utf-8")
    (info / "entry_points.txt").write_text("".join(lines), encoding="utf-8")
    return folder
