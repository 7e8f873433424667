"""A day at the simulated bench with the keyboard alone: no click, and no focus that a script has set."""

import pytest

pytestmark = pytest.mark.nightly  # make test-web runs them
STOPS = 120  # places that Tab may pass before what is wanted: more are too many for a person
UNSEEN = """() => {
  const one = document.activeElement;
  if (one === document.body) return null;
  const shown = one.closest('.choice label, rig-viewer input') || (one.type === 'file' ? one.labels[0] : one);
  const { outlineStyle, outlineWidth } = getComputedStyle(shown);
  const box = shown.getBoundingClientRect();
  const header = document.querySelector('header').getBoundingClientRect();
  const covered = !one.closest('header, dialog, .toast, .skip') && box.bottom <= header.bottom + 2;
  const fine = outlineStyle !== 'none' && parseFloat(outlineWidth) >= 2 && box.width > 5 && box.height > 5
    && box.top < innerHeight && box.right > 0 && box.left < innerWidth && !covered;
  return fine ? null : `${location.pathname} ${one.outerHTML.slice(0, 120)}`;
}"""
"""Returns what has the focus if it cannot be seen: without an outline, outside of the window, or under the header."""


class Keys:
    """The keyboard of a page. ``unseen`` are the places where the focus was not visible."""

    def __init__(self, page):
        self.page = page
        self.unseen = set()

    def press(self, *keys):
        for key in keys:
            self.page.keyboard.press(key)

    def write(self, text):
        self.press("Control+a")
        self.page.keyboard.type(text)

    def has(self, selector):
        return self.page.evaluate("(selector) => document.activeElement.matches(selector)", selector)

    def tab_to(self, selector, key="Tab"):
        """Press Tab until an element that matches has the focus."""
        for _ in range(STOPS):
            if self.has(selector):
                return
            self.press(key)
            if (found := self.page.evaluate(UNSEEN)) is not None:
                self.unseen.add(found)
        pytest.fail(f"Tab does not lead to {selector}.")

    def open(self, name):
        """Go to a page by its menu."""
        self.tab_to(f"nav a[href='/{name}']")
        self.press("Enter")
        self.page.wait_for_url(f"**/{name}")
        self.page.wait_for_selector("#state.good, #state.bad")

    def skip(self):
        """Go past the menu."""
        self.tab_to(".skip")
        self.press("Enter")


@pytest.fixture
def keys(page):
    page.set_viewport_size({"width": 1366, "height": 768})
    return Keys(page)


def test_day_at_the_bench_with_the_keyboard_alone(page, keys, serve_process, tmp_path):
    file = tmp_path / "rig.toml"
    file.write_text("")
    faults = 'bench.sim.faults=["jam@move1+1s"]'  # the first move after the first live image; over before the next
    server = serve_process("bench.sim.speed=50", "enroll.views=6", faults, options=("--config", str(file)))
    page.goto(server.url)
    page.wait_for_selector("#live-image[src^='blob:']")

    # The table jams: acknowledge the fault.
    keys.skip()
    keys.tab_to("#angle")
    keys.write("90")
    keys.press("Enter")
    page.wait_for_selector("#next-steps button:has-text('Acknowledge')")
    keys.tab_to("#next-steps button", "Shift+Tab")
    keys.press("Space")
    page.wait_for_selector("#state:has-text('Ready')")

    # Jog, and aim with the dial.
    keys.tab_to("#jog button[aria-label='Rotate by 15°']")
    angle = page.text_content("#dial-text")
    keys.press("Enter")
    page.wait_for_function("(before) => document.querySelector('#dial-text').textContent !== before", arg=angle)
    keys.tab_to("#dial", "Shift+Tab")
    keys.press("ArrowLeft", "ArrowLeft", "Escape", "PageUp", "Enter")
    page.wait_for_selector("#jobs li:nth-child(3)")
    page.wait_for_selector("#job:has-text('done')")

    # Put an object on the table, and enroll it.
    keys.open("enroll")
    for name in ("lamp", "mug-star"):
        page.wait_for_selector(".shelf button")
        keys.tab_to(f".shelf button[aria-pressed]:has(img[src$='/{name}'])")
        keys.press("Enter")
        page.wait_for_selector(f".shelf [aria-pressed=true]:has-text('{name}')")
        keys.tab_to("#name", "Shift+Tab")
        keys.write(name)
        keys.press("Enter")
        page.wait_for_selector("#job progress")
        page.wait_for_selector(f"#said.found:has-text('{name} is enrolled')")

    # Identify the second one, and correct the answer.
    keys.open("identify")
    keys.skip()
    keys.tab_to("#go")
    keys.press("Space")
    page.wait_for_selector("#answer.found:has-text('mug-star')")
    keys.open("runs")
    page.wait_for_selector("#answers button")
    keys.tab_to("#answers button")
    keys.press("Enter")
    keys.tab_to("dialog button.quiet:not([id])")
    while "Correct" not in page.evaluate("document.activeElement.textContent"):
        keys.press("Tab")
    keys.press("Enter")
    page.wait_for_selector("#right-object")
    keys.tab_to("#right-object", "Shift+Tab")
    page.keyboard.type("lamp")
    keys.tab_to("#right-reason")
    keys.write("the label was read")
    keys.tab_to("dialog button:not(.quiet)")
    keys.press("Space")
    page.wait_for_selector("#answers td:has-text('corrected, was mug-star')")

    # Turn an object.
    keys.open("catalog")
    page.wait_for_selector(".cards a")
    keys.tab_to(".cards a[href$='mug-star']")
    keys.press("Enter")
    page.wait_for_selector("#viewer .number")
    first = page.text_content("#viewer .number")
    keys.tab_to("#viewer input")
    keys.press("ArrowRight")
    assert page.text_content("#viewer .number") != first
    keys.tab_to("#outline-on")
    keys.press("Space")
    page.wait_for_selector("#viewer polygon", state="attached")
    keys.tab_to("#rename")
    keys.press("Enter")
    page.wait_for_selector("dialog[open]")
    keys.press("Escape")  # of the dialog, not STOP
    assert keys.has("#rename")

    # Change a setting.
    keys.open("settings")
    page.wait_for_selector(".setting", state="attached")
    keys.tab_to("#search")
    keys.write("max_views")
    keys.tab_to("[id='set-identify.max_views']")
    keys.write("5")
    keys.press("Enter")
    page.wait_for_selector("#restart:has-text('identify.max_views')")
    assert "max_views = 5" in file.read_text()
    assert page.text_content("#stop-state") == ""
    assert keys.unseen == set()


@pytest.mark.parametrize("press", ["Escape", "button"])
def test_stop_by_the_keyboard_alone(page, keys, serve_process, press):
    server = serve_process("bench.sim.speed=2", 'bench.sim.object="lamp"')
    page.goto(f"{server.url}enroll")
    page.wait_for_selector("#state.good")
    keys.skip()
    keys.tab_to("#name")
    keys.write("lamp")
    keys.press("Enter")
    page.wait_for_selector("#thumbs img")
    # The page changes after each event. The buttons of the job stay the same, so that they have the focus.
    keys.tab_to("#job button")
    assert "Pause" in page.evaluate("document.activeElement.textContent")
    page.wait_for_selector("#thumbs li:nth-child(3) img")
    keys.press("Space")
    page.wait_for_selector("#said-detail:has-text('Paused')")
    assert "Resume" in page.evaluate("document.activeElement.textContent")
    keys.press("Space")
    page.wait_for_selector("#said-detail:has-text('hands off')")
    if press == "button":
        keys.tab_to("#stop", "Shift+Tab")
        keys.press("Enter")
    else:
        keys.press("Escape")
    page.wait_for_selector("#stop-state:has-text('Stopped')")
    assert keys.unseen == set()
