"""The OpenAPI document is the committed one, describes all answers and events, and the server sends such events.

``python -m tests.rig.web.test_api_document`` writes it again.
"""

import json
import re
import socket
from dataclasses import fields
from pathlib import Path
from typing import Any, get_args

import pytest

from rig.config import RigConfig
from rig.core.clock import SystemClock
from rig.core.errors import error_kinds
from rig.events.events import Event, event_dict, event_of
from rig.web.answers import ServoReading
from rig.web.api_bench import Status
from rig.web.api_catalog import ListedResult, LogRow
from rig.web.app import create_app
from rig.web.server import Server
from rig.web.setup import Setup

KINDS = {next(f.default for f in fields(kind) if f.name == "event") for kind in get_args(Event)}

COMMITTED = Path(__file__).parents[3] / "docs" / "reference" / "openapi.json"
PUBLIC = {"get_health", "login", "logout"}
PROBLEM = {"application/problem+json": {"schema": {"$ref": "#/components/schemas/Problem"}}}


def made() -> dict[str, Any]:
    setup = Setup(bench="sim", config=RigConfig())
    with socket.socket() as unused:
        return create_app(Server(setup, SystemClock(), unused)).openapi()


@pytest.fixture(scope="module")
def document():
    return json.loads(COMMITTED.read_text())


def test_committed_document_is_that_of_the_program(served, document):
    sent = served.client.get("/api/v1/openapi.json").json()
    assert sent == document, "python -m tests.rig.web.test_api_document writes it again"


def test_each_operation_has_a_plain_name_a_schema_for_its_answer_and_the_right_that_it_needs(document):
    operations = [one for methods in document["paths"].values() for one in methods.values()]
    assert len({one["operationId"] for one in operations}) == len(operations) == 53
    for one in operations:
        (answer,) = (found for status, found in one["responses"].items() if status.startswith("2"))
        assert all(content["schema"] for content in answer["content"].values()), one["operationId"]
        assert one["operationId"].isidentifier()
        failed = [found["content"] for status, found in one["responses"].items() if not status.startswith("2")]
        assert failed == [PROBLEM, PROBLEM], one["operationId"]
        assert ("security" in one) == (one["operationId"] not in PUBLIC)
        roles = {role for way in one.get("security", ()) for needed in way.values() for role in needed}
        assert len(roles) == (one["operationId"] not in PUBLIC)
    assert document["components"]["securitySchemes"].keys() == {"token", "login"}


@pytest.mark.parametrize(
    ("method", "path", "role"),
    [
        ("post", "/jobs", "propose"),
        ("post", "/lease", "operate"),
        ("delete", "/lease", "watch"),
        ("get", "/tokens", "operate"),
        ("post", "/stop", "watch"),
        ("get", "/results", "watch"),
        ("post", "/results/{result_id}/correct", "operate"),
    ],
)
def test_operation_names_the_role_that_it_needs(document, method, path, role):
    assert document["paths"][f"/api/v1{path}"][method]["security"] == [{"token": [role]}, {"login": [role]}]


@pytest.mark.parametrize(
    ("path", "media_type", "name"),
    [("/runs/{name}", "application/json", "SavedRunBody"), ("/events", "text/event-stream", "JobMessage")],
)
def test_answers_have_the_schema_of_events(document, path, media_type, name):
    answer = document["paths"][f"/api/v1{path}"]["get"]["responses"]["200"]
    assert answer["content"][media_type]["schema"]["$ref"] == f"#/components/schemas/{name}"


def test_every_kind_of_event_is_described(document):
    schemas = document["components"]["schemas"]
    saved = schemas["SavedRunBody"]["properties"]["events"]["items"]
    sent = schemas["JobMessage"]["contentSchema"]
    for one, kinds in ((saved, KINDS), (sent, KINDS | {"note"})):
        described = {kind: schemas[link.rpartition("/")[2]] for kind, link in one["discriminator"]["mapping"].items()}
        assert described.keys() == kinds
        assert all(schema["required"] == list(schema["properties"]) for schema in described.values())
    accepted = schemas["Accepted"]["properties"]
    assert "image_bgr" not in accepted
    assert "0° is arbitrary" in accepted["azimuth_deg"]["description"]
    assert {"type": "null"} in schemas["Stillness"]["properties"]["peak_rate_dps"]["anyOf"]


def test_reference_of_a_server_shows_each_operation_and_each_error_without_a_network(served, document):
    page = served.client.get("/reference/api.html").text
    for methods in document["paths"].values():
        assert all(f'id="{one["operationId"]}"' in page for one in methods.values())
    assert set(re.findall('href="#([^"]+)"', page)) <= set(re.findall('id="([^"]+)"', page))
    answer = served.client.get("/api/v1/jobs/none")
    assert answer.headers["content-type"] in PROBLEM
    problem = answer.json()
    address, _, anchor = problem["type"].partition("#")
    errors = served.client.get(address).text
    assert f'<tr id="{anchor}"><td>{problem["code"]}</td>' in errors
    assert all(f'id="{kind.code}"' in errors for kind in error_kinds())
    assert not re.search("<script|https?://", page + errors)


def test_stream_saved_run_and_lists_have_the_fields_of_the_document(serve):
    served = serve("bench.sim.object='mug-white'")
    served.run(kind="enroll", name="mug-white", views=4)
    job = served.run(kind="identify")
    messages, lost = served.server.hub.since(0)
    assert not lost
    sent = [data for one in messages if one.kind == "plan" and (data := json.loads(one.data))["event"] != "note"]
    saved = served.client.get(f"/api/v1/runs/{job['run']}").json()["events"]
    assert {"started", "moved", "accepted", "ranked", "identified", "enrolled"} <= {data["event"] for data in sent}
    for data in (*sent, *saved):
        assert data.keys() - event_dict(event_of(data)).keys() <= {"job", "text", "steps", "picture"}
        assert event_dict(event_of(data)).items() <= data.items()

    get = served.client.get
    status = get("/api/v1/status").json()
    assert status.keys() == Status.model_fields.keys()
    assert (status["open"], status["servo"].keys()) == (True, ServoReading.model_fields.keys())
    for path, row in (("results", ListedResult), ("log", LogRow)):
        found = get(f"/api/v1/{path}").json()["items"]
        assert [row.model_validate(one).model_dump(mode="json") for one in found] == found != []
    assert RigConfig.model_validate(get("/api/v1/configuration").json()) == served.server.setup.config


if __name__ == "__main__":
    COMMITTED.write_text(json.dumps(made(), indent=1, ensure_ascii=False) + "\n")
