"""The server as a process: slow and silent clients, and other programs beside it."""

import json
import signal
import socket
import subprocess
import sys
import urllib.error
import urllib.request
from urllib.parse import urlsplit

import pytest

pytestmark = pytest.mark.nightly  # make test-web runs them
RIG = [sys.executable, "-c", "from rig.cli.main import main; main()"]


def call(server, path, body=None):
    data = None if body is None else json.dumps(body).encode()
    request = urllib.request.Request(f"{server.url}api/v1/{path}", data, {"Content-Type": "application/json"})
    with urllib.request.urlopen(request, timeout=20) as answer:
        return json.load(answer)


def connect(server):
    place = urlsplit(server.url)
    return socket.create_connection((place.hostname, place.port), timeout=30)


def finish(server, job):
    while (job := call(server, f"jobs/{job['id']}"))["state"] in ("queued", "running"):
        pass
    return job


def test_slow_and_silent_clients_do_not_disturb_a_job(serve_process):
    server = serve_process("bench.sim.speed=1000")
    get = b"GET /api/v1/events HTTP/1.1\r\nHost: 127.0.0.1\r\n"
    slow = [connect(server) for _ in range(20)]
    for one in slow:
        one.sendall(b"GET / HTTP/1.1\r\nHost: 127.0")  # the head never ends
    silent = [connect(server) for _ in range(200)]
    for one in silent:
        one.sendall(get + b"\r\n")  # never reads the events
    job = finish(server, call(server, "jobs", {"kind": "enroll", "name": "lamp", "views": 6}))
    assert (job["state"], job["views"]) == ("done", 6)
    assert call(server, "status")["server"]["listeners"] == 200
    for one in slow:  # disconnected after some seconds
        assert one.recv(100) == b""
        one.close()
    upload = connect(server)
    upload.sendall(
        b"POST /api/v1/import HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 1000000000\r\n\r\n" + b"x" * 1000
    )
    assert b" 413 " in upload.recv(1000)
    upload.close()
    for one in silent:
        one.close()
    assert server.kill(signal.SIGTERM) == 128 + signal.SIGTERM


def test_commands_of_the_terminal_work_beside_the_server(serve_process):
    server = serve_process("bench.sim.speed=1000")
    finish(server, call(server, "jobs", {"kind": "enroll", "name": "lamp", "views": 4}))
    base = ["--bench", "sim", *server.settings]

    def rig(*words):
        return subprocess.run([*RIG, *words, *base], capture_output=True, text=True, timeout=60)

    status = rig("status")
    assert status.returncode == 0, status.stderr
    assert f"served at {server.url}" in status.stdout
    assert "lamp" in rig("catalog", "list").stdout
    moving = rig("goto", "10")
    assert moving.returncode == 9
    assert server.url in moving.stderr
    second = rig("serve", "--port", "0")
    assert second.returncode == 9
    stopped = rig("stop")
    assert stopped.returncode == 0, stopped.stderr
    assert call(server, "health")["bench_open"]
