"""A virtual machine with Linux's real drivers, and the played devices in it."""

import os
from collections.abc import Iterator
from dataclasses import dataclass

import pytest

from rig.doctor.computer import RULES_FILES
from tests.kernel.guest_bench import GuestBench
from tests.kernel.machine import Machine, NotReady, Result, find_kernel
from tests.kernel.played_bench import PlayedBench

BRLTTY_RULE = '''SUBSYSTEM=="usb", ENV{PRODUCT}=="403/6014/*", ENV{SYSTEMD_WANTS}+="brltty-device@.service"'''
"""A rule as in the package brltty, which handles a USB adapter as a braille display."""
PATIENT = {
    "servo": ("retries = 10",),
    "table": ("poll_s = 0.1", "quiet_dps = 2.0", "watchdog_s = 2.5"),
    "imu": ("rate_hz = 50", "bandwidth_hz = 20"),
    "camera": ("width = 320", "height = 240"),
    "view": ("roi = [40, 0, 240, 240]",),
}
"""Settings for an emulated computer, which is slow: a request to a device takes it tens of milliseconds."""

TRIGGERED = "--subsystem-match=usb --subsystem-match=usb-serial --subsystem-match=tty"
"""The devices of the rule; without these words udev looks at all devices, which takes an emulated computer long."""


@pytest.fixture(scope="session")
def machine(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Machine]:
    """Boot the virtual machine; skip the test, with the reason, if this computer cannot."""
    if "PYTEST_XDIST_WORKER" in os.environ:
        pytest.skip("the kernel tests share one virtual machine: run `make kernel-test`")
    try:
        kernel = find_kernel()
    except NotReady as missing:
        pytest.skip(str(missing))
    with Machine(kernel, tmp_path_factory.mktemp("machine")) as machine:
        yield machine


@pytest.fixture(scope="session")
def guest(machine: Machine) -> Iterator[GuestBench]:
    """Plug the devices in."""
    with PlayedBench() as played:
        guest = GuestBench(machine, played)
        guest.sh(
            "getent group i2c || echo i2c:x:1501: >> /etc/group", folder="/"
        )  # else only the package i2c-tools adds it
        guest.plug_in(*played.usb)
        yield guest


@dataclass(frozen=True, slots=True)
class FirstDay:
    """The outputs of the commands of a first day."""

    find: Result
    rules: Result
    latency_before: str
    latency_after: str
    link: str
    brltty_before: str
    brltty_after: str
    setup: Result
    written: str
    settings: Result
    home: Result


@pytest.fixture(scope="session")
def first_day(guest: GuestBench) -> FirstDay:
    """Set the bench up as a technician does, once for all tests."""
    latency = "/sys/bus/usb-serial/devices/ttyUSB0/latency_timer"
    find, rules, before = guest.rig("find"), guest.rig("doctor", "--udev"), guest.files(latency)[latency].strip()
    trigger = f"udevadm control --reload && udevadm trigger --action=add {TRIGGERED} && udevadm settle"
    adapter = "$(dirname $(grep -lx 6014 /sys/bus/usb/devices/*/idProduct))"
    wants = f"udevadm info -q property {adapter} | grep ^SYSTEMD_WANTS= || true"
    guest.sh(f"echo '{BRLTTY_RULE}' > /etc/udev/rules.d/85-brltty.rules && {trigger}")
    brltty_before = guest.sh(wants)
    guest.sh(f"tee {' '.join(RULES_FILES)} >/dev/null <<'END'\n{rules.output}END\n{trigger}")
    brltty_after = guest.sh(wants)
    after, link = guest.files(latency)[latency].strip(), guest.sh("readlink -f /dev/rig-servo")
    setup, written = guest.rig("setup"), guest.sh("cat rig.toml")
    added = (f"s/^\\[{section}\\]/" + "\\n".join((f"[{section}]", *lines)) + "/" for section, lines in PATIENT.items())
    guest.sh(f"sed -i '{'; '.join(added)}' rig.toml")
    settings, home = guest.rig("servo", "settings", "--write", "--yes"), guest.rig("home", "--here")
    return FirstDay(find, rules, before, after, link, brltty_before, brltty_after, setup, written, settings, home)


@pytest.fixture
def bench(guest: GuestBench, first_day: FirstDay) -> Iterator[GuestBench]:
    """Return a bench that is ready; at the end, undo the changes of the test."""
    yield guest
    guest.restore()
