"""`rig faults`, and faults injected into `rig demo` and into other commands on the simulated bench."""

import json

import pytest
from typer.testing import CliRunner

from rig.cli.main import app
from sim.faults import Fault, fault_kinds
from tests import small

SETTINGS = ("enroll.views=4", "identify.max_views=2", *small.SMALL)
SMALL = ("--count", "2", *(word for setting in SETTINGS for word in ("--set", setting)))


def rig(*arguments: str):
    return CliRunner().invoke(app, list(arguments))


def test_faults_are_listed_as_json():
    listed = [json.loads(line) for line in rig("faults", "--json").stdout.splitlines()]
    assert [entry["fault"] for entry in listed] == list(fault_kinds())
    for entry in listed:
        given = "".join(f":{name}={value['default']}" for name, value in entry["parameters"].items())
        assert Fault.parse(entry["fault"] + given).kind.what == entry["what"]


def test_fault_ends_the_demo_with_its_exit_code_and_next_step(tmp_path):
    done = rig("demo", *SMALL, "--fault", "jam@move2", "--out", str(tmp_path))
    assert done.exit_code == 5
    assert "fault begins: jam" in done.stderr
    assert "Next step:" in done.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("stored", [False, True])
def test_a_jam_asks_for_an_acknowledgement_only_where_a_fault_stays_latched(stored, tmp_path):
    """The simulated bench forgets its state with its program, unless it has a folder for it."""
    bench = ("--bench", "sim", *(("--set", f"state_dir={tmp_path}") if stored else ()))
    jammed = rig("goto", "40", *bench, "--set", 'bench.sim.faults=["jam"]')
    assert jammed.exit_code == 5
    assert ("rig acknowledge" in jammed.stderr) == stored
    assert ("start the program again" in jammed.stderr) != stored
    assert rig("goto", "40", *bench).exit_code == (5 if stored else 0)  # as the next step says
    acknowledged = json.loads(rig("acknowledge", *bench, "--json").stdout)["acknowledged"]
    assert (acknowledged is not None) == stored


@pytest.mark.nightly
def test_changed_bench_is_searched_with_the_faults_of_command_line_and_configuration(tmp_path):
    done = rig(
        *("demo", *SMALL, "--fault", "crc_flip@1s+3s", "--fault", "camera.slow@2s+1s"),
        *("--set", 'bench.sim.faults=["i2c_nack@3s+1s"]', "--out", str(tmp_path / "out")),
        *("--views", "5", "--change", "bench"),
    )
    assert done.exit_code in (0, 6), done.output  # with so few views an answer can be wrong
    assert "2 objects enrolled with 10 views" in done.stdout  # --views wins over enroll.views
    assert done.stdout.count("(not enrolled)") == 2
    for name in ("crc_flip", "camera.slow", "i2c_nack"):
        assert f"fault begins: {name}" in done.stderr
        assert f"fault ends: {name}" in done.stderr


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--fault", "jamm"), "Did you mean jam?"),
        (("--fault", "jam@noon"), "12s, move3 or view10"),
        (("--set", 'bench.sim.faults=["jamm"]'), "Did you mean jam?"),
    ],
)
def test_wrong_faults_are_rejected_before_the_demo_starts(arguments, words, tmp_path):
    done = rig("demo", *arguments, "--out", str(tmp_path))
    assert done.exit_code in (2, 3)
    assert words in done.stderr
    assert not list(tmp_path.iterdir())
