"""Fixtures for the whole suite: a simulated bench, and access to its world."""

import gc
import os
import shutil
import signal
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cache
from multiprocessing.util import get_temp_dir
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import pytest
import typer.testing
from hypothesis import settings
from typer.testing import CliRunner, Result

from rig.bench import Bench
from rig.cli.main import app
from rig.config import load_config
from rig.config.values import APP
from sim.bench import ShelfOperator, open_sim_bench
from sim.i2c import open_files
from sim.noise import NoiseModel
from sim.objects.shelf import shelf
from sim.world import World
from tests.small import SMALL

# Without deadlines, because they measure the computer, not the code; pytest-timeout ends tests that hang. Examples are
# the same in every clone; `--hypothesis-profile=nightly` searches for new ones.
settings.register_profile("rig", deadline=None, derandomize=True, database=None, max_examples=10)
settings.register_profile("nightly", deadline=None, max_examples=1000)
settings.load_profile("rig")

# Imported and collected objects live until the end. The garbage collector would visit them for a sixth of that time.
gc.disable()

# Typer builds all commands for each invocation, which takes longer than most commands.
typer.testing._get_command = cache(typer.testing._get_command)

# The workers use all cores already. OpenCV's own threads would wait for each other at each of its many small calls.
cv2.setNumThreads(1)

# By default glibc returns the memory of each image to the system, which clears it for the next one. That takes longer
# than most computing with images. Workers, and programs that start later, keep 32 MiB. The limit of memory in
# `tests.fuzzing` allows no more.
for option in ("MALLOC_TRIM_THRESHOLD_", "MALLOC_MMAP_THRESHOLD_"):
    os.environ.setdefault(option, str(2**25))

# Tests start many processes, and compiled modules save a fifth of the time of each.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# The catalogs of the tests are durable, so that tests would wait for a disk. They are in memory if it has room.
MEMORY = Path("/dev/shm")
if os.access(MEMORY, os.W_OK | os.X_OK) and shutil.disk_usage(MEMORY).free > 2e9:
    os.environ.setdefault("PYTEST_DEBUG_TEMPROOT", str(MEMORY))

# A background job of a shell without job control ignores SIGINT, one of nohup ignores SIGHUP, and so do the processes
# that it starts. Tests start processes and send them signals.
for number, handler in ((signal.SIGINT, signal.default_int_handler), (signal.SIGHUP, signal.SIG_DFL)):
    if signal.getsignal(number) is signal.SIG_IGN:
        signal.signal(number, handler)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int:
    """Return three workers for two cores: for a sixth of the time, tests wait for a clock or for another program.

    Each worker takes half a gigabyte of memory, so that there are at most two more than cores.
    """
    cores = os.cpu_count() or 1
    return cores + min(cores // 2, 2)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the tests that wait for a real clock first: one worker waits while the others compute."""
    items.sort(key=lambda item: item.get_closest_marker("realtime") is None)


def pytest_collection_finish() -> None:
    """Exclude modules and collected tests, which live as long as the process, from garbage collection.

    It would visit these millions of objects again and again, which takes a sixth of the time of all tests.
    """
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000, 20, 50)
    gc.enable()


@pytest.fixture(scope="session")
def for_all_workers(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder that all workers of a run share."""
    base = tmp_path_factory.getbasetemp()
    return base.parent if "PYTEST_XDIST_WORKER" in os.environ else base


def share_firmware(cache: Path, shared: Path) -> None:
    """Let all programs that share a folder use the firmware that the first of them builds."""
    shared.mkdir(exist_ok=True)
    (cache / APP).mkdir(parents=True)
    (cache / APP / "head").symlink_to(shared)


@pytest.fixture(autouse=True, scope="session")
def _nobodys_home(tmp_path_factory: pytest.TempPathFactory, for_all_workers: Path) -> Iterator[None]:
    """Separate the tests from the data of the user who runs them, and remove their files."""
    home = tmp_path_factory.mktemp("home")
    share_firmware(home / "cache", for_all_workers / "firmware")
    get_temp_dir()  # Python removes this one at its own end
    with (
        TemporaryDirectory(prefix="rig-tests-", dir=home.parent, ignore_cleanup_errors=True) as temporary,
        pytest.MonkeyPatch.context() as patch,
    ):
        patch.setenv("TMPDIR", temporary)  # for what killed programs leave
        patch.setattr(tempfile, "tempdir", temporary)
        for folder in ("CONFIG", "DATA", "STATE", "CACHE"):
            patch.setenv(f"XDG_{folder}_HOME", str(home / folder.lower()))
        yield


@pytest.fixture(autouse=True, scope="module")
def _buses_are_closed() -> Iterator[None]:
    """Find simulated I2C buses that a module leaves open: each one holds a file descriptor until the process ends."""
    before = open_files()
    yield
    assert open_files() <= before, "a simulated I2C bus is still open: close it, or use it in a with block"


@pytest.fixture(scope="session")
def rig_test_data() -> Path:
    default = Path(__file__).parents[1] / ".." / "shared" / "data"
    folder = Path(os.environ.get("RIG_TEST_DATA", default))
    if not folder.is_dir():
        pytest.skip(f"test data not found at {folder}; set RIG_TEST_DATA")
    return folder


@pytest.fixture
def rig(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Result]:
    """Return a function that runs `rig ...` on the simulated bench in an empty folder, where all its data are."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rig.toml").write_text(
        'default_bench = "sim"\nstate_dir = "state"\ncalibration_dir = "calibrations"\n[catalog]\npath = "catalog"\n'
        "[camera]\nwidth = 320\nheight = 240\n[view]\nroi = [40, 0, 240, 240]\n"  # takes less computing
    )
    return lambda *words, **options: CliRunner().invoke(app, [str(word) for word in words], **options)


@dataclass(frozen=True)
class SimulatedBench:
    """A simulated bench with its operator and its world."""

    bench: Bench
    operator: ShelfOperator
    world: World


@pytest.fixture
def simulated() -> Iterator[Callable[..., SimulatedBench]]:
    """Return a function that opens a bench with small frames: settings as ``KEY=VALUE``, ``noise=``, ``seed=``."""
    with ExitStack() as benches:

        def open_one(*settings: str, noise: NoiseModel | None = None, seed: int = 0) -> SimulatedBench:
            world = World(noise=noise, seed=seed)
            operator = ShelfOperator(world, shelf())
            bench = benches.enter_context(open_sim_bench(load_config(None, (*SMALL, *settings)), operator))
            return SimulatedBench(bench, operator, world)

        yield open_one
