"""Several people at one bench: their tokens, and the jobs that one proposes and another approves."""

import json
import subprocess
import urllib.request

import pytest

from tests.browser.conftest import RIG
from tests.small import SMALL

pytestmark = pytest.mark.nightly  # make test-web runs them
WAIT_MS = 60_000


def made(tmp_path, name, role):
    """Return a new token, made at a terminal."""
    command = [*RIG, "serve", "--bench", "sim", "--set", f"state_dir={tmp_path}/state"]
    done = subprocess.run([*command, "--new-token", name, "--role", role], capture_output=True, text=True, check=True)
    return done.stdout.strip()


def log_in(page, url, token):
    page.goto(f"{url}login")
    page.fill("#token", token)
    page.click("#login button")
    page.wait_for_selector("#state.good", timeout=WAIT_MS)


def propose(url, token, **request):
    headers = {"Authorization": f"Bearer {token}", "Content-Type": "application/json"}
    sent = urllib.request.Request(f"{url}api/v1/jobs", json.dumps(request).encode(), headers)
    with urllib.request.urlopen(sent, timeout=20) as answer:
        return json.load(answer)["id"]


def test_operator_makes_a_token_approves_and_rejects_what_it_proposes_and_revokes_it(
    page, chromium, serve_process, tmp_path
):
    operator, viewer = (made(tmp_path, *who) for who in (("ana", "operate"), ("screen", "watch")))
    server = serve_process("bench.sim.speed=50", *SMALL, options=("--login",))
    log_in(page, server.url, operator)
    page.goto(f"{server.url}settings")
    page.fill("#make-token [name=name]", "agent")
    page.select_option("#make-token [name=role]", "propose")
    page.click("#make-token button")
    agent = page.input_value("#made input")
    page.wait_for_selector("#tokens tr:has-text('agent'):has-text('propose')")
    page.click("#made button:has-text('Done')")
    assert agent not in page.content()
    # What it proposes is on every page, also on one that is opened later; only an operator has the buttons.
    other = chromium.new_context().new_page()
    log_in(other, server.url, viewer)
    propose(server.url, agent, kind="enroll", name="lamp", views=24)
    words = "#proposals p:has-text('agent proposes: Enroll lamp (views: 24)')"
    for shown in (page, other):
        shown.wait_for_selector(words)
        shown.reload()
        shown.wait_for_selector(words)
    assert other.locator("#proposals button").count() == 0
    page.click("#proposals button:has-text('Reject')")
    for shown in (page, other):
        shown.wait_for_selector("#proposals p", state="detached")
    page.goto(f"{server.url}enroll")
    propose(server.url, agent, kind="goto", angle_deg=20)
    page.click("#proposals p:has-text('Rotate to 20°') button:has-text('Approve')")
    page.goto(server.url)
    page.wait_for_selector("#jobs li:has-text('Rotate to 20° done')", timeout=WAIT_MS)
    assert "Rotate to 20°" not in page.text_content("#proposals")
    # A token that is revoked has no rights any more, and its open page ends.
    page.goto(f"{server.url}settings")
    for name in ("agent", "screen"):
        page.click(f"#tokens button[aria-label='Revoke {name}']")
        page.click("dialog button:has-text('Revoke')")
        page.wait_for_selector(f"#tokens tr:has-text('{name}')", state="detached")
    other.wait_for_selector("#login", timeout=WAIT_MS)
    with pytest.raises(urllib.error.HTTPError, match="401"):
        propose(server.url, agent, kind="home")
    other.context.close()


def test_settings_of_a_server_without_login_list_the_tokens_and_change_none(page, serve_process, tmp_path):
    made(tmp_path, "ana", "operate")
    server = serve_process(*SMALL)
    page.goto(f"{server.url}settings")
    page.wait_for_selector("#tokens tr:has-text('ana')")
    assert page.locator("#tokens button").count() == 0
    assert page.is_hidden("#make-token")
