"""What mainly the pages ask for: pictures, silhouettes, a job's events, the shelf, settings, the camera."""

import re
from importlib.resources import files

import cv2
import numpy as np
import pytest

from rig.catalog.facts import Action
from rig.core.errors import DeviceSilent

ENROLLED = ("mug-star", "mug-white")


@pytest.fixture(scope="module")
def enrolled(tmp_path_factory):
    from rig.web.worker import BenchWorker
    from tests.rig.web.conftest import starting

    with starting(tmp_path_factory.mktemp("pages")) as start:
        # An idle bench lets its virtual time pass, and how often it is idle depends on the load of the computer.
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(BenchWorker, "_idle", lambda _: None)
            served = start("bench.sim.object='mug-star'")
            jobs = [served.run(kind="enroll", name=name, views=12) for name in ENROLLED]
        assert [job["state"] for job in jobs] == ["done", "done"]
        yield served, jobs[0]["id"]


def get(served, path, status=200):
    answer = served.client.get(f"/api/v1/{path}")
    assert answer.status_code == status, answer.text
    return answer


def test_picture_of_a_pose_is_the_nearest_view(enrolled):
    served, _ = enrolled
    views = get(served, "objects/mug-star").json()["views_taken"]
    for azimuth in (0.0, 95.0, 359.0, -170.0):
        nearest = min(views, key=lambda view: abs((view["azimuth_deg"] - azimuth + 180) % 360 - 180))
        picture = get(served, f"pose-picture?object=mug-star&azimuth_deg={azimuth}")
        assert picture.headers["content-type"] == "image/jpeg"
        assert picture.content == get(served, f"views/{nearest['id']}/image").content
    get(served, "pose-picture?object=none", 404)
    get(served, "pose-picture?object=mug-star&azimuth_deg=nan", 422)


def test_twins_look_alike_from_behind_and_differ_at_the_star(enrolled):
    served, _ = enrolled
    pairs = get(served, "pairs?object=mug-star&other=mug-white").json()
    (twin,) = get(served, "objects/mug-star").json()["similar"]["objects"]
    assert twin["name"] == "mug-white"
    assert pairs["alike"]["similarity"] == pytest.approx(twin["similarity"])
    assert pairs["different"]["similarity"] < pairs["alike"]["similarity"] - 0.02
    assert any(start <= pairs["different"]["azimuth_deg"] <= end for start, end in twin["differs_deg"])
    assert abs(pairs["different"]["azimuth_deg"] - 300) < 45  # the star is printed there

    def difference(pair):
        images = [
            cv2.imdecode(np.frombuffer(get(served, f"views/{pair[key]}/image").content, np.uint8), 1).astype(float)
            for key in ("view", "other_view")
        ]
        return np.abs(images[0] - images[1]).mean()

    assert difference(pairs["different"]) > difference(pairs["alike"])
    get(served, "pairs?object=mug-star&other=none", 404)


def test_silhouette_surrounds_the_object(enrolled):
    served, _ = enrolled
    found = get(served, "silhouette?object=mug-star&index=0").json()
    points = np.array(found["points"][0])
    assert cv2.contourArea(points.astype(np.int32)) > 0.02 * found["width"] * found["height"]
    assert (points >= 0).all()
    assert (points < [found["width"], found["height"]]).all()
    get(served, "silhouette?object=mug-star&index=12", 404)


def test_events_of_a_job_are_those_of_the_stream_in_order(enrolled):
    served, job = enrolled
    found = get(served, f"jobs/{job}/events").json()
    names = [event["event"] for event in found["items"]]
    assert names.count("accepted") == 12
    assert names.index("started") < names.index("accepted") < names.index("enrolled")
    assert {event["job"] for event in found["items"]} == {job}
    assert served.server.hub.position(found["last"])[1] is False
    get(served, "jobs/none/events", 404)


def test_person_at_the_page_places_the_objects_of_a_simulated_bench(serve):
    served = serve().opened()
    assert "lamp" in get(served, "shelf").json()["things"]
    assert served.run(kind="empty-table")["state"] == "done"
    assert served.run(kind="enroll", name="lamp", views=4)["error"]["code"] == 606  # nothing is there by itself

    def by_hand(*words):
        answer = served.client.post("/api/v1/shelf", json={"words": list(words)})
        assert answer.status_code == 200, answer.text
        served.run(kind="home")  # the bench's thread has looked
        return get(served, "shelf").json()

    assert by_hand("put", "teapot")["object"] == "teapot"
    assert served.run(kind="enroll", name="a pot", views=4)["state"] == "done"
    assert by_hand("light", "0.5")["light"] == 0.5
    assert by_hand("put", "no such thing")["object"] == "teapot"
    assert by_hand("clear")["object"] is None
    assert get(served, "shelf/teapot").headers["content-type"] == "image/jpeg"
    get(served, "shelf/none", 404)


def test_unplugged_camera_of_a_simulated_bench_is_open_again_by_itself(serve, monkeypatch):
    monkeypatch.setattr("sim.bench._UNPLUGGED_S", 0.2)
    monkeypatch.setattr("rig.web.worker.REOPEN_S", 0.05)
    served = serve("bench.sim.speed=50").opened()
    served.client.post("/api/v1/shelf", json={"words": ["unplug"]})
    assert served.run(kind="empty-table")["error"]["code"] == DeviceSilent.code
    served.opened()
    assert served.run(kind="empty-table")["state"] == "done"


def test_each_action_of_the_log_has_its_sentence_on_the_page():
    script = files("rig.web").joinpath("static", "records.js").read_text()
    assert [action for action in Action if not re.search(rf'^  "?{action}"?: \(', script, re.MULTILINE)] == []


def test_bench_whose_objects_are_placed_by_a_script_has_no_shelf(enrolled):
    served, _ = enrolled
    get(served, "shelf", 404)


def test_camera_is_locked_again(serve):
    served = serve("bench.sim.object='lamp'").opened()
    assert served.run(kind="camera", exposure_us=5000, gain=2)["state"] == "done"
    assert get(served, "status").json()["locks"]["exposure_us"] == pytest.approx(5000, rel=0.1)
    assert served.run(kind="enroll", name="lamp", views=4)["state"] == "done"


def test_settings_are_written_to_the_file_and_only_harmless_ones(serve, tmp_path):
    served = serve("bench.sim.object='lamp'")
    put = lambda key, value: served.client.put(f"/api/v1/settings/{key}", json={"value": value})  # noqa: E731
    assert put("identify.max_views", 5).status_code == 403  # this server has no file
    file = tmp_path / "rig.toml"
    served.server.setup = served.server.setup.model_copy(update={"config_file": file})
    assert put("identify.max_views", 5).json() == ["+ [identify]", "+ max_views = 5"]
    assert put("identify.max_views", 900).status_code == 422
    assert put("identify.strategy", None).status_code == 200
    assert put("servo.port", "/dev/null").status_code == 403
    keys = {one["key"]: one for one in get(served, "settings").json()["keys"]}
    assert keys["identify.max_views"]["saved"] == 5
    assert keys["identify.max_views"]["editable"]
    assert not keys["servo.port"]["editable"]
    assert keys["camera.exposure_us"]["unit"] == "µs"
    assert keys["enroll.mode"]["choices"] == ["auto", "step", "fly"]
    assert keys["imu.sign"]["choices"] == ["1", "-1"]
    assert keys["identify.max_views"]["choices"] == []
