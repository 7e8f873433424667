"""Old import paths keep working for one version."""

import subprocess
import sys
from importlib import import_module

import pytest

from rig.core.moved import MOVED


@pytest.mark.parametrize("old", sorted(MOVED))
def test_old_path_warns_and_returns_the_same_module(old: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, old, raising=False)
    with pytest.warns(DeprecationWarning, match=f"{old} is now {MOVED[old]}"):
        module = import_module(old)
    assert module is import_module(MOVED[old])
    assert module.__name__ == MOVED[old]
    monkeypatch.delitem(sys.modules, old)


def test_classes_of_an_old_path_are_those_of_the_new_one() -> None:
    program = "from rig.errors import RigError as old; from rig.core.errors import RigError as new; assert old is new"
    subprocess.run([sys.executable, "-W", "ignore::DeprecationWarning", "-c", program], check=True)
