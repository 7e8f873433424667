"""The next step of an error in a real Chromium: sentences, and buttons and links that do it."""

import pytest

from tests.browser.conftest import call, wait_for
from tests.browser.test_day import PHONE

pytestmark = pytest.mark.nightly  # make test-web runs them


def rotate(page, server, angle_deg):
    page.goto(server.url)
    page.fill("#angle", str(angle_deg))
    page.click("#goto button")


@pytest.mark.parametrize("stored", [True, False], ids=["stored", "only in the program"])
def test_fault_is_acknowledged_on_any_page(page, serve_process, stored, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    # Moves are counted by the views before them, and the live image may be one.
    settings = ['bench.sim.faults=["jam@move0", "jam@move1"]']
    server = serve_process(*settings, *([] if stored else ["state_dir=none"]))
    rotate(page, server, 90)
    page.wait_for_selector("#state:text-is('Fault 505')")
    page.wait_for_selector("#next-steps:has-text('The table is blocked'):has-text('Remove what blocks the table')")
    page.goto(f"{server.url}enroll")
    page.set_viewport_size(PHONE)
    page.wait_for_selector("#next-steps button:has-text('Acknowledge the fault')")
    assert page.evaluate("document.querySelector('header').offsetHeight") <= 90  # a fault hides no more of the page
    page.click("#next-steps button:has-text('Acknowledge the fault')")
    page.wait_for_selector("#state:has-text('Ready')")
    assert page.text_content("#next-steps") == ""


def test_errors_name_no_command_that_a_page_can_do(page, serve_process):
    server = serve_process("bench.sim.speed=20", 'enroll.mode="fly"', 'bench.sim.object="lamp"')
    page.goto(f"{server.url}enroll")
    page.fill("#name", "lamp")
    page.click("#go")
    page.wait_for_selector("#said-detail a[href='/calibrations']:has-text('Run the calibration camera-time')")
    page.goto(f"{server.url}identify")
    page.click("#go")
    page.wait_for_selector("#answer-detail a[href='/enroll']:has-text('Enroll an object')")
    page.goto(server.url)
    page.click("#doctor")
    page.wait_for_selector("#findings a[href='/calibrations']")
    assert "rig calibrate" not in page.inner_text("body")
    page.evaluate(
        "async (steps) => (await import('/static/rig.js')).show({ message: 'No.', steps })",
        [
            {"action": "verify-catalog", "parameters": {}, "command": "rig catalog verify"},
        ],
    )
    assert "at a terminal of the bench's computer: rig catalog verify" in page.inner_text("#messages")


def test_late_list_of_jobs_does_not_replace_what_an_event_has_told(page, serve_process):
    server = serve_process()
    late = []
    page.route("**/api/v1/jobs?limit=50", lambda route: late.append((route, route.fetch())))
    job = call(server, "jobs", {"kind": "goto", "angle_deg": 90})["id"]
    page.goto(server.url)
    page.wait_for_selector("#job:has-text('done')")
    wait_for(server, job, "done")
    route, answer = late[0]
    assert answer.json()["items"][0]["state"] != "done"
    with page.expect_response("**/api/v1/jobs?limit=50"):
        route.fulfill(response=answer)
    page.evaluate("new Promise(requestAnimationFrame)")
    assert "done" in page.inner_text("#job")
