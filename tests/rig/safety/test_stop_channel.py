"""A request to stop reaches the program that uses the bench, and its answer comes back."""

import resource
import signal
import socket
import subprocess
import sys

import pytest

from rig.core.clock import SystemClock
from rig.core.errors import StateNotStored
from rig.safety.saved_state import FileStore
from rig.safety.stop_channel import StopAnswer, StopListener, StopRequest, listen

CLOCK = SystemClock()


@pytest.fixture
def listener(tmp_path):
    listener = listen(tmp_path)
    yield listener
    listener.close()


def answered(request: StopRequest) -> StopAnswer | None:
    return request.wait(CLOCK, 20.0)


@pytest.mark.parametrize("answer", [StopAnswer.TORQUE_OFF, StopAnswer.NOT_CONFIRMED])
def test_each_request_counts_once_and_gets_the_answer(tmp_path, listener, answer):
    assert listener.count() == 0
    requests = [StopRequest(tmp_path) for _ in range(3)]
    assert [request.answer() for request in requests] == [None] * 3
    assert listener.count() == 3
    assert listener.count() == 3
    listener.answer(answer)
    assert [answered(request) for request in requests] == [answer] * 3
    for request in requests:
        request.close()


def test_request_of_a_program_that_has_ended_still_counts(tmp_path, listener):
    StopRequest(tmp_path).close()
    assert listener.count() == 1
    listener.answer(StopAnswer.TORQUE_OFF)


def test_no_program_listens_before_and_after(tmp_path):
    assert StopRequest(tmp_path).connection is None
    listen(tmp_path).close()
    assert StopRequest(tmp_path).connection is None


def test_end_of_the_program_is_an_answer(tmp_path):
    code = "import sys, time; from pathlib import Path; from rig.safety.stop_channel import listen\n"
    code += "listener = listen(Path(sys.argv[1])); print('listens', flush=True); time.sleep(60)"
    with subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], stdout=subprocess.PIPE, text=True) as program:
        assert program.stdout.readline() == "listens\n"
        request = StopRequest(tmp_path)
        program.send_signal(signal.SIGKILL)
        assert answered(request) is StopAnswer.ENDED
        request.close()
    listener = listen(tmp_path)  # the killed program has left its socket behind
    StopRequest(tmp_path).close()
    assert listener.count() == 1
    listener.close()


def test_bench_and_server_of_one_program_hear_the_same_requests(tmp_path, listener):
    store = FileStore(tmp_path)
    StopRequest(tmp_path).close()
    store.listen()
    assert not store.stop_requested()  # an old request, meant for an earlier job
    request = StopRequest(tmp_path)
    assert store.stop_requested()
    assert listener.count() == 2
    store.clear_stop()
    assert answered(request) is StopAnswer.TORQUE_OFF
    assert not store.stop_requested()
    store.stop_listening()
    StopRequest(tmp_path).close()
    assert listener.count() == 3  # the server listens after its bench was closed
    request.close()


def test_path_longer_than_the_address_of_a_socket(tmp_path):
    folder = tmp_path / ("x" * 200)
    listener = listen(folder)
    StopRequest(folder).close()
    assert listener.count() == 1
    listener.close()


def test_another_file_of_that_name_is_not_removed(tmp_path):
    (tmp_path / "stop").write_text("mine")
    with pytest.raises(StateNotStored):
        listen(tmp_path)
    assert (tmp_path / "stop").read_text() == "mine"
    assert StopRequest(tmp_path).connection is None


def test_only_the_user_of_the_bench_may_connect(tmp_path, listener):
    assert (tmp_path / "stop").stat().st_mode & 0o777 == 0o600


def test_request_counts_although_no_file_can_be_opened(tmp_path):
    listener = StopListener(tmp_path)
    listener.users = 1
    sender = socket.socket(socket.AF_UNIX)
    sender.connect(str(tmp_path / "stop"))
    allowed = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (1, allowed[1]))
    try:
        assert listener.count() > 0
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, allowed)
    sender.close()
    listener.close()
