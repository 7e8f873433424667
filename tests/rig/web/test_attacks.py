"""Requests that must not be answered, and requests that must not harm."""

import pytest

from rig.web.access import Role

API = "/api/v1"


def test_other_hosts_and_origins_are_rejected(served):
    client = served.client
    assert client.get(f"{API}/status", headers={"Host": "evil.example"}).status_code == 421
    assert client.get(f"{API}/status", headers={"Host": "127.0.0.1.evil.example"}).status_code == 421
    for headers in ({"Origin": "http://evil.example"}, {"Origin": "null"}, {"Sec-Fetch-Site": "cross-site"}):
        assert client.post(f"{API}/stop", headers=headers).status_code == 403, headers
        assert client.get(f"{API}/picture", headers={**headers, "Sec-Fetch-Mode": "no-cors"}).status_code == 403
    link = {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "navigate"}
    assert client.get("/", headers=link).status_code == 200
    assert client.get(f"{API}/status", headers=link).status_code == 403
    form = {"Content-Type": "text/plain"}
    assert client.post(f"{API}/jobs", content='{"kind": "home"}', headers=form).status_code == 415
    assert client.get("/").headers["content-security-policy"].startswith("default-src 'self'")


def test_other_computers_need_a_token_and_its_role_decides(serve):
    served = serve(needs_login=True)
    client, tokens = served.client, served.server.sessions.tokens
    assert client.get(f"{API}/health").json()["status"] == "ok"
    for path in ("status", "objects", "events", "picture", "configuration", "log", "runs"):
        assert client.get(f"{API}/{path}").status_code == 401, path
    assert client.get("/metrics").status_code == 401
    watch = {"Authorization": f"Bearer {tokens.new('tablet', Role.WATCH)}"}
    operate = {"Authorization": f"Bearer {tokens.new('robot', Role.OPERATE)}"}
    assert client.get(f"{API}/status", headers=watch).status_code == 200
    assert client.post(f"{API}/jobs", json={"kind": "home"}, headers=watch).status_code == 403
    assert client.delete(f"{API}/objects/lamp", headers=watch).status_code == 403
    assert client.post(f"{API}/stop", headers=watch).status_code == 200
    assert client.post(f"{API}/jobs", json={"kind": "home"}, headers=operate).status_code == 201
    cookie = client.post(f"{API}/login", json={"token": operate["Authorization"][7:]}).headers["set-cookie"]
    assert "HttpOnly" in cookie
    assert "SameSite=strict" in cookie
    assert client.get(f"{API}/me").json()["role"] == "operate"
    client.post(f"{API}/logout")
    assert client.get(f"{API}/me").status_code == 401


def test_persons_who_watch_see_no_password(serve):
    served = serve("catalog.url=postgresql+psycopg://ada:w0rd@host.invalid/rig", needs_login=True)
    watch = {"Authorization": f"Bearer {served.server.sessions.tokens.new('tablet', Role.WATCH)}"}
    answer = served.client.get(f"{API}/configuration", headers=watch)
    assert answer.json()["catalog"]["url"] == "postgresql+psycopg://ada:***@host.invalid/rig"
    for path in ("configuration", "status", "objects", "log", "jobs", "results", "me"):
        assert "w0rd" not in served.client.get(f"{API}/{path}", headers=watch).text, path


def test_second_operator_needs_the_lease(serve):
    client = serve().client
    first, second = {"X-Rig-Client": "1"}, {"X-Rig-Client": "2"}
    assert client.post(f"{API}/jobs", json={"kind": "doctor"}, headers=first).status_code == 201
    rejected = client.post(f"{API}/jobs", json={"kind": "doctor"}, headers=second)
    assert (rejected.status_code, rejected.json()["code"]) == (423, 902)
    assert client.post(f"{API}/stop", headers=second).status_code == 200
    assert client.post(f"{API}/lease", json={"force": True}, headers=second).status_code == 200
    assert client.post(f"{API}/jobs", json={"kind": "doctor"}, headers=first).status_code == 423


@pytest.mark.parametrize(
    "path",
    [
        "/static/../app.py",
        "/static/%2e%2e/app.py",
        "/static/..%2f..%2fcore%2ferrors.py",
        f"{API}/runs/..",
        f"{API}/runs/..%2f..%2fetc",
        f"{API}/runs/%2e%2e/report",
        f"{API}/objects/..%2f..%2fetc%2fpasswd",
        f"{API}/jobs/..%2f1/views/0",
        f"{API}/views/99999999999999999999/image",
        f"{API}/views/-1/image",
    ],
)
def test_path_of_a_request_reaches_no_file(served, path):
    answer = served.client.get(path)
    assert answer.status_code in (404, 422), answer.text
    assert "import" not in answer.text.replace("/import", "")


def test_large_bodies_are_rejected(serve):
    client = serve().client
    assert (
        client.post(
            f"{API}/jobs", content=b"{" + b" " * 2_000_000, headers={"Content-Type": "application/json"}
        ).status_code
        == 413
    )

    def parts():
        for _ in range(30):
            yield b"x" * 100_000

    assert client.post(f"{API}/import", content=parts()).status_code == 413
    assert client.post(f"{API}/import", content=b"PK\x03\x04 not a bundle").json()["code"] == 705


@pytest.mark.parametrize(
    "body",
    [
        {},
        {"kind": "explode"},
        {"kind": "goto", "angle_deg": "far"},
        {"kind": "goto", "angle_deg": 1e400},
        {"kind": "enroll"},
        {"kind": "enroll", "name": "x" * 101},
        {"kind": "enroll", "name": "a", "views": 3},
        {"kind": "home", "extra": 1},
        {"kind": "tray", "objects": []},
    ],
)
def test_impossible_requests_are_rejected_with_their_mistakes(served, body):
    import json

    text = json.dumps(body).replace("Infinity", "1e400")
    answer = served.client.post(f"{API}/jobs", content=text, headers={"Content-Type": "application/json"})
    assert answer.status_code == 422
    assert answer.headers["content-type"] == "application/problem+json"
    assert answer.json()["evidence"]["mistakes"]


@pytest.mark.parametrize(
    ("method", "path", "body"),
    [
        ("POST", "login", {"token": "t"}),
        ("POST", "lease", {"force": True}),
        ("POST", "undelete", {"name": "lamp"}),
        ("POST", "shelf", {"words": ["clear"]}),
        ("PUT", "settings/identify.max_views", {"value": 5}),
    ],
)
def test_unknown_key_of_a_request_is_a_mistake(served, method, path, body):
    answer = served.client.request(method, f"{API}/{path}", json=body | {"extra": 1})
    assert (answer.status_code, "extra" in answer.text) == (422, True)


def test_error_of_a_job_names_the_next_step_and_the_server_continues(serve):
    served = serve()
    error = served.run(kind="identify")["error"]
    assert error["code"] // 100 == 7
    assert error["next_step"]
    home = served.run(kind="home")
    assert home["state"] == "done"
    for change in ("pause", "resume", "cancel"):
        assert served.client.post(f"{API}/jobs/{home['id']}/{change}").status_code == 409
    assert served.client.post(f"{API}/jobs/{home['id']}/answer", json={"choice": "skip"}).status_code == 409


def test_lists_have_pages_and_etags(serve):
    served = serve()
    for _ in range(3):
        served.run(kind="home")
    first = served.client.get(f"{API}/jobs?limit=2")
    assert first.json()["total"] == 3
    rest = served.client.get(first.links["next"]["url"])
    assert len(rest.json()["items"]) == 1
    assert served.client.get(f"{API}/jobs?limit=2", headers={"If-None-Match": first.headers["etag"]}).status_code == 304
    assert served.client.get(f"{API}/jobs?after=nothing").status_code == 422


def test_metrics_contain_the_state_of_the_bench(serve):
    served = serve()
    served.run(kind="goto", angle_deg=30)
    text = served.client.get("/metrics").text
    assert "rig_bench_open 1.0" in text
    assert 'rig_jobs{state="done"} 1.0' in text
