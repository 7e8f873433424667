"""Make the picture of the page Identify: a served simulated bench, photographed by Chromium.

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


def main() -> None:
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as driver:
        given = [f"catalog.path={folder}/catalog", f"state_dir={folder}/state", f"calibration_dir={folder}/cal"]
        given += ["bench.sim.speed=20", 'bench.sim.object="mug-star"', "bench.sim.yaw_deg=70"]
        words = [word for one in given for word in ("--set", one)]
        command = [*RIG, "serve", "--bench", "sim", "--seed", "1", "--port", "0", *words]
        with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as server:
            assert server.stderr is not None
            url = next(found.group() for line in server.stderr if (found := re.search(r"http://\S+/", line)))
            browser = driver.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
            try:
                photograph(browser, url)
            finally:
                browser.close()
                server.terminate()


def photograph(browser: Any, url: str) -> None:
    """Enroll some objects, identify one, and take the picture."""
    page = browser.new_page(viewport={"width": 1200, "height": 1000})
    page.goto(f"{url}enroll")
    for name in ("mug-star", "mug-white", "lamp"):
        page.fill("#name", name)
        page.fill("#views", "24")
        page.click("#one button:has-text('Enroll')")
        page.wait_for_selector(f"#job:has-text('Enroll {name} – done')", timeout=120_000)
    page.goto(f"{url}identify")
    page.click("#start button")
    page.wait_for_selector("#job:has-text('Identify – done')", timeout=120_000)
    page.screenshot(path=HERE / "web-identify.png")


if __name__ == "__main__":
    main()
