"""The overview of several benches: what their servers answer, and which does not answer."""

import socket
from pathlib import Path

import pytest

from rig.config import load_config
from rig.core.errors import ConfigError
from rig.web.access import Role
from tests.rig.web.conftest import Served, over_http, starting

SECRET = "rig_never-stored"


def test_overview_shows_state_and_last_answer_and_which_bench_does_not_answer(tmp_path: Path) -> None:
    with (
        starting(tmp_path / "left") as serve_left,
        starting(tmp_path / "here") as serve_here,
        socket.create_server(("127.0.0.1", 0)) as silent,
    ):
        right = f"serve.benches.right='http://token:{SECRET}@127.0.0.1:9'"
        left = serve_left("bench.sim.object='mug-white'", right, needs_login=True).opened()
        token = left.server.sessions.tokens.new("overview", Role.WATCH)
        left.client.headers["Authorization"] = f"Bearer {left.server.sessions.tokens.new('cell', Role.OPERATE)}"
        left.run(kind="enroll", name="mug-white", views=4)
        left.run(kind="identify")
        with over_http(left) as place:
            addresses = {
                "left": f"http://token:{token}@{place}",
                "locked": f"http://{place}/",
                "silent": f"http://127.0.0.1:{silent.getsockname()[1]}",
                "off": "http://127.0.0.1:9",
            }
            here = serve_here(*(f"serve.benches.{name}='{address}'" for name, address in addresses.items()))
            answer = here.client.get("/api/v1/benches")
            configuration = here.client.get("/api/v1/configuration").text
            page = here.client.get("/benches").text
    found = {one["name"]: one for one in answer.json()["items"]}
    assert list(found) == list(addresses)
    assert found["left"]["status"]["state"] == "ready"
    assert (found["left"]["problem"], found["left"]["job"]) == (None, None)
    assert found["left"]["answer"].startswith("mug-white")
    assert found["left"]["answered_utc"]
    assert found["locked"]["problem"] == "answers 401: This request needs a login."
    for name in ("silent", "off"):
        assert found[name]["problem"].startswith("does not answer")
        assert found[name]["status"] is None
    assert token not in answer.text + configuration
    assert list(tmp_path.rglob("run.json"))
    assert not any(SECRET.encode() in path.read_bytes() for path in tmp_path.rglob("*") if path.is_file())
    assert '<a href="/benches" aria-current="page">Benches</a>' in page


def test_page_of_benches_is_there_only_if_there_are_some(served: Served) -> None:
    assert "/benches" not in served.client.get("/").text
    assert served.client.get("/api/v1/benches").json()["items"] == []


@pytest.mark.parametrize("address", ["left.local:8420", "ftp://left", "http://", "http://left:port", "http://left/x"])
def test_address_of_a_bench_is_checked(address: str) -> None:
    with pytest.raises(ConfigError) as error:
        load_config(None, [f"serve.benches.left='{address}'"])
    (mistake,) = error.value.evidence["mistakes"]
    assert "left needs an address such as http://left.local:8420" in mistake
