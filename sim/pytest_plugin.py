"""Fixtures for the tests of programs that use the rig: a simulated bench, its world, and a catalog.

Installed with the package; nothing heavy is imported until a test asks for a fixture.
Guide: docs/how-to/test-without-hardware.md.
"""

from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from pathlib import Path

    from rig.bench import Bench
    from rig.catalog import Catalog
    from sim.world import World

MARK = "sim(*settings, seed=0, noise=None, faults=()): settings KEY=VALUE, seed, noise model and faults of the bench"


def pytest_configure(config: pytest.Config) -> None:
    """Make the marker known."""
    config.addinivalue_line("markers", MARK)


@pytest.fixture
def sim_world(request: pytest.FixtureRequest) -> "World":
    """The simulated world: true angle, light, and the object on the table; tests set it."""
    from sim.world import World

    mark = request.node.get_closest_marker("sim")
    options = dict(mark.kwargs) if mark else {}
    return World(noise=options.get("noise"), seed=options.get("seed", 0))


@pytest.fixture
def sim_bench(request: pytest.FixtureRequest, sim_world: "World") -> "Iterator[Bench]":
    """An open bench in `sim_world`: real drivers on simulated wires, on a virtual clock.

    `sim_bench.placer` puts objects on the table: `next_object` is the object and `yaw_deg` its rotation. The marker's
    `faults`, such as "jam@move3", are injected.
    """
    from rig.config import RigConfig, load_config
    from sim.bench import ShelfOperator, open_sim_bench
    from sim.faults import Fault
    from sim.objects.shelf import shelf

    mark = request.node.get_closest_marker("sim")
    config: RigConfig = load_config(None, mark.args if mark else ())
    faults = [Fault.parse(text) for text in mark.kwargs.get("faults", ())] if mark else []
    with open_sim_bench(config, ShelfOperator(sim_world, shelf()), faults=faults) as bench:
        yield bench


@pytest.fixture
def sim_catalog(sim_bench: "Bench", tmp_path: "Path") -> "Iterator[Catalog]":
    """An empty catalog in the test's own folder, on the clock of `sim_bench`."""
    from rig.catalog import Catalog

    with Catalog.open(tmp_path / "catalog", clock=sim_bench.clock) as catalog:
        yield catalog


@pytest.fixture
def running_sim_bench(tmp_path: "Path") -> "Iterator[Path]":
    """Return the folder of a simulated bench that another process runs in real time, as `rig sim-bench` does.

    Programs under test use it with ``--config FOLDER/rig.toml``; `sim.realtime.wire.send_command` changes its world.
    """
    import json
    import subprocess
    import sys

    folder = tmp_path / "sim-bench"
    start = "from rig.cli.main import main; main()"
    arguments = [sys.executable, "-c", start, "sim-bench", "--json", "--folder", str(folder)]
    process = subprocess.Popen(arguments, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        assert json.loads(process.stdout.readline())["folder"] == str(folder)
        yield folder
    finally:
        process.terminate()
        process.communicate()
