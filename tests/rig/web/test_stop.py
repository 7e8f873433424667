"""STOP waits for nothing: not for the queue, its disk, exports or wrong tokens. And nothing starts after it."""

import asyncio
import json
import threading
from collections.abc import Iterator
from typing import Any

import pytest
from starlette.websockets import WebSocketDisconnect

from rig.bench import Bench, open_bench
from rig.core.clock import SystemClock
from rig.core.errors import DeviceSilent
from rig.devices.servo import ServoState
from rig.safety.stop_channel import StopAnswer, StopRequest
from rig.web.access import Role
from rig.web.jobs import MAX_QUEUED
from rig.web.server import long_work
from tests.rig.web.conftest import Served

CLOCK = SystemClock()
SOCKET = "ws://127.0.0.1/api/v1/socket"
GOTO = {"kind": "goto", "angle_deg": 350}


class Motion:
    """A rotation of the served bench: it waits at 20° until a test lets it continue or STOP arrives."""

    def __init__(self) -> None:
        self.reached = threading.Event()
        self.released = threading.Event()
        self.bench: Bench | None = None
        self.lock = threading.Lock()
        """While a test holds it, the motion does not go on after STOP."""

    def watch(self, bench: Bench) -> None:
        self.bench = bench

        def observe(state: ServoState) -> None:
            if bench.safety.angle_reference.to_table(state.position_deg) > 20.0 and not self.reached.is_set():
                self.reached.set()
                while not bench.state.stop_requested() and not self.released.is_set():
                    CLOCK.sleep(0.001)
                with self.lock:
                    pass

        bench.safety.observers.append(observe)


@pytest.fixture
def motion(monkeypatch: pytest.MonkeyPatch) -> Motion:
    motion = Motion()

    def opened(*arguments: Any, **options: Any) -> Bench:
        bench = open_bench(*arguments, **options)
        motion.watch(bench)
        return bench

    monkeypatch.setattr("rig.web.worker.open_bench", opened)
    return motion


@pytest.fixture
def moving(serve: Any, motion: Motion) -> Iterator[Served]:
    """A served bench in the middle of a rotation, with a full queue behind it."""
    served = serve()
    for number in range(MAX_QUEUED + 1):
        assert served.client.post("/api/v1/jobs", json=GOTO).status_code == 201, number
        if number == 0:
            assert motion.reached.wait(60.0)
    yield served
    motion.released.set()


def request_stop(served: Served) -> StopRequest:
    return StopRequest(served.server.setup.config.state_path("sim"))


def table_deg(served: Served) -> float:
    angle_deg = served.worker.status.table_deg
    assert angle_deg is not None
    return angle_deg


def all_cancelled(served: Served) -> None:
    first = served.worker.queue.jobs()[-1]
    assert served.wait(first.id)["state"] == "cancelled"
    jobs = served.worker.queue.jobs()
    assert {job.state for job in jobs} == {"cancelled"}
    assert [job.id for job in jobs if job.started_utc is not None] == [first.id]
    assert 20.0 < table_deg(served) < 340.0


def test_rig_stop_cancels_the_queue_and_no_waiting_job_begins(moving):
    request = request_stop(moving)
    assert request.wait(CLOCK, 30.0) is StopAnswer.TORQUE_OFF
    request.close()
    all_cancelled(moving)
    assert moving.run(kind="home")["state"] == "done"  # a person asks for it


def test_job_that_waits_never_begins_although_the_stop_was_not_noticed_yet(serve, motion):
    """The stop arrives after the running job has ended and before the next one begins."""
    served = serve()
    queue, began = served.worker.queue, threading.Event()
    usual = queue.end

    def end(job: Any, *arguments: Any) -> None:
        if not began.is_set():
            began.set()
            while len(queue.jobs()) < 2:
                CLOCK.sleep(0.001)
            request_stop(served).close()
        usual(job, *arguments)

    queue.end = end
    first, second = (served.client.post("/api/v1/jobs", json={"kind": "home"}).json() for _ in range(2))
    assert served.wait(first["id"])["state"] == "done"
    assert served.wait(second["id"])["state"] == "cancelled"
    assert queue.job(second["id"]).started_utc is None
    assert served.run(kind="home")["state"] == "done"


def test_stop_does_not_wait_for_the_queue_and_its_disk(moving):
    """Another thread stores the jobs on a disk that does not answer."""
    queue, held, free = moving.worker.queue, threading.Event(), threading.Event()

    def store() -> None:
        with queue._lock:
            held.set()
            free.wait(60.0)

    thread = threading.Thread(target=store)
    thread.start()
    assert held.wait(10.0)
    request = request_stop(moving)
    answer = request.wait(CLOCK, 30.0)
    free.set()
    thread.join()
    request.close()
    assert answer is StopAnswer.TORQUE_OFF
    all_cancelled(moving)


def test_listeners_learn_when_a_job_ends_after_the_answer_to_a_stop(serve, motion):
    served = serve()
    job = served.client.post("/api/v1/jobs", json=GOTO).json()
    assert motion.reached.wait(60.0)
    with motion.lock:
        request = request_stop(served)
        assert request.answer() is None
    assert served.wait(job["id"])["state"] == "cancelled"
    assert request.answer() is StopAnswer.TORQUE_OFF
    request.close()
    while len(sent := [json.loads(one.data) for one in served.server.hub.since(0)[0] if one.kind == "stop"]) < 2:
        CLOCK.sleep(0.005)
    assert sent == [{"ended": False}, {"ended": True, "torque_off": True}]


def test_stop_does_not_wait_for_exports(moving, motion):
    """More exports run than there are threads for them."""
    free = threading.Event()

    async def stop_beside_exports() -> dict[str, Any]:
        exports = [asyncio.ensure_future(long_work(lambda: free.wait(60.0))) for _ in range(45)]
        await asyncio.sleep(0)
        done = await moving.server.stop()
        free.set()
        await asyncio.gather(*exports)
        return done

    assert asyncio.run(stop_beside_exports()) == {"ended": True, "answer": "torque-off"}
    all_cancelled(moving)


def test_stop_works_after_wrong_tokens_and_with_a_damaged_file_of_tokens(serve):
    served = serve(needs_login=True).opened()
    tokens = served.server.sessions.tokens
    right = {"Authorization": f"Bearer {tokens.new('tablet', Role.WATCH)}"}
    assert served.client.get("/api/v1/status", headers=right).status_code == 200
    wrong = {"Authorization": "Bearer rig_wrong"}
    codes = [served.client.post("/api/v1/stop", headers=wrong).status_code for _ in range(6)]
    assert codes == [401] * 6
    assert served.client.post("/api/v1/stop", headers=right).json()["ended"]
    (served.folder / "state" / "sim" / "web" / "tokens.json").write_text("[{")
    assert served.client.post("/api/v1/stop", headers=right).json()["ended"]
    assert served.client.post("/api/v1/stop", headers={"Authorization": "Bearer rig_other"}).status_code == 503


def test_page_sends_stop_on_its_open_connection_and_gets_what_the_bench_confirms(moving):
    with moving.client.websocket_connect(f"{SOCKET}?client=1") as socket:
        assert socket.receive_json()["kind"] == "hello"
        socket.send_json({"stop": 7})
        received = [socket.receive_json()]
        while received[-1]["kind"] != "stopped":
            received.append(socket.receive_json())
        assert received[-1]["data"] == {"ended": True, "answer": "torque-off", "stop": 7}
    all_cancelled(moving)


def test_page_of_another_site_gets_no_connection(served):
    for headers in ({"Origin": "http://evil.example"}, {"Origin": "http://[::1"}, {"Host": "evil.example"}):
        with pytest.raises(WebSocketDisconnect), served.client.websocket_connect(SOCKET, headers=headers):
            pass
    assert served.client.post("/api/v1/stop", headers={"Origin": "http://[::1"}).status_code == 403


@pytest.mark.parametrize("end", ["removed", "expired", "logout"])
def test_open_streams_end_with_their_token(serve, end):
    served = serve(needs_login=True)
    server, client = served.server, served.client
    token = server.sessions.tokens.new("tablet", Role.WATCH, days=0.00002 if end == "expired" else None)
    client.post("/api/v1/login", json={"token": token})
    with client.websocket_connect(SOCKET) as socket:
        assert socket.receive_json()["kind"] == "hello"
        if end == "removed":
            server.sessions.tokens.remove("tablet")
        elif end == "logout":
            client.post("/api/v1/logout")
        with pytest.raises(WebSocketDisconnect):
            while True:
                socket.receive_json()
    assert server.hub.listeners == 0


def test_stop_without_a_servo_that_answers_is_not_confirmed(serve, motion):
    served = serve()
    assert served.run(kind="home")["state"] == "done"

    def silent() -> None:
        raise DeviceSilent("The servo does not answer.", next_step="Check its cable.")

    motion.bench.servo.torque_off = silent
    answer = served.client.post("/api/v1/stop").json()
    del motion.bench.servo.torque_off
    assert (answer["ended"], answer["answer"]) == (False, "not-confirmed")


def test_stop_during_a_pause_within_a_search_holds_the_cable_budget(serve):
    """The search in motion pauses after its flight; STOP then switches the torque off where the table stands."""
    known = ("camera_time.offset_ms=8", "camera_time.uncertainty_ms=0.3", "camera_time.jitter_ms=0.3")
    served = serve("bench.sim.object='mug-white'", *known)
    for name in ("mug-white", "mug-star"):
        assert served.run(kind="enroll", name=name, views=6)["state"] == "done"
    served.post_at("pause", lambda event: event["event"] in ("decided", "frame_used"))
    job = served.client.post("/api/v1/jobs", json={"kind": "identify"}).json()
    assert served.wait(job["id"], "paused")["state"] == "paused"
    before_deg = table_deg(served)
    assert served.client.post("/api/v1/stop").json()["ended"]
    assert served.wait(job["id"])["state"] == "cancelled"
    low, high = served.server.setup.config.table.limits_deg
    assert low <= table_deg(served) <= high
    assert table_deg(served) == pytest.approx(before_deg, abs=0.5)
    assert served.run(kind="home")["state"] == "done"
