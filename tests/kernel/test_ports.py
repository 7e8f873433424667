"""Ports that another program uses, and devices that the user may not open."""

import json
from collections.abc import Iterator
from pathlib import PurePosixPath
from typing import Any

import pytest

from tests.kernel.guest_bench import FOLDER, VARIABLES, GuestBench

pytestmark = [pytest.mark.kernel, pytest.mark.timeout(600)]

LOCKED = "import fcntl; fcntl.flock(port, fcntl.LOCK_EX | fcntl.LOCK_NB)"
HOLD = (
    "import time; port = open('/dev/ttyUSB0', 'rb', buffering=0); {lock}; print('ready', flush=True); time.sleep(600)"
)


@pytest.mark.parametrize("lock", [LOCKED, "pass"], ids=["locked", "not locked"])
def test_the_table_does_not_move_while_another_program_has_the_port(bench: GuestBench, lock: str) -> None:
    holder = bench.start_sh(f'exec python3 -c "{HOLD.format(lock=lock)}"')
    bench.until_printed(holder, "ready")
    before = bench.played.table()[0]
    goto = bench.rig("goto", before + 40)
    assert goto.code == 9, goto.output
    assert f"process {holder.pid}" in goto.output
    assert f"kill {holder.pid}" in goto.output
    assert bench.played.table()[0] == before
    find = bench.rig("find", "--json")
    codes = [finding["code"] for finding in json.loads(find.result)["findings"]]
    assert "device_file_in_use" in codes, find.output


GROUPS = ("dialout", "i2c", "video")
HOME = PurePosixPath("/home/technician")
UID = 1500


@pytest.fixture(scope="module")
def technician(guest: GuestBench, first_day: object) -> Iterator[None]:
    """Add a user, who may read the project and Python, and has the bench's configuration."""
    guest.sh(f"echo technician:x:{UID}:{UID}::{HOME}:/bin/bash >> /etc/passwd")
    guest.sh(f"mkdir -p {HOME}; cp {FOLDER}/rig.toml {HOME}; chown -R {UID}:{UID} {HOME}")
    guest.sh("chmod o+x /root")
    guest.sh("udevadm trigger --action=add --subsystem-match=i2c-dev && udevadm settle")  # by the rig's own rule
    yield
    guest.sh("chmod o-x /root; sed -i '/^technician:/d' /etc/passwd")


def findings(bench: GuestBench, *groups: str) -> list[dict[str, Any]]:
    """Return what the doctor finds about the ports for a user in these groups."""
    gids = [int(bench.sh(f"getent group {group} | cut -d: -f3")) for group in groups]
    variables = {name: value.replace(str(FOLDER), str(HOME)) for name, value in VARIABLES.items()}
    user = {"uid": UID, "gid": UID, "groups": gids}
    doctor = bench.rig("doctor", "--json", user=user, folder=str(HOME), variables={**variables, "HOME": str(HOME)})
    found: list[dict[str, Any]] = json.loads(doctor.result)["findings"]
    return found


@pytest.mark.parametrize("missing", GROUPS)
def test_doctor_names_the_group_that_the_user_has_to_join(bench: GuestBench, technician: None, missing: str) -> None:
    found = findings(bench, *(group for group in GROUPS if group != missing))
    problems = [one for one in found if one["topic"] == "port" and one["level"] == "bad"]
    assert [one["fix"] for one in problems] == [f"sudo usermod -aG {missing} technician"], found
