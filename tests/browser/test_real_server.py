"""The server as a process: slow and silent clients, and other programs beside it."""

import json
import shutil
import signal
import socket
import ssl
import subprocess
import urllib.error
import urllib.request
from urllib.parse import urlsplit

import pytest

from tests.browser.conftest import RIG, WAIT_S, call

pytestmark = pytest.mark.nightly  # make test-web runs them


def connect(server):
    place = urlsplit(server.url)
    return socket.create_connection((place.hostname, place.port), timeout=WAIT_S)


def finish(server, job):
    while (job := call(server, f"jobs/{job['id']}"))["state"] in ("queued", "running"):
        pass
    return job


def test_slow_and_silent_clients_do_not_disturb_a_job(serve_process):
    server = serve_process("bench.sim.speed=1000", 'bench.sim.object="lamp"')
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
    server = serve_process("bench.sim.speed=1000", 'bench.sim.object="lamp"')
    finish(server, call(server, "jobs", {"kind": "enroll", "name": "lamp", "views": 4}))
    base = ["--bench", "sim", *server.settings]

    def rig(*words):
        return subprocess.run([*RIG, *words, *base], capture_output=True, text=True, timeout=WAIT_S)

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


def test_server_with_a_certificate_speaks_tls_only(serve_process, tmp_path):
    if shutil.which("openssl") is None:
        pytest.skip("openssl is missing: apt-get install openssl")
    key, certificate = tmp_path / "key.pem", tmp_path / "certificate.pem"
    names = ["-subj", "/CN=bench.local", "-addext", "subjectAltName=IP:127.0.0.1"]
    command = ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "1", *names]
    subprocess.run([*command, "-keyout", key, "-out", certificate], check=True, capture_output=True)
    server = serve_process(options=("--certfile", str(certificate), "--keyfile", str(key)))
    assert server.url.startswith("https://")
    context = ssl.create_default_context(cafile=certificate)
    with urllib.request.urlopen(f"{server.url}api/v1/health", context=context, timeout=WAIT_S) as answer:
        assert json.load(answer)["status"] == "ok"
    with pytest.raises(OSError):  # noqa: PT011 - reset or bad response, as the system likes
        urllib.request.urlopen(server.url.replace("https", "http"), timeout=WAIT_S)
    status = subprocess.run([*RIG, "status", "--bench", "sim", *server.settings], capture_output=True, text=True)
    assert f"served at {server.url}" in status.stdout, status.stderr
