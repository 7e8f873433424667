"""Long jobs of the catalog continue after Ctrl+C."""

from collections.abc import Callable, Iterable, Iterator
from typing import Any

import pytest
from click.testing import Result

Rig = Callable[..., Result]


def interrupt(monkeypatch: pytest.MonkeyPatch, module: str, after: int) -> list[object]:
    """Let Ctrl+C interrupt the long job of a module after so many portions or tasks; return what it works on then."""
    seen: list[object] = []

    def interrupted(work: Callable[[Any], Any], items: Iterable[Any], jobs: object) -> Iterator[tuple[Any, Any]]:
        for item in items:
            if len(seen) == after:
                raise KeyboardInterrupt
            seen.append(item)
            yield item, work(item)

    monkeypatch.setattr(f"{module}.map_in_processes", interrupted)
    return seen


def test_interrupted_check_changes_nothing(two: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    interrupt(monkeypatch, "rig.catalog.verify", 0)
    stopped = two("catalog", "verify")
    assert stopped.exit_code == 130
    assert "Interrupted; nothing was changed." in stopped.stderr
    assert "torque" not in stopped.stderr
