"""docs/deploy/rig-pi on a real Debian: it boots in a container (systemd-nspawn) with the network of this computer.

The base system is made once by mmdebstrap and never changed: each run works on an overlay in memory. That of another
machine runs in QEMU's emulation of its programs, much slower.
"""

import os
import re
import shutil
import subprocess
import zipfile
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path

import pytest

from rig.core.clock import SystemClock, seconds_between
from tests.docs.pages import DOCS

pytestmark = [pytest.mark.debian, pytest.mark.timeout(10_800)]

MACHINE = os.environ.get("RIG_TEST_MACHINE", os.uname().machine)
"""The machine whose Debian is tested, as in the name of a wheel."""
ARCHITECTURES = {"x86_64": "amd64", "aarch64": "arm64"}
"""Debian's names of the machines."""
BASE = Path(os.environ.get("RIG_TEST_DEBIAN", Path.home() / ".cache" / "hbr-rig" / f"debian-{MACHINE}"))
"""The base system."""
MIRROR = "http://deb.debian.org/debian"
PACKAGES = "systemd-sysv,dbus,udev,libpam-systemd,ca-certificates,cloud-init"
OF_THIS_COMPUTER = ("resolv.conf", "hosts", "pip.conf", "ssl/certs/ca-certificates.crt")
"""Files of /etc that lead to Debian and PyPI."""
BOOT_S, ANSWER_S = 600.0, 3000.0
ENVIRONMENT = (
    "HOME=/root",
    "PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin",
    "LIMIT=600",
)


class Debian:
    """A running container; ``sh`` runs a command in it as root."""

    def __init__(self, leader: int) -> None:
        self._enter = ["nsenter", "--target", str(leader), "--all", "env", "-i", "--chdir=/root"]
        self._enter += ENVIRONMENT

    def sh(self, command: str, check: bool = True, given: bytes = b"") -> subprocess.CompletedProcess[str]:
        done = subprocess.run(
            [*self._enter, "sh", "-c", command],
            input=given,
            capture_output=True,
            check=False,
            timeout=ANSWER_S,
        )
        answer = subprocess.CompletedProcess(command, done.returncode, done.stdout.decode(), done.stderr.decode())
        assert answer.returncode == 0 or not check, (command, answer.stdout[-2000:], answer.stderr[-2000:])
        return answer

    def put(self, path: str, data: bytes) -> None:
        self.sh(f"mkdir -p $(dirname {path}) && cat >{path}", given=data)


def missing() -> str:
    """Return why this computer cannot run these tests; empty if it can."""
    if os.geteuid() != 0:
        return "root rights are needed to boot a container: sudo make debian-test"
    for program, package in (("mmdebstrap", "mmdebstrap"), ("systemd-nspawn", "systemd-container")):
        if shutil.which(program) is None:
            return f"{program} is not installed: apt-get install {package}"
    emulator = Path("/proc/sys/fs/binfmt_misc") / f"qemu-{MACHINE}"
    if os.uname().machine != MACHINE and not emulator.exists():
        packages = "qemu-user-static binfmt-support arch-test"
        return f"this computer does not run programs for {MACHINE}: apt-get install {packages}"
    if not wheels():
        return f"there is no wheel for {MACHINE} in dist/: make wheel"
    return ""


def wheels() -> list[Path]:
    return sorted((DOCS.parent / "dist").glob(f"hbr_rig-*_{MACHINE}.whl"))


def make_base() -> None:
    """Make the base system beside its folder, so that an interruption leaves no half of one."""
    unfinished = BASE.with_name(f"{BASE.name}.unfinished")
    shutil.rmtree(unfinished, ignore_errors=True)
    unfinished.parent.mkdir(parents=True, exist_ok=True)
    command = ["mmdebstrap", f"--architectures={ARCHITECTURES[MACHINE]}", "--variant=minbase"]
    made = subprocess.run(
        [*command, f"--include={PACKAGES}", "bookworm", str(unfinished), MIRROR],
        capture_output=True,
        text=True,
        check=False,
    )
    assert made.returncode == 0, f"mmdebstrap cannot make a Debian: {made.stderr[-1000:]}"
    (unfinished / "etc/cloud/cloud-init.disabled").touch()  # it is here for its schema only
    unfinished.rename(BASE)


@pytest.fixture(scope="module")
def debian(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Debian]:
    """Make the base system if there is none, and boot an overlay of it."""
    if why := missing():
        pytest.skip(why)
    if not BASE.exists():
        make_base()
    for name in OF_THIS_COMPUTER:
        with suppress(FileNotFoundError):
            shutil.copy(Path("/etc") / name, BASE / "etc" / name)
    log = (tmp_path_factory.mktemp("debian") / "console").open("wb")
    command = [
        "systemd-nspawn",
        "--quiet",
        "--register=no",
        "--keep-unit",
        "--resolv-conf=off",
        "--volatile=overlay",
    ]
    with ExitStack() as ending:
        ending.enter_context(log)
        container = subprocess.Popen(
            [*command, f"--directory={BASE}", "--boot"], stdin=subprocess.DEVNULL, stdout=log, stderr=log
        )
        ending.callback(container.wait)
        ending.callback(container.terminate)
        yield Debian(booted(container, Path(log.name)))


def booted(container: subprocess.Popen[bytes], log: Path) -> int:
    """Wait until the container has booted, and return the process id of its init."""
    clock = SystemClock()
    began_ns = clock.now_ns()
    while seconds_between(began_ns, clock.now_ns()) < BOOT_S:
        clock.sleep(1.0)
        if container.poll() is not None:
            pytest.fail(f"the container does not start: {log.read_text(errors='replace')[-300:]}")
        for child in Path(f"/proc/{container.pid}/task/{container.pid}/children").read_text().split():
            with suppress(FileNotFoundError):  # a helper of systemd-nspawn has ended
                # Init has the process id 1 in the container. Before its bus is ready, systemctl answers "offline".
                ids = re.search(r"^NSpid:(.*)$", Path(f"/proc/{child}/status").read_text(), re.MULTILINE)
                if ids and ids[1].split()[-1] == "1":
                    state = Debian(int(child)).sh("systemctl is-system-running --wait", check=False).stdout.strip()
                    if state in ("running", "degraded"):
                        return int(child)
    pytest.fail(f"the container has not booted: {log.read_text(errors='replace')[-300:]}")


def test_bench_is_installed_updated_and_returned(debian, tmp_path):
    (wheel,) = wheels()
    for file in (DOCS / "deploy").iterdir():
        debian.put(f"/boot/firmware/deploy/{file.name}", file.read_bytes())
    debian.put(f"/boot/firmware/{wheel.name}", wheel.read_bytes())
    unit = (DOCS / "deploy" / "rig-pi.conf").read_bytes().replace(b"--bench hardware", b"--bench sim")
    debian.put("/etc/systemd/system/rig.service.d/z-simulated.conf", unit)
    debian.sh("useradd --system --create-home --home-dir /var/lib/rig rig")
    debian.put("/var/lib/rig/rig.toml", b'default_bench = "sim"\n')
    debian.sh("chown rig: /var/lib/rig/rig.toml")
    install = f"cd /boot/firmware && sh deploy/rig-pi {wheel.name}"

    # The first installation.
    said = debian.sh(install).stderr
    assert "The bench is at http://rig.local." in said
    token = re.search(r"shown only once: (\S+)$", said, re.MULTILINE)[1]
    health = "curl -sf http://127.0.0.1/api/v1/health"
    assert '"status":"ok"' in debian.sh(health).stdout

    # Users, groups, rules, unit, name in the network.
    assert {"dialout", "video", "i2c"} <= set(debian.sh("id -nG rig").stdout.split())
    assert debian.sh("hostname").stdout.strip() == "rig"
    for unit in ("rig", "avahi-daemon"):
        assert debian.sh(f"systemctl is-enabled {unit} && systemctl is-active {unit}").stdout == "enabled\nactive\n"
    assert debian.sh("systemd-analyze verify rig.service").stderr == ""
    assert debian.sh("ps -o user= -C rig | sort -u").stdout.split() == ["rig"]
    rules = debian.sh("cat /etc/udev/rules.d/60-hbr-rig.rules").stdout
    assert 'SUBSYSTEM=="i2c-dev", GROUP="i2c"' in rules
    assert "Invalid" not in debian.sh("udevadm test /sys/class/net/lo 2>&1", check=False).stdout
    assert "established" in debian.sh("journalctl -u avahi-daemon | grep 'Turntable bench on rig'").stdout

    # The network gets in with the token only, and pages can change settings.
    def status(path: str, *options: str) -> str:
        words = " ".join(("curl -s -o /dev/null -w %{http_code} -H 'Host: rig.local'", *options))
        return debian.sh(f"{words} http://127.0.0.1/api/v1/{path}").stdout

    bearer = f"-H 'Authorization: Bearer {token}'"
    assert status("status") == "401"
    assert status("status", bearer) == "200"
    change = "-X PUT -H 'Content-Type: application/json' -d '{\"value\": 9}'"
    assert status("settings/identify.max_views", bearer, change) == "200"
    assert "max_views = 9" in debian.sh("cat /var/lib/rig/rig.toml").stdout
    assert "9" in debian.sh("rig config show identify.max_views").stdout

    # An update that does not start is taken back.
    broken = tmp_path / wheel.name
    with zipfile.ZipFile(wheel) as source, zipfile.ZipFile(broken, "w") as changed:
        for entry in source.infolist():
            changed.writestr(
                entry, b"raise SystemExit(1)\n" if entry.filename == "rig/web/run.py" else source.read(entry)
            )
    debian.put(f"/root/new/{broken.name}", broken.read_bytes())
    done = debian.sh(f"LIMIT=15 sh /boot/firmware/deploy/rig-pi /root/new/{broken.name}", check=False)
    assert done.returncode == 1
    assert "The former version runs again" in done.stderr
    assert '"status":"ok"' in debian.sh(health).stdout
    assert len(debian.sh("ls /opt/rig-releases").stdout.split()) == 1

    # The same version again changes nothing.
    assert "token" not in debian.sh(install).stderr


def test_user_data_of_the_guide_is_that_of_cloud_init(debian):
    guide = (DOCS / "how-to" / "raspberry-pi.md").read_text()
    user_data = re.search(r"^    #cloud-config\n(    .*\n)+", guide, re.MULTILINE)[0]
    debian.put("/root/user-data", user_data.replace("\n    ", "\n").removeprefix("    ").encode())
    assert "Valid" in debian.sh("cloud-init schema --config-file /root/user-data").stdout
