"""A day at the simulated bench, operated only by clicks in a real Chromium."""

import signal
import subprocess
import sys

import pytest

RIG = [sys.executable, "-c", "from rig.cli.main import main; main()"]
pytestmark = pytest.mark.nightly  # make test-web runs them
PHONE = {"width": 375, "height": 740}
WAIT_MS = 60_000


def enroll(page, server, name, views=8):
    page.goto(f"{server.url}enroll")
    page.fill("#name", name)
    page.fill("#views", str(views))
    page.click("#one button:has-text('Enroll')")


def job_done(page, title, state="done"):
    page.wait_for_selector(f"#job:has-text('{title} – {state}')", timeout=WAIT_MS)


@pytest.mark.parametrize("viewport", [None, PHONE], ids=["desktop", "phone"])
def test_all_pages_work_in_a_day_at_the_bench(page, serve_process, tmp_path, viewport):
    server = serve_process("bench.sim.speed=50", 'bench.sim.object="mug-star"')
    if viewport:
        page.set_viewport_size(viewport)
    # Enroll one object and a tray, with a question for each object of the tray.
    enroll(page, server, "lamp")
    job_done(page, "Enroll lamp")
    assert page.locator("#thumbs img").count() == 8
    tray = tmp_path / "tray.csv"
    tray.write_text('name,label,note,views\nmug-star,kitchen,"has a star, red",8\nteapot,kitchen,,8\n')
    page.set_input_files("#file", tray)
    page.click("#tray-start")
    for name in ("mug-star", "teapot"):
        page.wait_for_selector(f".question:has-text('put {name} (kitchen) on the table')", timeout=WAIT_MS)
        page.click(".question button:has-text('Continue')")
    job_done(page, "Enroll a tray")
    # Identify.
    page.goto(f"{server.url}identify")
    page.fill("#sample", "S-1")
    page.click("#start button:has-text('Identify')")
    page.wait_for_selector("#answer.found:has-text('mug-star')", timeout=WAIT_MS)
    page.wait_for_function("document.querySelector('#candidates img').naturalWidth > 0")
    assert "mug-star" in page.get_attribute("#candidates img", "alt")
    # Look at the run, and compute it again.
    page.goto(f"{server.url}runs")
    page.click("#runs button")
    page.click("text=Compute again")
    page.wait_for_selector("#checked:has-text('All are as saved')", timeout=WAIT_MS)
    # Rename an object, delete it, and bring it back.
    page.goto(f"{server.url}catalog")
    page.fill("#search", "star")
    page.wait_for_selector("#count:has-text('1 object')")
    page.click(".cards button")
    page.wait_for_selector("#object .thumbs li:nth-of-type(8) img")
    page.fill("#new-name", "mug-red-star")
    page.click("#edit button:has-text('Save')")
    page.wait_for_selector(".cards button:has-text('mug-red-star')")
    page.click(".cards button")
    page.click("#delete")
    page.wait_for_selector("#count:has-text('0 objects')")
    page.check("#deleted")
    page.click(".cards button:has-text('mug-red-star')")
    page.wait_for_selector("#count:has-text('0 objects')")
    page.uncheck("#deleted")
    page.wait_for_selector(".cards button:has-text('mug-red-star')")
    # The bench: rotate, check, stop.
    page.goto(server.url)
    page.wait_for_selector("#state.good")
    page.wait_for_selector("#states .current:has-text('ready')")
    page.fill("#angle", "90")
    page.click("#goto button")
    job_done(page, "Rotate to 90°")
    page.wait_for_selector("#dial-text:has-text('89.')")  # friction holds the table half a degree short
    rotated = page.get_attribute("#needle", "transform")
    assert rotated.startswith("rotate(-89")  # counter-clockwise from the top, as the table rotates seen from above
    page.click("#doctor")
    page.wait_for_selector("#findings li:has-text('servo')", timeout=WAIT_MS)
    assert page.evaluate("document.documentElement.scrollWidth") <= (viewport or {"width": 1280})["width"]
    for name in ("calibrations", "log", "settings"):
        page.goto(f"{server.url}{name}")
        page.wait_for_selector("table td, #available button")
    assert server.kill(signal.SIGTERM) == 128 + signal.SIGTERM


def test_stop_button_above_an_open_dialog_stops_the_table(page, serve_process):
    server = serve_process("bench.sim.speed=5")
    enroll(page, server, "lamp", 24)
    page.wait_for_selector("#thumbs img", timeout=WAIT_MS)
    page.goto(f"{server.url}catalog")
    page.click("#stop")
    page.wait_for_selector("#stop-state:has-text('Stopped')", timeout=WAIT_MS)
    page.goto(f"{server.url}enroll")
    job_done(page, "Enroll lamp", "cancelled")
    page.click("#job button:has-text('Continue')")
    page.wait_for_selector("#job:has-text('running')", timeout=WAIT_MS)


def test_watch_mode_names_one_object_after_the_other(page, serve_process):
    server = serve_process("bench.sim.speed=50", 'bench.sim.object=["lamp", "mug-star"]')
    for name in ("lamp", "mug-star"):
        enroll(page, server, name, 6)
        job_done(page, f"Enroll {name}")
    page.goto(f"{server.url}identify")
    page.check("#watch")
    page.click("#start button:has-text('Identify')")
    for name in ("lamp", "mug-star", "lamp"):
        page.wait_for_selector(f"#answer.found:has-text('{name}')", timeout=WAIT_MS)
    page.click("#job button:has-text('Cancel')")
    job_done(page, "Identify", "cancelled")


def test_page_of_a_search_says_what_its_numbers_mean(page, serve_process):
    server = serve_process("bench.sim.speed=50", 'bench.sim.object="radio"')
    for name in ("lamp", "mug-star"):
        enroll(page, server, name, 6)
        job_done(page, f"Enroll {name}")
    page.goto(f"{server.url}identify")
    page.check("#watch")
    assert page.is_disabled("#sample")
    assert page.is_visible("#sample-why:has-text('A sample names one object')")
    page.uncheck("#watch")
    assert page.is_enabled("#sample")
    assert page.is_hidden("#sample-why")
    page.click("#start button:has-text('Identify')")
    page.wait_for_selector("#answer.unknown:has-text('Unknown object')", timeout=WAIT_MS)
    page.wait_for_selector("#candidates img[alt*='not enrolled']")
    script = "async () => (await fetch(document.querySelector('#candidates img').src)).text()"
    assert "not enrolled" in page.evaluate(script)
    # An empty table is no object, and no unknown one.
    error = {"what": "No object is on the table.", "steps": ["Put the object on the table."], "code": 606}
    script = "async (error) => (await import('/static/identify.js')).noAnswer(error)"
    page.evaluate(script, error)
    assert page.text_content("#answer") == "No object on the table"
    page.goto(f"{server.url}runs")
    cells = page.locator("#answers tbody td")
    cells.first.wait_for()
    assert [cells.nth(k).text_content() for k in (2, 3)] == ["unknown object", ""]


def test_second_browser_watches_and_takes_over(page, chromium, serve_process):
    server = serve_process("bench.sim.speed=4")
    enroll(page, server, "lamp", 24)
    page.wait_for_selector("#thumbs img", timeout=WAIT_MS)
    page.reload()  # in the middle of the job
    page.wait_for_selector("#thumbs img", timeout=WAIT_MS)
    other = chromium.new_context().new_page()
    other.goto(f"{server.url}enroll")
    other.wait_for_selector("#thumbs img", timeout=WAIT_MS)
    other.wait_for_selector("#lease:has-text('operates')")
    other.click("#job button:has-text('Pause')")
    other.wait_for_selector("#lease-dialog[open]")
    other.click("#lease-dialog button:has-text('Take over')")
    page.wait_for_selector("#messages:has-text('has taken over')")
    other.wait_for_selector("#lease:has-text('You operate')")
    other.click("#job button:has-text('Pause')")
    job_done(page, "Enroll lamp", "paused")
    page.click("#job button:has-text('Resume')")
    page.wait_for_selector("#lease-dialog[open]")
    page.click("#lease-dialog button:has-text('Take over')")
    other.wait_for_selector("#messages:has-text('has taken over')")
    other.context.close()


def test_server_killed_in_an_enrollment_loses_no_view(page, serve_process):
    server = serve_process("bench.sim.speed=5")
    enroll(page, server, "lamp", 24)
    page.wait_for_selector("#thumbs li:nth-child(3) img", timeout=WAIT_MS)
    shown = page.locator("#thumbs img").count()
    server.kill(signal.SIGKILL)
    again = serve_process("bench.sim.speed=50")
    page.goto(f"{again.url}enroll")
    page.wait_for_selector("#job:has-text('Enroll lamp – interrupted')", timeout=WAIT_MS)
    page.goto(f"{again.url}catalog")
    text = page.text_content(".cards button:has-text('lamp')")
    assert int(text.split("interrupted, ")[1].split()[0]) >= shown
    page.goto(again.url)
    page.wait_for_selector("#states .current")
    if page.locator("#set-angle").is_visible():  # killed in a motion
        page.click("#set-angle button:has-text('Set')")
        page.wait_for_selector("#states .current:has-text('ready')")
    page.goto(f"{again.url}enroll")
    page.click("#job button:has-text('Continue')")
    job_done(page, "Enroll lamp")
    page.goto(f"{again.url}catalog")
    page.wait_for_selector(".cards button:has-text('24 views')")


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
    page.wait_for_selector("#state.good", timeout=WAIT_MS)
    page.click("#home")
    page.wait_for_selector("#messages:has-text('may only watch')")


def test_pages_pass_axe(page, serve_process):
    axe = pytest.importorskip("axe_playwright_python.sync_playwright", reason="make test-web installs axe")
    server = serve_process("bench.sim.speed=50", 'bench.sim.object="lamp"')
    enroll(page, server, "lamp", 6)
    job_done(page, "Enroll lamp")
    found = {}
    for scheme in ("light", "dark"):
        page.emulate_media(color_scheme=scheme)
        for name in ("", "enroll", "identify", "catalog", "calibrations", "runs", "log", "settings", "login"):
            page.goto(f"{server.url}{name}")
            page.wait_for_timeout(300)
            if name == "catalog":
                page.click(".cards button")
                page.wait_for_selector("#object[open]")
            result = axe.Axe().run(page)
            if result.violations_count:
                found[scheme, name] = [(one["id"], one["nodes"][0]["html"]) for one in result.response["violations"]]
    assert found == {}


def test_search_in_motion_shows_its_frames_and_stop_ends_it_during_the_rotation(page, serve_process):
    known = ("camera_time.offset_ms=8", "camera_time.uncertainty_ms=0.3", "camera_time.jitter_ms=0.3")
    server = serve_process("bench.sim.speed=1", 'bench.sim.object="bottle-harvest"', *known)
    for name in ("bottle-green", "bottle-harvest"):  # twins: one view does not distinguish them
        enroll(page, server, name, 6)
        job_done(page, f"Enroll {name}")
    page.goto(f"{server.url}identify")
    page.click("#start button:has-text('Identify')")
    page.wait_for_selector("#answer:has-text('Searching …')", timeout=WAIT_MS)
    page.click("#stop")
    page.wait_for_selector("#stop-state:has-text('Stopped')", timeout=WAIT_MS)
    job_done(page, "Identify", "cancelled")
    assert page.locator("#answer.found").count() == 0
