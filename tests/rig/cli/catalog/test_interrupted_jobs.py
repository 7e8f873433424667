"""Long jobs of the catalog continue after Ctrl+C."""

import json
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
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


def test_interrupted_redescription_continues(two: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    assert "0 views described, 8 unchanged" in two("catalog", "redescribe").stdout
    with monkeypatch.context() as patch:
        interrupt(patch, "rig.catalog.derived", 1)
        stopped = two("catalog", "redescribe", "--again")
    assert stopped.exit_code == 130
    assert "To continue: rig catalog redescribe --descriptor cedd" in stopped.stderr
    assert "4 views described, 4 unchanged" in two("catalog", "redescribe").stdout
    assert "8 views described" in two("catalog", "redescribe", "--again").stdout


def test_interrupted_fit_continues_to_the_same_rule(two: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    rule = Path("catalog/search_rules.json")
    assert two("catalog", "fit").exit_code == 0
    expected = json.loads(rule.read_text())
    rule.unlink()
    with monkeypatch.context() as patch:
        interrupt(patch, "rig.core.processes", 1)
        stopped = two("catalog", "fit")
    assert stopped.exit_code == 130
    assert "Interrupted; the searches so far are stored. The same command continues." in stopped.stderr
    assert not rule.exists()
    unfinished = Path("catalog/fit.unfinished")
    kept = unfinished.read_text()
    seen = interrupt(monkeypatch, "rig.core.processes", 99)
    assert two("catalog", "fit").exit_code == 0
    assert len(seen) == 1, "the search for the other object"
    for changed in (
        kept.replace("1.0", '"x"'),
        kept.replace("[[[", "[["),
        kept.partition("\n")[0] + '\n["(0, 0.0)", 5]\n',
    ):
        unfinished.write_text(changed)
        assert two("catalog", "fit").exit_code == 0
    assert len(seen) == 7, "both searches again"
    assert {**json.loads(rule.read_text()), "made_utc": None} == {**expected, "made_utc": None}
    assert not list(Path("catalog").glob("*.unfinished*"))
