"""`rig serve`: who may operate the bench, and what it says about that."""

import sys

import pytest
from typer.testing import CliRunner

from rig.cli.main import app
from rig.config import load_config
from rig.web.setup import Setup


@pytest.fixture
def serve(tmp_path, monkeypatch):
    """Run `rig serve`; a server that would start is returned instead."""
    started: list[Setup] = []

    def run_server(setup, ready):
        started.append(setup)
        ready("http://127.0.0.1:1/")

    monkeypatch.setattr("rig.web.run.run_server", run_server)

    def run(*words: str):
        done = CliRunner().invoke(app, ["serve", "--bench", "sim", "--set", f"state_dir={str(tmp_path)!r}", *words])
        return done, started[-1] if started else None

    return run


def test_server_says_that_every_user_of_the_computer_can_operate(serve):
    done, setup = serve()
    assert not setup.needs_login
    assert "Every user of this computer can operate the bench" in done.stderr
    assert "--login" in done.stderr


def test_login_asks_for_a_token_on_this_computer_too(serve):
    done, setup = serve("--login")
    assert (done.exit_code, setup) == (2, None)
    assert "rig serve --new-token NAME" in done.stderr
    assert serve("--new-token", "anna", "--role", "operate")[0].exit_code == 0
    done, setup = serve("--login")
    assert setup.needs_login
    assert "Every user" not in done.stderr


def test_search_in_the_network_without_its_package_is_an_error_at_the_start(serve, monkeypatch):
    monkeypatch.setitem(sys.modules, "zeroconf", None)
    done, started = serve("--set", "serve.find=true")
    assert (done.exit_code, started) == (3, None)
    assert "hbr-rig[mdns]" in done.stderr


@pytest.mark.parametrize("content", [None, "no certificate"])
def test_certificate_that_cannot_be_used_is_reported_before_the_server_starts(tmp_path, content):
    if content is not None:
        (tmp_path / "bench.pem").write_text(content)
    files = ("--certfile", str(tmp_path / "bench.pem"), "--keyfile", str(tmp_path / "bench.pem"))
    done = CliRunner().invoke(app, ["serve", "--bench", "sim", "--set", f"state_dir={str(tmp_path)!r}", *files])
    assert done.exit_code == 2
    assert "The certificate cannot be used" in done.stderr


def test_web_process_gets_the_same_configuration():
    config = load_config(
        None,
        ["catalog.url='postgresql://user:secret@host/rig'", "catalog.images='/images'", "table.limits_deg=[-200,370]"],
    )
    setup = Setup(bench="sim", config=config, seed=3, local_token="t")
    assert Setup.model_validate_json(setup.model_dump_json()) == setup
