"""Requests that are made from the API's own description: no answer is a server error, and each is as described."""

from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings

from rig.config import load_config
from rig.web.app import create_app
from rig.web.setup import Setup
from tests.browser.conftest import WAIT_S
from tests.rig.web.conftest import connected

schemathesis = pytest.importorskip("schemathesis", reason="Schemathesis is missing: make test-web installs it")

pytestmark = pytest.mark.nightly  # make test-web runs it
ENDLESS = ("/api/v1/events",)
EXAMPLES = 15


@pytest.fixture(scope="module")
def schema(tmp_path_factory: pytest.TempPathFactory):
    """The API's description; no bench runs behind it, so jobs stay in the queue."""
    folder: Path = tmp_path_factory.mktemp("api")
    config = load_config(None, [f"catalog.path={folder}/catalog", f"state_dir={folder}/state"])
    _, server, disconnect = connected(Setup(bench="sim", config=config))
    yield schemathesis.openapi.from_asgi("/api/v1/openapi.json", create_app(server))
    disconnect()


def test_no_request_causes_a_server_error(schema):
    seen = {}
    for found in schema.get_all_operations():
        operation = found.ok()
        if operation.path in ENDLESS:
            continue

        @given(operation.as_strategy())
        @settings(max_examples=EXAMPLES, deadline=None, suppress_health_check=list(HealthCheck), derandomize=True)
        def attack(case):
            answer = case.call(timeout=WAIT_S)
            seen.setdefault(case.operation.label, set()).add(answer.status_code)
            assert answer.status_code < 500 or answer.status_code == 503, (case.as_curl_command(), answer.text)
            if answer.status_code >= 400:
                assert answer.headers["content-type"][0].startswith("application/problem+json"), answer.headers

        attack()
    assert len(seen) > 30
