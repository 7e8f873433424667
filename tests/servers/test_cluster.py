"""Jobs on a Dask cluster: the same results as without one, and only the items of a dead worker are repeated."""

import json
import os
import signal
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import pytest
from typer.testing import Result

from rig.catalog import Catalog, derived
from rig.catalog.jobs import finished
from rig.catalog.verify import verify
from rig.core.cluster import Cluster, map_on_cluster
from rig.core.errors import ClusterFailed, UsageError
from rig.core.processes import map_in_processes
from sim.clock import VirtualClock
from tests.programs import Program
from tests.rig.catalog.catalog_samples import fill, forget
from tests.rig.cli.objects.test_evaluate import drawing

distributed = pytest.importorskip("distributed", reason="Dask is not installed (make test-servers)")

pytestmark = pytest.mark.filterwarnings("ignore")  # of the packages of Dask, about their own threads


@pytest.fixture(scope="module")
def cluster() -> Iterator[Cluster]:
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None, silence_logs=50
    ) as running:
        yield Cluster(running.scheduler_address)


def half(number: int) -> float:
    return number / 2


def die_once(folder: Path, number: int) -> int:
    mark = folder / str(number)
    with mark.open("a") as file:
        file.write(f"{os.getpid()}\n")
    if number == 3 and len(mark.read_text().split()) == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return number * number


def test_items_come_with_their_results(cluster: Cluster) -> None:
    assert dict(map_on_cluster(half, range(10), cluster)) == {n: n / 2 for n in range(10)}
    assert dict(map_in_processes(half, [], cluster)) == {}


def test_error_of_an_item_is_raised(cluster: Cluster) -> None:
    with pytest.raises(TypeError):
        list(map_on_cluster(half, [1, "x"], cluster))


def test_only_the_items_of_a_dead_worker_are_repeated(tmp_path: Path) -> None:
    found = dict(map_on_cluster(partial(die_once, tmp_path), range(12), Cluster("local:2")))
    assert found == {n: n * n for n in range(12)}
    workers = {number: (tmp_path / str(number)).read_text().split() for number in range(12)}
    assert len(workers[3]) == 2
    dead = workers[3][0]  # only its finished items are done again
    assert all(len(own) == 1 for own in workers.values() if own[0] != dead)
    assert all(len(own) <= 2 for own in workers.values())


def process(_: int) -> int:
    return os.getpid()


def test_local_cluster_is_started_once() -> None:
    first, second = ({pid for _, pid in map_on_cluster(process, range(8), Cluster("local:1"))} for _ in range(2))
    assert first == second
    assert os.getpid() not in first


def test_wrong_addresses_are_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rig.core.cluster.START_S", 1)
    with pytest.raises(ClusterFailed, match="does not answer"):
        list(map_on_cluster(half, [1], Cluster("tcp://127.0.0.1:9")))
    with pytest.raises(UsageError, match="not a number"):
        list(map_on_cluster(half, [1], Cluster("local:two")))


def test_catalog_jobs_on_a_cluster_give_the_same_results(cluster: Cluster, tmp_path: Path) -> None:
    with Catalog.open(tmp_path, clock=VirtualClock()) as catalog:
        for number in range(4):
            fill(catalog, f"object {number}", 4, 10 * number)
        before = catalog.version()
        forget(catalog)
        done = finished(derived.redescribe(catalog, jobs=cluster))
        assert (done.described, done.failed) == (16, ())
        assert catalog.version() == before
        store = catalog.database.images
        view = catalog.object("object 2").views[1]
        store.remove([view.image])
        assert finished(verify(catalog, jobs=cluster)) == finished(verify(catalog, jobs=1))


def test_commands_take_a_cluster(cluster: Cluster, rig: Callable[..., Result]) -> None:
    with Catalog.open("catalog", clock=VirtualClock()) as catalog:
        for number in range(3):
            fill(catalog, f"object {number}", 8, 10 * number)
        forget(catalog)
    words = ("catalog", "redescribe", "--cluster", cluster.address)
    done = rig(*words, "--json")
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["described"] == 24
    both = rig(*words, "--jobs", "2")
    assert both.exit_code == 2
    assert "both given" in both.output


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("pictures")
    for number in range(1, 7):
        for angle in range(0, 360, 30):
            assert cv2.imwrite(str(folder / f"obj{number}__{angle}.png"), drawing(number, angle))
    return folder


def results(out: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((out / "results.json").read_text())
    found.pop("wall_clock")
    return found


def test_evaluation_survives_a_killed_worker(pictures: Path, tmp_path: Path) -> None:
    experiment = tmp_path / "short.toml"
    experiment.write_text('base = "paper"\nmax_views = 4\ntrials = 2\n')

    def start(out: str, *words: str) -> Program:
        words = ("--data", str(pictures), "--out", str(tmp_path / out), "--noise", "mb", "--json", *words)
        return Program("eval", str(experiment), *words)

    def searched(program: Program, number: int | None = None) -> int:
        assert program.stdout is not None
        count = 0
        for line in program.stdout:
            count += json.loads(line)["event"] == "searched"
            if count == number:
                break
        return count

    alone = start("alone", "--jobs", "1")
    assert searched(alone) == 6
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None, silence_logs=50
    ) as running:
        spread = start("spread", "--cluster", running.scheduler_address)
        assert searched(spread, 1) == 1
        os.kill(running.workers[0].pid, signal.SIGKILL)
        assert searched(spread) == 5
        assert spread.wait() == 0
    for program in (alone, spread):
        program.close()
    assert results(tmp_path / "alone") == results(tmp_path / "spread")


def test_import_on_a_cluster_gives_the_same_catalog(
    cluster: Cluster, pictures: Path, rig: Callable[..., Result]
) -> None:
    imported = []
    for place, words in {"alone": ("--jobs", "1"), "spread": ("--cluster", cluster.address)}.items():
        done = rig("import", pictures, *words, "--set", f'catalog.path="{place}"')
        assert done.exit_code == 0, done.output
        with Catalog.open(place, clock=VirtualClock(), read_only=True) as catalog:
            views = derived.views(catalog)
            stored = [[view.image for view in catalog.object(name).views] for name in views.object_names]
            imported.append((views.object_names, views.packed().tobytes(), stored))
    assert imported[0] == imported[1]
    assert len(imported[0][0]) == 6
