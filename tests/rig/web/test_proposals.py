"""A token with the role propose queues jobs that wait for an operator; notify_command hears of their ends."""

import json
import sys

import pytest

from rig.web.access import Role
from tests.rig.core.test_notify import COPY, ended, messages

API = "/api/v1/jobs"
GOTO = {"kind": "goto", "angle_deg": 20.0}


@pytest.fixture
def heard(tmp_path):
    return tmp_path / "heard"


@pytest.fixture
def bench(serve, heard):
    command = json.dumps([sys.executable, "-c", COPY, str(heard)])
    return serve(f"notify_command={command}", needs_login=True)


def headers(bench, name, role):
    return {"Authorization": f"Bearer {bench.server.sessions.tokens.new(name, role)}"}


def waiting(bench, who):
    return bench.client.get(f"{API}?state=proposed", headers=who).json()["items"]


def end_of(bench, job_id):
    bench.wait(job_id)
    return bench.worker.queue.job(job_id).state


def test_proposed_job_starts_after_an_operator_approves_it(bench, heard):
    agent, person = headers(bench, "agent", Role.PROPOSE), headers(bench, "ana", Role.OPERATE)
    answer = bench.client.post(API, json=GOTO, headers=agent)
    assert answer.status_code == 201, answer.text
    proposed = answer.json()
    assert (proposed["state"], proposed["operator"]) == ("proposed", "agent")
    path = f"{API}/{proposed['id']}"
    # Who proposes may neither approve nor operate, and does not take the bench from an operator.
    for forbidden in ("approve", "cancel"):
        assert bench.client.post(f"{path}/{forbidden}", headers=agent).status_code == 403
    assert bench.server.lease.holder is None
    assert [one["id"] for one in waiting(bench, agent)] == [proposed["id"]]
    # A job of an operator overtakes it.
    own = bench.client.post(API, json={"kind": "home"}, headers=person).json()
    assert end_of(bench, own["id"]) == "done"
    assert bench.worker.queue.job(proposed["id"]).state == "proposed"
    approved = bench.client.post(f"{path}/approve", headers=person).json()
    assert approved["approved_by"] == "ana"
    assert waiting(bench, agent) == []
    assert end_of(bench, proposed["id"]) == "done"
    assert bench.client.post(f"{path}/approve", headers=person).status_code == 409
    ended()
    first, second = messages(heard)
    assert [one["job"]["request"]["kind"] for one in (first, second)] == ["home", "goto"]
    assert second["event"] == "job"
    assert (second["job"]["state"], second["job"]["approved_by"]) == ("done", "ana")


def test_stop_and_cancel_end_proposals(bench):
    agent, person = headers(bench.opened(), "agent", Role.PROPOSE), headers(bench, "ana", Role.OPERATE)
    first, second = (bench.client.post(API, json=GOTO, headers=agent).json()["id"] for _ in range(2))
    assert bench.client.post(f"{API}/{first}/cancel", headers=person).json()["state"] == "cancelled"
    assert bench.client.post("/api/v1/stop", headers=agent).json()["ended"]
    assert end_of(bench, second) == "cancelled"
    assert bench.client.post(f"{API}/{second}/approve", headers=person).status_code == 409
