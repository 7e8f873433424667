"""Every golden session prints what is stored."""

from pathlib import Path

import pytest

from tests import DIGITS_ARE_THOSE_STORED
from tests.golden.sessions import differences, expected, left, played, sessions


@pytest.fixture(scope="session")
def others(for_all_workers: Path) -> Path:
    """Return the folder of the sessions that others begin from: one worker runs each, for all."""
    folder = for_all_workers / "golden"
    folder.mkdir(exist_ok=True)
    return folder


@pytest.mark.skipif(not DIGITS_ARE_THOSE_STORED, reason="this processor rounds other digits than those stored")
@pytest.mark.timeout(600)  # a session in motion computes half a minute, and several on a busy computer
@pytest.mark.parametrize("name", sessions())
def test_session_prints_what_is_stored(name: str, others: Path, tmp_path: Path) -> None:
    if any("job" in step for step in sessions()[name]["steps"]):
        pytest.importorskip("fastapi", reason="the extra hbr-rig[web] is not installed")
    is_begun_from = any(name in one.get("after", []) for one in sessions().values())
    printed = left(name, others)[1] if is_begun_from else played(name, tmp_path, others)
    found = list(differences(expected(name), printed))
    assert not found, "\n".join(found[:20])
