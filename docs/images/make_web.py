"""Make the pictures of the pages: a served simulated bench, photographed by Chromium.

From the checkout, after `make test-web` has installed Playwright: .venv/bin/python docs/images/make_web.py

``--every FOLDER`` photographs every page in five sizes, in light and dark, to look at all of them after a change: with
enrolled objects and answers, during a job, and with a fault.
"""

import argparse
import json
import re
import shutil
import subprocess
import sys
import tempfile
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from playwright.sync_api import sync_playwright

HERE = Path(__file__).parent
RIG = [sys.executable, "-c", "from rig.cli.main import main; main()"]
WAIT_MS = 600_000  # on a busy computer
DESKTOP = {"width": 1366, "height": 768}
PHONE = {"width": 390, "height": 844}
SIZES = ((1920, 1080), (1366, 768), (1024, 768), (768, 1024), (390, 844))
SCHEMES = ("light", "dark")
NAMES = ("", "enroll", "identify", "catalog", "object?name=mug-star", "runs", "calibrations", "log", "settings")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--every", type=Path, metavar="FOLDER", help="photograph every page in all sizes, to look at")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        page = browser.new_page(viewport=DESKTOP)
        page.set_default_timeout(WAIT_MS)
        with served(folder, "bench.sim.speed=20") as url:
            photograph(page, url, None if options.every else HERE)
            if options.every:
                every(page, url, NAMES, options.every, "")
        if options.every:
            with served(folder, "bench.sim.speed=0.7", "enroll.views=72", 'bench.sim.object="radio"') as url:
                submit(url, kind="enroll", name="radio")
                submit(url, kind="tray", objects=[{"name": "vase", "label": "shelf 2"}, {"name": "dice"}])
                every(page, url, ("", "enroll"), options.every, "job-")
            jam = 'bench.sim.faults=["jam@move0", "jam@move1"]'
            with served(folder, jam, f"state_dir={folder}/jammed", 'serve.benches.left="http://127.0.0.1:9"') as url:
                submit(url, kind="goto", angle_deg=90)
                page.goto(url)
                page.wait_for_selector("#next-steps button")
                every(page, url, ("", "identify", "benches", "login"), options.every, "fault-")
        browser.close()


@contextmanager
def served(folder: str, *settings: str) -> Iterator[str]:
    """Serve a simulated bench, and yield its address."""
    given = [f"catalog.path={folder}/catalog", f"state_dir={folder}/state", f"calibration_dir={folder}/cal"]
    words = [word for one in (*given, "enroll.views=24", *settings) for word in ("--set", one)]
    command = [*RIG, "serve", "--bench", "sim", "--seed", "1", "--port", "0", *words]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as server:
        assert server.stderr is not None
        try:
            yield next(found.group() for line in server.stderr if (found := re.search(r"http://\S+/", line)))
        finally:
            server.terminate()


def submit(url: str, **values: Any) -> None:
    """Add a job to the queue."""
    body = json.dumps(values).encode()
    request = urllib.request.Request(f"{url}api/v1/jobs", body, {"Content-Type": "application/json"})
    urllib.request.urlopen(request, timeout=60).close()


def every(page: Any, url: str, names: tuple[str, ...], folder: Path, prefix: str) -> None:
    """Photograph pages in all sizes and colours, and report what is wider than its page."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        page.goto(f"{url}{name}")
        page.wait_for_timeout(2000)
        if not name and not prefix:
            page.click("#doctor")
            page.wait_for_selector("#findings li")
            page.click("#camera summary")
        page.evaluate("scrollTo(0, 0)")
        for width, height in SIZES:
            page.set_viewport_size({"width": width, "height": height})
            for scheme in SCHEMES:
                page.emulate_media(color_scheme=scheme)
                page.wait_for_timeout(400)
                file = folder / f"{prefix}{name.partition('?')[0] or 'bench'}-{width}-{scheme}.png"
                page.screenshot(path=file, full_page=name != "log")
            if page.evaluate("document.documentElement.scrollWidth") > width:
                print(f"{file}: the page is wider than {width} pixels.")
    page.emulate_media(color_scheme="light")
    page.set_viewport_size(DESKTOP)


def photograph(page: Any, url: str, folder: Path | None) -> None:
    """Enroll some objects, identify some, and take the pictures, unless ``folder`` is None."""

    def take(name: str, scheme: str = "light", from_px: int = 0) -> None:
        if folder is None:
            return
        page.evaluate(f"scrollTo(0, {from_px})")
        page.emulate_media(color_scheme=scheme)
        page.wait_for_timeout(1500)  # until all pictures are there
        page.evaluate("document.activeElement.blur()")
        page.screenshot(path=folder / f"web-{name}.jpg", type="jpeg", quality=70)
        page.emulate_media(color_scheme="light")

    def put(name: str) -> None:
        page.click(f".shelf button:text-is('{name}')")
        page.wait_for_selector(f".shelf button[aria-pressed=true]:text-is('{name}')")

    page.goto(url)
    page.click("#tour .now button")
    page.wait_for_selector("#job:has-text('Empty-table image – done')")
    put("mug-white")
    page.wait_for_selector("#tour .now:has-text('Enroll it')")
    take("bench", from_px=420)
    page.goto(f"{url}enroll")
    for name in ("mug-star", "lamp", "toy-car", "teapot", "mug-white"):
        put(name)
        page.fill("#name", name)
        page.click("#go:not([disabled])")
        if name == "teapot":
            page.wait_for_selector("#views-title:text-matches('1[2-8] views')")
            take("enroll")
        page.wait_for_selector(f"#said:has-text('{name} is enrolled')")
    page.goto(f"{url}identify")
    for name in ("lamp", "toy-car", "radio", "teapot", "mug-star"):
        put(name)
        page.click("#go:not([disabled])")
        page.wait_for_selector("#answer.calm")
        page.wait_for_selector("#answer.found, #answer.unknown")
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
    page.wait_for_selector("#answer.calm")
    page.wait_for_selector("#answer.unknown")
    take("phone", "dark")
    page.set_viewport_size(DESKTOP)


if __name__ == "__main__":
    main()
