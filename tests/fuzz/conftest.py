"""One process that runs the commands of a module's tests."""

from collections.abc import Iterator

import pytest

from tests.fuzz.commands import Commands


@pytest.fixture(scope="session")
def commands(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Commands]:
    with Commands(tmp_path_factory.mktemp("fuzz")) as started:
        yield started
