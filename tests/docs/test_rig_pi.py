"""docs/deploy/rig-pi installs a bench, and returns to the former version if the new one does not start."""

import configparser
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

from tests.docs.pages import DOCS

SCRIPT = DOCS / "deploy" / "rig-pi"
STUBS = {
    **dict.fromkeys(("apt-get", "id", "useradd", "getent", "usermod", "hostnamectl", "udevadm", "sleep"), "exit 0"),
    "runuser": """case "$*" in *touch*) exit 0 ;; esac
mkdir -p "$ROOT/var/lib/rig/state" && touch "$ROOT/var/lib/rig/state/tokens.json" && echo rig_secret""",
    "systemctl": 'echo "$@" >>"$ROOT/systemctl"',
    # A version whose name has "broken" in it never answers.
    "curl": 'case $(readlink "$ROOT/opt/rig") in *broken*) exit 7 ;; esac',
    "python3": """mkdir -p "$3/bin"
printf '#!/bin/sh\\nexit 0\\n' >"$3/bin/pip"
printf '#!/bin/sh\\necho rules\\n' >"$3/bin/rig"
chmod +x "$3"/bin/*""",
}


@pytest.fixture
def install(tmp_path: Path) -> Any:
    """Return a function that installs a wheel of this name below a folder, with stubs for what changes the system."""
    root, stubs = tmp_path / "root", tmp_path / "stubs"
    (root / "var/lib/rig").mkdir(parents=True)
    (root / "etc").mkdir()
    (root / "etc/hosts").write_text("127.0.0.1 localhost\n")
    stubs.mkdir()
    for name, text in STUBS.items():
        (stubs / name).write_text(f"#!/bin/sh\n{text}\n")
        (stubs / name).chmod(0o755)

    def run(name: str) -> tuple[subprocess.CompletedProcess[str], Path]:
        wheel = tmp_path / f"{name}.whl"
        wheel.write_text(name)
        environment = {"PATH": f"{stubs}:{os.environ['PATH']}", "ROOT": str(root), "LIMIT": "2"}
        done = subprocess.run(
            ["sh", str(SCRIPT), str(wheel)], env=environment, capture_output=True, text=True, check=False
        )
        return done, root

    return run


def current(root: Path) -> str:
    return (root / "opt" / "rig").resolve().name.rpartition("-")[0]


def test_first_installation_starts_the_service(install):
    done, root = install("one")
    assert done.returncode == 0, done.stderr
    assert "http://rig.local" in done.stderr
    assert "It is shown only once: rig_secret" in done.stderr
    assert current(root) == "one"
    assert (root / "etc/udev/rules.d/60-hbr-rig.rules").read_text() == "rules\n"
    assert "restart rig" in (root / "systemctl").read_text()


def test_version_that_does_not_start_is_replaced_by_the_former_one(install):
    install("one")
    done, root = install("broken")
    assert done.returncode == 1
    assert "The former version runs again: one" in done.stderr
    assert current(root) == "one"
    assert len(list((root / "opt/rig-releases").iterdir())) == 1
    done, _ = install("two")
    assert (done.returncode, current(root)) == (0, "two")
    assert "token" not in done.stderr
    assert len(list((root / "opt/rig-releases").iterdir())) == 2
    install("three")
    assert sorted(path.name[:3] for path in (root / "opt/rig-releases").iterdir()) == ["thr", "two"]


def test_first_version_that_does_not_start_is_reported(install):
    done, _ = install("broken")
    assert done.returncode == 1
    assert "journalctl -u rig" in done.stderr
    assert "no former version" in done.stderr


def test_installation_that_was_interrupted_is_made_again(install):
    _, root = install("one")
    (marker,) = (root / "opt/rig-releases").glob("*/complete")
    marker.unlink()
    (marker.parent / "half").touch()
    done, _ = install("one")
    assert done.returncode == 0, done.stderr
    assert marker.exists()
    assert not (marker.parent / "half").exists()


def test_files_beside_the_script_fit_together():
    service = ElementTree.parse(DOCS / "deploy" / "rig-avahi.service")
    unit = configparser.RawConfigParser(strict=False)
    unit.read(DOCS / "deploy" / "rig-pi.conf")
    assert unit["Service"]["ExecStart"].split()[0] == "/opt/rig/bin/rig"
    assert {one.findtext("type") for one in service.iter("service")} == {"_http._tcp", "_hbr-rig._tcp"}
    assert all(f"--port {one.text} " in unit["Service"]["ExecStart"] for one in service.iter("port"))


@pytest.mark.skipif(shutil.which("shellcheck") is None, reason="shellcheck is not installed")
def test_shellcheck_finds_nothing():
    checked = subprocess.run(["shellcheck", str(SCRIPT)], capture_output=True, text=True, check=False)
    assert checked.returncode == 0, checked.stdout
