"""A day at the simulated bench, operated only by clicks in a real Chromium with its back/forward cache."""

import signal
import socket
import subprocess

import pytest

from tests.browser.conftest import RIG, call, new_context, wait_for
from tests.small import SMALL

pytestmark = pytest.mark.nightly  # make test-web runs them
PHONE = {"width": 390, "height": 844}


def enroll(page, server, name, views=8):
    page.goto(f"{server.url}enroll")
    page.fill("#name", name)
    page.click("#one summary")
    page.fill("#views", str(views))
    page.click("#go")


def enrolled(page, name):
    page.wait_for_selector(f"#said.found:has-text('{name} is enrolled')")


def job_done(page, title, state="done"):
    page.wait_for_selector(f"#job:has-text('{title} – {state}')")


def put(page, name):
    page.click(f".shelf button:has-text('{name}')")
    page.wait_for_selector(f".shelf button[aria-pressed=true]:has-text('{name}')")


@pytest.mark.parametrize("viewport", [None, PHONE], ids=["desktop", "phone"])
def test_all_pages_work_in_a_day_at_the_bench(page, serve_process, tmp_path, viewport):
    server = serve_process("bench.sim.speed=50", 'bench.sim.object="mug-star"')
    width = (viewport or {"width": 1280})["width"]
    if viewport:
        page.set_viewport_size(viewport)

    def fits():
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        if viewport:
            assert page.evaluate("document.querySelector('header').offsetHeight") <= 90

    # Enroll one object and a tray, with a question for each object of the tray.
    enroll(page, server, "lamp")
    enrolled(page, "lamp")
    assert page.locator("#thumbs img").count() == 8
    fits()
    tray = tmp_path / "tray.csv"
    tray.write_text('name,label,note,views\nmug-star,kitchen,"has a star, red",8\nteapo,kitchen,,8\n')
    page.set_input_files("#file", tray)
    page.fill("#rows input[aria-label='name of teapo']", "teapot")  # the list can be corrected
    page.click("#tray-start")
    for name in ("mug-star", "teapot"):
        page.wait_for_selector(f".question:has-text('put {name} (kitchen) on the table')")
        page.click(".question button:has-text('Continue')")
    page.wait_for_selector("#said:has-text('The tray is enrolled')")
    assert page.locator("#rows .tag:has-text('enrolled')").count() == 2
    # Identify. After a reload of the page, answer, candidates and steps are still there.
    page.goto(f"{server.url}identify")
    page.fill("#sample", "S-1")
    page.click("#go")
    page.wait_for_selector("#answer.found:has-text('mug-star')")
    box = [float(page.get_attribute("#marks rect", key)) for key in ("width", "height")]
    assert 100 < box[0] < box[1] < 300  # of a mug
    for _ in range(2):
        page.wait_for_selector("#answer.found:has-text('mug-star')")
        page.locator("#enrolled img").evaluate("(image) => image.decode()")
        assert "mug-star" in page.get_attribute("#enrolled img", "alt")
        page.wait_for_selector("#candidates li:has-text('mug-star') .bar.c0")  # the first candidate keeps its colour
        page.wait_for_selector("#steps li:has-text('View 1: looks like')")
        page.wait_for_selector("#last li:has-text('S-1')")
        fits()
        page.reload()
    # Look at the answer, and correct it.
    page.goto(f"{server.url}runs")
    page.click("#answers button:has-text('Details')")
    page.click("dialog button:has-text('Compute it again')")
    page.wait_for_selector("#toasts:has-text('All are as saved.')")
    page.click("dialog button:has-text('Correct it')")
    page.select_option("#right-object", "teapot")
    page.fill("#right-reason", "the label was read")
    page.click("dialog button:has-text('Save')")
    page.wait_for_selector("#answers td:has-text('corrected, was mug-star')")
    fits()
    # Rename an object, delete it, and bring it back.
    page.goto(f"{server.url}catalog")
    page.fill("#search", "star")
    page.wait_for_selector("#count:has-text('1 object')")
    page.click(".cards a")
    page.wait_for_selector("#viewer .number")
    first = page.text_content("#viewer .number")
    page.focus("#viewer input")
    page.keyboard.press("ArrowRight")
    assert page.text_content("#viewer .number") != first
    page.click("#outline-on")
    page.wait_for_selector("#viewer polygon", state="attached")
    fits()
    page.click("#rename")
    page.fill("dialog input", "mug-red-star")
    page.click("dialog button:has-text('Rename')")
    page.wait_for_selector("#object-name:has-text('mug-red-star')")
    page.click("#delete")
    page.click(".toast:has-text('deleted') button:has-text('Undo')")
    page.wait_for_selector("#object-name:has-text('mug-red-star')")
    page.click("#delete")
    page.wait_for_selector(".toast:has-text('deleted')")
    page.goto(f"{server.url}catalog")
    page.check("#deleted")
    page.click(".cards button:has-text('mug-red-star')")
    page.wait_for_selector("#count:has-text('0 objects')")
    page.uncheck("#deleted")
    page.wait_for_selector(".cards a:has-text('mug-red-star')")
    # The bench: rotate, check, stop.
    page.goto(server.url)
    page.wait_for_selector("#state.good")
    page.wait_for_selector("#states .current:has-text('ready')", state="attached")
    page.fill("#angle", "90")
    page.click("#goto button")
    job_done(page, "Rotate to 90°")
    page.wait_for_selector("#dial-text:has-text('89.')")  # friction holds the table half a degree short
    rotated = page.get_attribute("#needle", "transform")
    assert rotated.startswith("rotate(-89")  # counter-clockwise from the top, as the table rotates seen from above
    assert page.get_attribute("#gyro", "transform").startswith("rotate(-89")
    page.click("#jog button:has-text('−5')")
    page.wait_for_selector("#dial-text:has-text('84.')")
    page.click("#doctor")
    page.wait_for_selector("#findings li:has-text('calibration')")
    assert "in use" not in page.text_content("#findings")
    fits()
    for name in ("calibrations", "log", "settings"):
        page.goto(f"{server.url}{name}")
        page.wait_for_selector(".cards button, #log li time, .setting")
        fits()
        if name == "log":
            sentences = page.locator("#log").inner_text()
            for words in (
                "enrolled lamp with 8 views.",
                "identified mug-star, sample S-1.",
                "rotated the table to 90.0°.",
            ):
                assert words in sentences
    assert server.kill(signal.SIGTERM) == 128 + signal.SIGTERM


def test_first_contact_leads_from_an_empty_table_to_an_answer(page, serve_process):
    server = serve_process("bench.sim.speed=50", "enroll.views=12")
    page.goto(server.url)
    page.click("#tour .now button:has-text('Take the image')")
    for name in ("lamp", "teapot"):  # only what a person put there is on the table
        page.goto(f"{server.url}enroll")
        page.wait_for_selector(
            "rig-shelf :text('The table is empty')" if name == "lamp" else ".shelf [aria-pressed=true]"
        )
        put(page, name)
        page.fill("#name", f"my {name}")
        page.click("#go")
        enrolled(page, f"my {name}")
    page.goto(f"{server.url}identify")
    for name in ("lamp", "teapot", "lamp"):
        put(page, name)
        page.click("#go:not([disabled])")
        page.wait_for_selector(f"#answer.found:has-text('my {name}')")
    put(page, "radio")
    page.click("#go:not([disabled])")
    page.wait_for_selector("#answer.unknown:has-text('Unknown object')")
    assert "sure" not in page.text_content("#answer-detail")
    page.click("rig-shelf button:has-text('Clear the table')")
    page.wait_for_selector("rig-shelf :text('The table is empty')")
    page.click("#go:not([disabled])")
    page.wait_for_selector("#answer:has-text('No object on the table')")
    page.goto(server.url)
    page.click("rig-shelf button:has-text('Unplug the camera')")
    page.wait_for_selector("#live.stale")
    page.wait_for_selector("#live:not(.stale)")  # it is plugged in again


def test_stop_button_above_an_open_dialog_stops_the_table(page, serve_process):
    server = serve_process("bench.sim.speed=5", 'bench.sim.object="lamp"')
    enroll(page, server, "lamp", 24)
    page.wait_for_selector("#thumbs img")
    page.goto(f"{server.url}object?name=lamp")
    page.click("#rename")
    page.wait_for_selector("dialog[open]")
    page.click("#stop")
    page.wait_for_selector("#stop-state:has-text('Stopped')")
    page.goto(f"{server.url}enroll")
    page.wait_for_selector("#said:has-text('Interrupted')")
    page.click("#said-detail button:has-text('Continue')")
    page.wait_for_selector("#job progress")


def test_watch_mode_names_one_object_after_the_other(page, serve_process):
    server = serve_process("bench.sim.speed=50", 'bench.sim.object=["lamp", "mug-star"]')
    for name in ("lamp", "mug-star"):
        enroll(page, server, name, 6)
        enrolled(page, name)
    page.goto(f"{server.url}identify")
    page.click("label:has(#watch)")
    assert page.is_disabled("#sample")
    page.click("#go")
    for name in ("lamp", "mug-star", "lamp"):
        page.wait_for_selector(f"#answer.found:has-text('{name}')")
    assert page.locator("#last li").count() >= 2
    page.click("#job button:has-text('Finish')")
    page.wait_for_selector("#job button", state="detached")
    assert page.locator("#answer.found").count() == 1  # the last answer stays


def test_answer_is_shown_beside_the_enrolled_object_that_looks_most_like_it(page, serve_process):
    server = serve_process("bench.sim.speed=1000", 'bench.sim.object="lamp"', *SMALL)
    for name in ("lamp", "mug-star", "mug-white"):
        job = call(server, "jobs", {"kind": "enroll", "name": name, "views": 12})["id"]
        wait_for(server, job, "done")
    # Stored searches: the panel must not depend on the views that a search takes, nor on the load of the computer.
    candidates = [{"name": "mug-star", "score": 0.9, "pose_deg": 20.0, "probability": 0.99}]
    answer = {"event": "identified", "outcome": "found", "name": "mug-star", "views": 1, "candidates": candidates}
    stored = {**call(server, f"jobs/{job}"), "id": "stored", "request": {"kind": "identify", "watch": False}}

    def open_with(**values):
        events = {"items": [{"event": "started", "job": "stored"}, {**answer, **values, "job": "stored"}], "last": "0"}
        page.unroute_all()
        page.route("**/api/v1/jobs?limit=50", lambda route: route.fulfill(json={"items": [stored], "next": None}))
        page.route("**/api/v1/jobs/stored/events", lambda route: route.fulfill(json=events))
        page.goto(f"{server.url}identify")

    for values, words in (
        ({}, "mug-star and mug-white differ most here"),
        ({"outcome": "ambiguous", "possible": ["mug-white", "mug-star"]}, "mug-white and mug-star differ most here"),
    ):
        open_with(**values)
        page.wait_for_selector(f"#twin-title:has-text('{words}')")
        for image in page.locator("#twin img").all():
            image.evaluate("(image) => image.decode()")
        assert page.locator("#twin img").count() == 2
    lamp = {"name": "lamp", "candidates": [{**candidates[0], "name": "lamp"}, {**candidates[0], "name": "mug-star"}]}
    with page.expect_response("**/api/v1/objects/lamp"):  # the page asks, and the lamp looks like no other object
        open_with(**lamp)
    page.wait_for_selector("#answer.found:has-text('lamp')")
    assert page.is_hidden("#twin")


def test_second_tab_is_the_same_operator_and_a_second_browser_takes_over(page, chromium, serve_process):
    server = serve_process("bench.sim.speed=4", 'bench.sim.object="lamp"')
    enroll(page, server, "lamp", 360)  # more views than a slow computer needs for what follows
    page.wait_for_selector("#thumbs img")
    page.reload()  # in the middle of the job
    page.wait_for_selector("#thumbs img")
    tab = page.context.new_page()
    tab.goto(f"{server.url}enroll")
    tab.wait_for_selector("#lease:has-text('You operate')")
    tab.click("#job button:has-text('Pause')")
    tab.click("#job button:has-text('Resume')")
    tab.close()
    other = new_context(chromium).new_page()
    other.goto(f"{server.url}enroll")
    other.wait_for_selector("#thumbs img")
    other.wait_for_selector("#lease:has-text('operates')")
    other.click("#job button:has-text('Pause')")
    other.click("dialog button:has-text('Take over')")
    page.wait_for_selector("#messages:has-text('has taken over')")
    other.wait_for_selector("#lease:has-text('You operate')")
    other.click("#job button:has-text('Pause')")
    page.wait_for_selector("#said-detail:has-text('Paused')")
    page.click("#job button:has-text('Resume')")
    page.click("dialog button:has-text('Take over')")
    other.wait_for_selector("#messages:has-text('has taken over')")
    other.context.close()


def test_server_killed_in_an_enrollment_loses_no_view(page, serve_process):
    server = serve_process("bench.sim.speed=5", 'bench.sim.object="lamp"')
    enroll(page, server, "lamp", 24)
    page.wait_for_selector("#thumbs li:nth-child(3) img")
    shown = page.locator("#thumbs img").count()
    server.kill(signal.SIGKILL)
    again = serve_process("bench.sim.speed=50", 'bench.sim.object="lamp"')
    page.goto(f"{again.url}enroll")
    page.wait_for_selector("#said:has-text('Interrupted')")
    page.goto(f"{again.url}catalog")
    text = page.text_content(".cards a:has-text('lamp')")
    assert int(text.split("interrupted, ")[1].split()[0]) >= shown
    page.goto(again.url)
    page.wait_for_selector("#states .current", state="attached")
    if page.locator("#set-angle").is_visible():  # killed in a motion
        page.click("#set-angle button:has-text('Set')")
        page.wait_for_selector("#states .current:has-text('ready')", state="attached")
    page.goto(f"{again.url}enroll")
    page.click("#said-detail button:has-text('Continue')")
    enrolled(page, "lamp")
    page.goto(f"{again.url}catalog")
    page.wait_for_selector(".cards a:has-text('24 views')")


def test_login_is_needed_for_another_address(page, serve_process, tmp_path):
    base = [*RIG, "serve", "--bench", "sim", "--set", f"state_dir={tmp_path}/state"]
    token = subprocess.run(
        [*base, "--new-token", "tablet", "--role", "watch"], capture_output=True, text=True, check=True
    ).stdout.strip()
    server = serve_process(options=("--host", "0.0.0.0"))
    url = server.url.replace("0.0.0.0", "127.0.0.1")
    page.goto(f"{url}identify")
    page.wait_for_selector("#token")
    page.fill("#token", "rig_wrong")
    page.click("#login button")
    page.wait_for_selector("#login-error:has-text('unknown')")
    page.fill("#token", token)
    page.click("#login button")
    page.wait_for_selector("#state.good")
    page.click("#home")
    page.wait_for_selector("#messages:has-text('may only watch')")
    page.click(".shelf button >> nth=0")
    page.wait_for_selector("#messages:has-text('may only watch')")
    page.goto(f"{url}settings")
    assert page.locator(".setting input:not([disabled])").count() == 0


def test_settings_are_searched_changed_and_undone(page, serve_process, tmp_path):
    file = tmp_path / "rig.toml"
    file.write_text("")
    server = serve_process(options=("--config", str(file)))
    page.goto(f"{server.url}settings")
    page.fill("#search", "number of views")
    page.fill("#search", "max_views")
    page.fill("[id='set-identify.max_views']", "900")
    page.keyboard.press("Enter")
    page.wait_for_selector("#messages:has-text('unchanged')")
    page.fill("[id='set-identify.max_views']", "5")
    page.keyboard.press("Enter")
    page.wait_for_selector("#restart:has-text('identify.max_views')")
    assert "max_views = 5" in file.read_text()
    page.click(".toast button:has-text('Undo')")
    page.wait_for_selector("#restart:not(:has-text('identify.max_views'))", state="attached")
    assert page.is_disabled("[id='set-identify.max_views']") is False
    page.fill("#search", "servo.port")
    assert page.is_disabled("[id='set-servo.port']")


def test_pages_pass_axe(page, serve_process):
    axe = pytest.importorskip("axe_playwright_python.sync_playwright", reason="make test-web installs axe")
    # One other bench has the state of this one, because it is this one; the other one does not answer.
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    benches = [f'serve.benches.left="http://127.0.0.1:{port}"', 'serve.benches.off="http://127.0.0.1:9"']
    server = serve_process("bench.sim.speed=50", "enroll.views=6", *benches, options=("--port", str(port)))
    page.goto(f"{server.url}enroll")
    for name in ("mug-star", "mug-white"):
        put(page, name)
        page.fill("#name", name)
        page.click("#go:not([disabled])")
        enrolled(page, name)
    page.wait_for_selector("#similar-title:has-text('mug-white looks like mug-star')")
    assert page.locator("#similar figure img").count() == 4
    page.goto(f"{server.url}identify")
    page.click("#go")
    page.wait_for_selector("#answer.found, #answer.ambiguous, #answer.unknown")
    page.goto(server.url)
    page.click("#doctor")
    page.wait_for_selector("#findings li")
    found = {}
    for scheme in ("light", "dark"):
        page.emulate_media(color_scheme=scheme)
        names = ("", "enroll", "identify", "catalog", "object?name=mug-star", "calibrations", "runs", "log", "settings")
        for name in (*names, "benches", "login"):
            page.goto(f"{server.url}{name}")
            if name == "benches":
                page.wait_for_selector("#benches section:has-text('Ready')")
                page.wait_for_selector("#benches .error:has-text('does not answer')")
            page.wait_for_timeout(600)
            if name == "":
                page.click("#camera summary")
            if name == "runs":
                page.click("#answers button:has-text('Details')")
                page.wait_for_selector("dialog[open]")
            result = axe.Axe().run(page)
            if result.violations_count:
                found[scheme, name] = [(one["id"], one["nodes"][0]["html"]) for one in result.response["violations"]]
    assert found == {}


def test_search_in_motion_shows_its_frames_and_stop_ends_it_during_the_rotation(page, serve_process):
    known = ("camera_time.offset_ms=8", "camera_time.uncertainty_ms=0.3", "camera_time.jitter_ms=0.3")
    server = serve_process("bench.sim.speed=1", 'bench.sim.object="bottle-harvest"', *known)
    for name in ("bottle-green", "bottle-harvest"):  # twins: one view does not distinguish them
        enroll(page, server, name, 6)
        enrolled(page, name)
    page.goto(f"{server.url}identify")
    page.click("#go")
    page.wait_for_selector("#answer:has-text('Searching …'), #answer:has-text('Looks like')")
    page.click("#stop")
    page.wait_for_selector("#stop-state:has-text('Stopped')")
    page.wait_for_selector("#answer:has-text('Stopped')")
    assert page.locator("#answer.found").count() == 0


def test_bad_view_is_taken_again_unless_the_object_stands_otherwise(page, serve_process):
    server = serve_process("bench.sim.speed=50", "enroll.views=6", *SMALL)
    page.goto(f"{server.url}enroll")
    put(page, "teapot")
    page.fill("#name", "teapot")
    page.click("#go:not([disabled])")
    enrolled(page, "teapot")
    before = call(server, "objects/teapot")["views_taken"]
    page.goto(f"{server.url}object?name=teapot")
    page.wait_for_selector("#viewer .number")
    page.focus("#viewer input")
    page.keyboard.press("ArrowRight")
    place = page.text_content("#viewer .number")
    page.click("#retake")
    page.click("dialog button:has-text('Take it again')")
    page.wait_for_selector(".toast:has-text('was taken again')")
    page.wait_for_selector("#enrollments li:has-text('replaced')")
    assert page.text_content("#viewer .number") == place
    after = call(server, "objects/teapot")["views_taken"]
    images = [[one["captured_utc"] for one in views] for views in (before, after)]
    assert sum(old != new for old, new in zip(*images, strict=True)) == 1
    # Put again, it stands otherwise: the views stay as they are.
    page.goto(server.url)
    put(page, "lamp")
    put(page, "teapot")
    page.goto(f"{server.url}object?name=teapot")
    page.click("#retake")
    page.click("dialog button:has-text('Take it again')")
    page.wait_for_selector("#job .failure:has-text('does not stand as it stood')")
    assert call(server, "objects/teapot")["views_taken"] == after
