"""Tokens over the API: an operator makes, lists and revokes them, but not at a server that needs no login."""

import pytest

from rig.web.access import Role
from tests.rig.web.conftest import Served

API = "/api/v1/tokens"


def bearer(token: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {token}"}


@pytest.fixture
def bench(serve) -> Served:
    bench = serve(needs_login=True)
    bench.client.headers |= bearer(bench.server.sessions.tokens.new("ana", Role.OPERATE))
    return bench


def test_operator_makes_a_token_which_only_that_answer_has_and_revokes_it(bench):
    answer = bench.client.post(API, json={"name": "lab/agent", "role": "propose", "days": 7})
    assert answer.status_code == 201, answer.text
    token = answer.json()["token"]
    before = bench.client.get(API)
    agent = bearer(token)
    assert bench.client.get("/api/v1/me", headers=agent).json()["role"] == "propose"
    after = bench.client.get(API)
    rows = [{one["name"]: one for one in answer.json()["items"]} for answer in (before, after)]
    assert rows[0].keys() == {"ana", "lab/agent"}
    assert rows[0]["ana"]["expires_utc"] is None
    assert rows[0]["ana"]["used_utc"]
    assert rows[0]["lab/agent"]["expires_utc"] > rows[0]["lab/agent"]["created_utc"]
    assert [one["lab/agent"]["used_utc"] is None for one in rows] == [True, False]
    assert "rig_" not in before.text + after.text
    assert "sha256" not in before.text
    assert bench.client.delete(f"{API}/lab/agent").json() == {"deleted": "lab/agent"}
    assert bench.client.get("/api/v1/me", headers=agent).status_code == 401
    assert bench.client.delete(f"{API}/lab/agent").status_code == 404


def test_name_that_is_taken_or_cannot_be_used_is_rejected_and_the_first_token_stays(bench):
    for name in ("ana", "local", "a\nb"):
        assert bench.client.post(API, json={"name": name, "role": "watch"}).status_code == 422
    assert bench.client.get("/api/v1/me").json()["role"] == "operate"


@pytest.mark.parametrize("role", ["watch", "propose"])
def test_only_operators_see_and_change_tokens(bench, role):
    other = bearer(bench.server.sessions.tokens.new("other", Role(role)))
    answers = (
        bench.client.get(API, headers=other),
        bench.client.post(API, json={"name": "mine", "role": "operate"}, headers=other),
        bench.client.delete(f"{API}/ana", headers=other),
    )
    assert [one.status_code for one in answers] == [403] * 3
    assert len(bench.server.sessions.tokens.stored()) == 2


def test_token_of_the_operator_who_has_the_bench_can_be_revoked_and_frees_it(bench):
    thief = bearer(bench.server.sessions.tokens.new("thief", Role.OPERATE))
    bench.client.post("/api/v1/lease", json={}, headers=thief)
    assert bench.client.post("/api/v1/jobs", json={"kind": "home"}).status_code == 423
    assert bench.client.delete(f"{API}/thief").status_code == 200
    assert bench.client.post("/api/v1/jobs", json={"kind": "home"}).status_code == 201


def test_users_of_this_computer_without_a_token_can_make_none(served):
    served.server.sessions.tokens.new("ana", Role.OPERATE)
    for answer in (
        served.client.post(API, json={"name": "mine", "role": "operate"}),
        served.client.delete(f"{API}/ana"),
    ):
        assert answer.status_code == 403
        assert "rig serve --new-token" in answer.json()["next_step"]
    assert [one["name"] for one in served.client.get(API).json()["items"]] == ["ana"]
