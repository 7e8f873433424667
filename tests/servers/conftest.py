"""Fixtures of tests on servers."""

from collections.abc import Iterator

import pytest

from tests.servers.postgres import PostgresServer, server


@pytest.fixture(scope="module")
def postgres() -> Iterator[PostgresServer]:
    with server() as running:
        yield running
