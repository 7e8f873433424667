"""Make the pictures of the pages: a served simulated bench, photographed by Chromium.

From the checkout, after `make test-web` has installed Playwright: .venv/bin/python docs/images/make_web.py
"""

import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from playwright.sync_api import sync_playwright

HERE = Path(__file__).parent
RIG = [sys.executable, "-c", "from rig.cli.main import main; main()"]
WAIT_MS = 120_000
DESKTOP = {"width": 1366, "height": 768}
PHONE = {"width": 390, "height": 844}


def main() -> None:
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as driver:
        given = [f"catalog.path={folder}/catalog", f"state_dir={folder}/state", f"calibration_dir={folder}/cal"]
        given += ["bench.sim.speed=20", "enroll.views=24"]
        words = [word for one in given for word in ("--set", one)]
        command = [*RIG, "serve", "--bench", "sim", "--seed", "1", "--port", "0", *words]
        with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as server:
            assert server.stderr is not None
            url = next(found.group() for line in server.stderr if (found := re.search(r"http://\S+/", line)))
            browser = driver.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
            try:
                photograph(browser.new_page(viewport=DESKTOP), url)
            finally:
                browser.close()
                server.terminate()


def photograph(page: Any, url: str) -> None:
    """Enroll some objects, identify some, and take the pictures."""

    def take(name: str, scheme: str = "light", from_px: int = 0) -> None:
        page.evaluate(f"scrollTo(0, {from_px})")
        page.emulate_media(color_scheme=scheme)
        page.wait_for_timeout(1500)  # until all pictures are there
        page.evaluate("document.activeElement.blur()")
        page.screenshot(path=HERE / f"web-{name}.jpg", type="jpeg", quality=70)
        page.emulate_media(color_scheme="light")

    def put(name: str) -> None:
        page.click(f".shelf button:text-is('{name}')")
        page.wait_for_selector(f".shelf button[aria-pressed=true]:text-is('{name}')")

    page.goto(url)
    page.click("#tour .now button")
    page.wait_for_selector("#job:has-text('Empty-table image – done')", timeout=WAIT_MS)
    put("mug-white")
    page.wait_for_selector("#tour .now:has-text('Enroll it')")
    take("bench", from_px=420)
    page.goto(f"{url}enroll")
    for name in ("mug-star", "lamp", "toy-car", "teapot", "mug-white"):
        put(name)
        page.fill("#name", name)
        page.click("#go:not([disabled])")
        if name == "teapot":
            page.wait_for_selector("#views-title:has-text('15 views')", timeout=WAIT_MS)
            take("enroll")
        page.wait_for_selector(f"#said:has-text('{name} is enrolled')", timeout=WAIT_MS)
    page.goto(f"{url}identify")
    for name in ("lamp", "toy-car", "radio", "teapot", "mug-star"):
        put(name)
        page.click("#go:not([disabled])")
        page.wait_for_selector("#answer.calm", timeout=WAIT_MS)
        page.wait_for_selector("#answer.found, #answer.unknown", timeout=WAIT_MS)
    take("identify")
    page.goto(f"{url}object?name=mug-star")
    page.wait_for_selector("#viewer .number")
    page.evaluate("document.getElementById('viewer').showPlace(21)")
    page.click("#outline-on")
    take("object", "dark")
    page.goto(f"{url}runs")
    take("history")
    page.set_viewport_size(PHONE)
    page.goto(f"{url}identify")
    put("radio")
    page.click("#go")
    page.wait_for_selector("#answer.calm", timeout=WAIT_MS)
    page.wait_for_selector("#answer.unknown", timeout=WAIT_MS)
    take("phone", "dark")


if __name__ == "__main__":
    main()
