"""Jobs on the simulated bench through the REST API."""

import json
from dataclasses import replace
from inspect import signature
from typing import Any, get_args

import pytest

from rig.bench import Bench
from rig.calibrations import CalibrationStore
from rig.catalog import Catalog
from rig.config import load_config
from rig.core.clock import SystemClock
from rig.core.errors import DeviceNotFound, StateNotStored
from rig.doctor.examination import run_checks
from rig.motion.arrival import QUIET_COUNTS
from rig.safety.saved_state import SERVER_FOLDER, SESSION, MemoryStore
from rig.web.requests import GotoRequest, JobRequest
from rig.web.setup import Setup
from rig.web.work import JOBS
from tests.rig.calibrations.test_calibrations import RESULT
from tests.rig.web.conftest import connected

AT_REST_DEG = QUIET_COUNTS * 360 / 4096
"""Angle by which two readings of a table at rest may differ."""


def test_status_says_that_the_list_of_jobs_was_damaged(serve, tmp_path):
    list_of_jobs = tmp_path / "state" / "sim" / SERVER_FOLDER / "jobs.json"
    list_of_jobs.parent.mkdir(parents=True)
    list_of_jobs.write_text("damaged")
    served = serve().opened()
    error = served.client.get("/api/v1/status").json()["error"]
    assert (error["code"], error["detail"]) == (StateNotStored.code, f"The list of jobs in {list_of_jobs} is damaged.")
    assert served.run(kind="goto", angle_deg=5)["state"] == "done"
    assert served.client.get("/api/v1/status").json()["error"] is None


def test_view_is_taken_again_and_the_others_stay(serve):
    served = serve("bench.sim.object='lamp'")
    served.run(kind="enroll", name="lamp", views=4)
    before = served.client.get("/api/v1/objects/lamp").json()
    job = served.run(kind="retake", name="lamp", views=[2])
    assert job["state"] == "done", job["error"]
    assert job["result"] == {"name": "lamp", "taken_again": [2]}
    after = served.client.get("/api/v1/objects/lamp").json()
    changed = [
        old["captured_utc"] != new["captured_utc"]
        for old, new in zip(*(one["views_taken"] for one in (before, after)), strict=True)
    ]
    assert changed == [False, False, True, False]
    assert [one["status"] for one in after["enrollments"]] == ["complete", "superseded"]
    missing = served.run(kind="retake", name="lamp", views=[4])
    assert (missing["state"], missing["error"]["code"], missing["resume"]["views"]) == ("failed", 200, [4])


def test_enrolled_object_is_identified_and_its_run_is_saved(serve):
    served = serve("bench.sim.object='mug-white'")
    for name in ("mug-white", "lamp"):
        job = served.run(kind="enroll", name=name, views=4, label="kitchen")
        assert job["state"] == "done", job
        assert (job["progress"]["done"], job["views"]) == (4, 4)
    picture = served.client.get(f"/api/v1/jobs/{job['id']}/views/3")
    assert picture.headers["content-type"] == "image/jpeg"
    assert picture.content[:2] == b"\xff\xd8"
    job = served.run(kind="identify", sample="S-1")
    assert job["result"]["outcome"] == "found"
    assert job["result"]["name"] == "mug-white"
    run = served.client.get(f"/api/v1/runs/{job['run']}").json()
    assert run["events"][-1]["event"] == "identified"
    assert "mug-white" in served.client.get(f"/api/v1/runs/{job['run']}/report").text
    checked = served.client.post(f"/api/v1/runs/{job['run']}/check").json()
    assert (checked["differences"], checked["views"], checked["is_complete"]) == ([], job["result"]["views"], True)
    (answer,) = served.client.get("/api/v1/results?sample=S-1").json()["items"]
    assert (answer["object"], answer["operator"]) == ("mug-white", "local")
    fixed = {"object": "lamp", "reason": "read the label"}
    assert served.client.post(f"/api/v1/results/{answer['id']}/correct", json=fixed).json()["object"] == "lamp"
    assert served.client.get("/api/v1/results?object=mug-white").json()["total"] == 0
    details = served.client.get(f"/api/v1/results/{answer['id']}").json()
    assert (details["object"], details["answer"]["name"]) == ("lamp", "mug-white")
    assert details["answer"]["not_enrolled"] < 0.5
    assert [(one["object"], one["reason"]) for one in details["history"]] == [("lamp", "read the label")]
    image = served.client.get(f"/api/v1/results/{answer['id']}/image")
    assert image.headers["content-type"] == "image/jpeg"
    assert image.content.startswith(b"\xff\xd8")
    for chart in ("days?zone_min=60", "drift"):
        drawn = served.client.get(f"/api/v1/results/charts/{chart}")
        assert (drawn.headers["content-type"], drawn.text[:4]) == ("image/svg+xml", "<svg")
    for path in ("results/999", "results/999/image"):
        assert served.client.get(f"/api/v1/{path}").status_code == 404


def test_sample_is_not_accepted_for_several_objects(serve):
    served = serve()
    request = {"kind": "identify", "watch": True, "sample": "S-1"}
    answer = served.client.post("/api/v1/jobs", json=request)
    assert answer.status_code == 422
    (mistake,) = answer.json()["evidence"]["mistakes"]
    assert "sample names one object" in mistake
    assert "scan" in mistake
    assert served.client.get("/api/v1/jobs").json()["items"] == []


def test_each_object_has_the_sample_that_the_answer_to_its_question_names(serve):
    served = serve("bench.sim.object='mug-white'")
    served.run(kind="enroll", name="mug-white", views=4)
    job = served.client.post("/api/v1/jobs", json={"kind": "identify", "watch": True, "scan": True}).json()
    answer = f"/api/v1/jobs/{job['id']}/answer"

    def questions() -> list[Any]:
        sent = [json.loads(one.data) for one in served.server.hub.since(0)[0] if one.kind == "job"]
        return [one["question"] for one in sent if one["state"] == "waiting"]

    for number, sample in enumerate(["S-1", None, "S-3"], 1):
        while len(questions()) < number:
            SystemClock().sleep(0.05)
        assert questions()[-1]["takes_sample"]
        assert served.client.post(answer, json={"sample": "\x07"}).status_code == 422
        assert served.client.post(answer, json={"sample": sample}).status_code == 200
    while len(questions()) < 4:
        SystemClock().sleep(0.05)
    served.client.post(f"/api/v1/jobs/{job['id']}/cancel")
    assert served.wait(job["id"])["state"] == "cancelled"
    results = served.client.get("/api/v1/results").json()["items"]
    assert [one["sample"] for one in results] == ["S-3", None, "S-1"]


def test_job_that_meets_an_interrupted_enrollment_offers_to_continue_it(serve):
    served = serve("bench.sim.object='lamp'")
    served.post_at("cancel", lambda event: event.get("picture") == 1)
    assert served.run(kind="enroll", name="lamp", views=4)["state"] == "cancelled"
    job = served.run(kind="enroll", name="lamp", views=4)
    assert (job["state"], job["views"], job["error"]["code"]) == ("failed", 0, 700)
    assert job["resume"]["resume"]
    done = served.run(**job["resume"])
    assert (done["state"], done["views"]) == ("done", 2)


def test_latched_fault_is_in_the_status(serve):
    served = serve("bench.sim.faults=['jam@move0+9s']")
    job = served.run(kind="goto", angle_deg=180)
    status = served.client.get("/api/v1/status").json()
    assert (status["state"], status["fault"]["code"]) == ("fault", job["error"]["code"])


def test_angle_is_set_after_the_operator_looked_at_the_cable(serve, monkeypatch):
    served = serve()
    assert served.client.get("/api/v1/moves/report").status_code == 404
    served.run(kind="goto", angle_deg=90)
    assert "from 0.0° to 90.0°" in (page := served.client.get("/api/v1/moves/report").text)
    monkeypatch.setattr("rig.web.api_bench.FileStore", lambda _: MemoryStore())  # no file, as without state_dir
    assert served.client.get("/api/v1/moves/report").text == page
    rest_deg = served.client.get("/api/v1/status").json()["table_deg"]
    assert rest_deg == pytest.approx(89.6, abs=0.3)  # friction holds the table short of its goal
    assert served.run(kind="reference")["error"]["code"] == 200
    assert served.run(kind="reference", revolutions=5)["error"]["code"] == 200  # beyond the cable budget
    assert served.run(kind="reference", revolutions=-1)["state"] == "done"
    assert served.client.get("/api/v1/status").json()["table_deg"] == pytest.approx(rest_deg - 360, abs=AT_REST_DEG)
    assert served.run(kind="reference", revolutions=0)["state"] == "done"
    assert served.client.get("/api/v1/status").json()["table_deg"] == pytest.approx(rest_deg, abs=AT_REST_DEG)
    assert served.run(kind="reference", here=True)["state"] == "done"
    assert served.client.get("/api/v1/status").json()["table_deg"] == pytest.approx(0, abs=AT_REST_DEG)


def test_calibrations_are_offered_and_others_rejected(serve):
    served = serve()
    offered = served.client.get("/api/v1/calibrations").json()["available"]
    assert set(offered) == {"servo", "imu", "shaper", "mark", "camera", "camera-time", "table", "noise"}
    assert served.run(kind="calibrate", name="nothing")["error"]["code"] == 200
    assert served.run(kind="calibrate", name="noise")["error"]["code"] == 200


def test_calibration_has_its_uncertainty_budget_reference_and_validity(serve, tmp_path):
    served = serve()
    CalibrationStore(tmp_path / "cal" / "sim").add(replace(RESULT, valid_days=30.0))
    (row,) = served.client.get("/api/v1/calibrations").json()["history"]
    assert (row["reference"], row["operator"]) == ("encoder of the servo", "A. Silva")
    assert row["valid_until"] == "2026-03-31T12:00:00Z"
    assert row["software"].startswith("hbr-rig ")
    scale = row["quantities"]["scale"]
    assert (scale["value"], scale["uncertainty"], scale["expanded"]) == (1.01, 1e-4, "0.0002 1")
    (source,) = scale["budget"]
    assert source == {
        "source": "scatter",
        "kind": "A",
        "uncertainty": 1e-4,
        "unit": "1",
        "sensitivity": 1.0,
    }


@pytest.mark.nightly
def test_calibration_runs_as_a_job(serve):
    served = serve()
    job = served.run(kind="calibrate", name="servo")
    assert [one["name"] for one in job["result"]["calibrations"]] == ["servo.backlash", "servo.encoder"]
    history = served.client.get("/api/v1/calibrations").json()["history"]
    assert {one["name"] for one in history} == {"servo.backlash", "servo.encoder"}


def test_job_of_a_killed_server_is_interrupted_and_its_views_are_found_again(serve, tmp_path):
    served = serve("bench.sim.object='lamp'")
    assert served.run(kind="enroll", name="lamp", views=6)["state"] == "done"
    # A kill -9 leaves the stored jobs as they were in the middle of the work.
    file = tmp_path / "state" / "sim" / "web" / "jobs.json"
    jobs = json.loads(file.read_text())
    jobs[0] |= {"state": "running", "ended_utc": None, "result": None, "views": 3}
    served.worker.end()
    file.write_text(json.dumps(jobs))
    again = serve("bench.sim.object='lamp'")
    (job,) = again.client.get("/api/v1/jobs").json()["items"]
    assert job["state"] == "interrupted"
    assert job["resume"]["resume"]
    with Catalog.open(tmp_path / "catalog", clock=SystemClock(), read_only=True) as catalog:
        assert [one.views for one in catalog.objects()] == [6]


def test_doctor_finds_the_bench_closed_at_each_check(serve, monkeypatch):
    """A bench that is open again holds its port and its camera, and the doctor would report them as in use."""
    closed = []

    def watched(*arguments: Any) -> Any:
        for finding in run_checks(*arguments):
            closed.append(served.worker._bench is None)
            yield finding

    monkeypatch.setattr("rig.doctor.examination.run_checks", watched)
    served = serve()
    job = served.run(kind="doctor")
    assert job["state"] == "done"
    assert {"servo", "camera"} <= {one["topic"] for one in job["result"]["findings"]}
    assert len(closed) > 5
    assert all(closed)
    assert served.run(kind="home")["state"] == "done"  # and it is opened again afterwards


def test_doctor_examines_a_bench_that_cannot_be_opened(serve, monkeypatch):
    def missing(*_arguments: Any, **_options: Any) -> Bench:
        raise DeviceNotFound("The camera is missing.", next_step="Connect it.")

    monkeypatch.setattr("rig.web.worker.open_bench", missing)
    served = serve()
    assert served.run(kind="home")["error"]["detail"] == "The camera is missing."
    assert served.run(kind="doctor")["state"] == "done"


def test_rotation_waits_for_no_server_of_the_catalog(serve):
    """The log of the catalog would have to be on its server, which may not answer for a long time."""
    served = serve("catalog.url='postgresql+psycopg://ada:w0rd@host.invalid/rig'")
    assert served.run(kind="goto", angle_deg=30)["state"] == "done"
    plans = [json.loads(one.data) for one in served.server.hub.since(0)[0] if one.kind == "plan"]
    assert [one["event"] for one in plans] == ["moved"]


def test_request_has_the_parameters_of_its_job():
    union, _ = get_args(JobRequest)
    assert set(JOBS) == set(get_args(union))
    for request, job in JOBS.items():
        signature(job).bind(None, **{name: None for name in request.model_fields if name != "kind"})


@pytest.mark.parametrize(
    ("error", "state", "session"),
    [(RuntimeError("a defect"), "failed", "failed"), (KeyboardInterrupt(), "interrupted", "interrupted")],
)
def test_server_that_ends_in_a_job_stores_how_it_ended(tmp_path, monkeypatch, error, state, session):
    def fail(_event: Any) -> str:
        raise error

    monkeypatch.setattr("rig.web.work.page_line", fail)
    config = load_config(None, [f"catalog.path={tmp_path}/catalog", f"state_dir={tmp_path}/state"])
    setup = Setup(bench="sim", config=config)
    worker, _, disconnect = connected(setup)
    job = worker.queue.submit(GotoRequest(angle_deg=30), "anna")
    with pytest.raises(type(error)):
        worker.run()
    disconnect()
    assert worker.queue.job(job.id).state == state
    assert json.loads((setup.state_folder / SESSION).read_text())["ended"] == session
