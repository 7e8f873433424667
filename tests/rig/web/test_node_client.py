"""A program in another language, written from the OpenAPI document alone, uses a server over HTTP."""

import json
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from rig.web.access import Role
from tests.rig.web.conftest import Served, over_http

NODE = shutil.which("node")


@pytest.mark.skipif(NODE is None, reason="node is missing: apt-get install nodejs")
def test_client_in_another_language_enrolls_identifies_stops_and_understands_an_error(
    serve: Callable[..., Served],
) -> None:
    assert NODE is not None
    served = serve("bench.sim.object='mug-white'", needs_login=True).opened()
    token = served.server.sessions.tokens.new("cell", Role.OPERATE)
    with over_http(served) as place:
        client = [NODE, str(Path(__file__).with_name("client.mjs")), f"http://{place}", token]
        done = subprocess.run(client, capture_output=True, text=True, timeout=100, check=False)
    assert done.returncode == 0, done.stderr
    seen = json.loads(done.stdout)
    assert seen["name"] == "mug-white"
    assert {"started", "accepted", "enrolled", "identified", "recorded"} <= set(seen["kinds"])
    assert (seen["result"]["object"], seen["result"]["sample"], seen["result"]["operator"]) == (
        "mug-white",
        "S-1",
        "cell",
    )
    assert seen["image"] == ["image/jpeg", 0xFF, 0xD8]
    assert len(set(seen["again"])) == 1
    assert seen["ended"]
    assert seen["cancelled"] == "cancelled"
    limits_deg = list(served.server.setup.config.table.limits_deg)
    assert seen["problem"] == [409, "application/problem+json", 500, limits_deg]
    assert seen["explained"]
