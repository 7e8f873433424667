"""Runs the code blocks of a documentation page."""

import re
from pathlib import Path
from typing import Any

DOCS = Path(__file__).parents[2] / "docs"


def blocks(page: str) -> list[str]:
    """Return the Python blocks of a page below ``docs/how-to``."""
    return re.findall(r"```python\n(.*?)```", (DOCS / "how-to" / f"{page}.md").read_text(encoding="utf-8"), re.DOTALL)


def run(code: str, namespace: dict[str, Any] | None = None) -> dict[str, Any]:
    """Execute ``code`` and return its namespace."""
    namespace = {"__name__": "page"} if namespace is None else namespace
    exec(compile(code, "page", "exec", dont_inherit=True), namespace)
    return namespace
