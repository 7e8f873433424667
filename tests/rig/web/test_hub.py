"""The hub sends every message once and in order to listeners that keep up, and says when messages are lost."""

import asyncio
from http.client import HTTPConnection

from hypothesis import given
from hypothesis import strategies as st

from rig.web.hub import Hub
from tests.fuzzing import examples
from tests.rig.web.conftest import over_http


@examples(20)
@given(st.integers(1, 30), st.lists(st.integers(0, 12), max_size=12))
def test_listener_gets_each_message_once_or_learns_that_some_are_lost(capacity, bursts):
    hub = Hub("e", capacity)
    number, _ = hub.position(None)
    sent = 0
    for burst in bursts:
        expected = []
        for _ in range(burst):
            sent += 1
            hub.publish("plan", sent)
            expected.append(str(sent))
        messages, lost = hub.since(number)
        assert [one.data for one in messages] == expected[-capacity:]
        assert lost == (burst > capacity)
        number = messages[-1].number if messages else number


@examples(20)
@given(st.text(max_size=20))
def test_any_last_event_id_gives_a_position(text):
    hub = Hub("epoch")
    hub.publish("plan", 1)
    number, lost = hub.position(text)
    assert number in (0, 1)
    assert lost or text in ("", "epoch-0", "epoch-1") or text.startswith("epoch-0")


def test_stream_resumes_after_the_last_event_id_and_says_hello_first():
    async def listen() -> list[str]:
        hub = Hub("e")
        for k in range(5):
            hub.publish("plan", k)
        stream = hub.stream("e-2")
        got = [await anext(stream) for _ in range(4)]
        assert hub.listeners == 1
        waiting = asyncio.ensure_future(anext(stream))
        await asyncio.sleep(0)
        hub.publish("plan", "late")
        got.append(await waiting)
        await stream.aclose()
        assert hub.listeners == 0
        return got

    got = asyncio.run(listen())
    assert got[0] == 'id: e-2\nevent: hello\ndata: {"lost": false}\n\n'
    assert [one.splitlines()[0] for one in got[1:]] == ["id: e-3", "id: e-4", "id: e-5", "id: e-6"]


def test_listener_whose_connection_was_lost_names_its_last_event(serve):
    served = serve()
    last = served.server.hub.of_job("")[1]
    served.run(kind="home")
    with over_http(served) as place:
        connection = HTTPConnection(place, timeout=10)
        connection.request("GET", "/api/v1/events", headers={"Last-Event-ID": last})
        assert connection.getresponse().readline() == f"id: {last}\n".encode()
        connection.close()


def test_message_stays_in_its_line():
    async def first() -> str:
        hub = Hub("e")
        hub.publish("plan", {"text": "a\nevent: stop\r\ndata: x\u2028"})
        stream = hub.stream("e-0")
        await anext(stream)
        return await anext(stream)

    assert asyncio.run(first()).count("\n") == 4
