"""The overview of several benches: what their servers answer, and which does not answer."""

import asyncio
import socket
import threading
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest

from rig.config import load_config
from rig.core.errors import ConfigError
from rig.web.access import Role
from rig.web.benches import SERVICE, BenchesInNetwork, OtherBench, OtherBenches
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


def test_bench_that_announces_itself_in_the_network_is_found_until_it_leaves(tmp_path: Path) -> None:
    """On the loopback interface, with real packets."""
    zeroconf = pytest.importorskip("zeroconf", reason="the extra hbr-rig[mdns] is not installed")
    loopback = "127.0.0.1"
    network = BenchesInNetwork([loopback])
    with closing(network), closing(zeroconf.Zeroconf([loopback])) as other, starting(tmp_path) as start:
        served = start().opened()
        with over_http(served) as place:

            def announced(title: str, server: str) -> "zeroconf.ServiceInfo":
                address = socket.inet_aton(loopback)
                port = int(place.rpartition(":")[2])
                return zeroconf.ServiceInfo(SERVICE, f"{title}.{SERVICE}", port, addresses=[address], server=server)

            benches = OtherBenches({"named": "http://127.0.0.1:9"}, network)
            left = announced("Bench on left", "localhost.")
            for info in (left, announced("other name", "elsewhere.local."), announced("evil", "x/y.local.")):
                other.register_service(info, cooperating_responders=True)
            until(lambda: len(network.places()) == 2)

            def overview() -> dict[str, OtherBench]:
                return {one.name: one for one in asyncio.run(benches.overview())}

            until(lambda: all(one.problem != "does not answer" for one in overview().values()))
            found = overview()
            assert list(found) == ["named", "Bench on left", "other name"]
            assert found["Bench on left"].problem is None
            assert found["Bench on left"].status.state == "ready"
            assert found["Bench on left"].address == f"http://localhost:{place.rpartition(':')[2]}/"
            # Its server does not answer to that name; the numeric address was that of the announcement.
            assert found["other name"].problem.startswith("answers 421")
            other.unregister_service(left)
            until(lambda: "Bench on left" not in network.places())


def until(condition: Callable[[], bool]) -> None:
    for _ in range(3000):
        if condition():
            return
        threading.Event().wait(0.01)
    pytest.fail("it does not happen")
