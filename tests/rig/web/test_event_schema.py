"""The OpenAPI document has the schema of the events of saved runs and of the stream, and both send such events."""

import json
from dataclasses import fields
from typing import get_args

import pytest

from rig.events.events import Event, event_dict, event_of

KINDS = {next(f.default for f in fields(kind) if f.name == "event") for kind in get_args(Event)}


@pytest.fixture(scope="module")
def document(served):
    return served.client.get("/api/v1/openapi.json").json()


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


def test_stream_and_saved_run_send_such_events(serve):
    served = serve("bench.sim.object='mug-white'")
    for name in ("mug-white", "lamp"):
        served.run(kind="enroll", name=name, views=4)
    job = served.run(kind="identify")
    messages, lost = served.server.hub.since(0)
    assert not lost
    sent = [data for one in messages if one.kind == "plan" and (data := json.loads(one.data))["event"] != "note"]
    saved = served.client.get(f"/api/v1/runs/{job['run']}").json()["events"]
    assert {"started", "moved", "accepted", "ranked", "identified", "enrolled"} <= {data["event"] for data in sent}
    for data in (*sent, *saved):
        assert data.keys() - event_dict(event_of(data)).keys() <= {"job", "text", "steps", "picture", "outline_px"}
        assert event_dict(event_of(data)).items() <= data.items()
