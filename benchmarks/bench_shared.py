"""A catalog on PostgreSQL against one in a folder, and an evaluation on a local Dask cluster against two processes.

Needs the packages of `.ci/servers.lock` and a PostgreSQL server program; without them it prints why and ends.

    python -m benchmarks.bench_shared [--objects 1000] [--photographs FOLDER]
"""

import argparse
import csv
import os
import subprocess
import sys
import tempfile
from contextlib import closing
from pathlib import Path
from timeit import default_timer

from benchmarks.large_catalog import build
from benchmarks.record import record
from rig.catalog import Catalog
from rig.catalog.copying import copy_catalog
from rig.config.catalog_place import CatalogPlace
from rig.core.clock import SystemClock
from rig.search.model import load_model
from tests.servers.postgres import PostgresServer, missing, place_in

TIME_COLUMN = "step_median_ms"
RIG = [sys.executable, "-c", "from rig.cli.main import main; main()"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--objects", type=int, default=1_000, help="objects of 72 views")
    parser.add_argument("--photographs", type=Path, help="folder in the layout of COIL-100, for the evaluation")
    options = parser.parse_args()
    if reason := missing():
        print(f"Not measured: {reason}")
        return
    with tempfile.TemporaryDirectory() as folder:
        compare_engines(Path(folder), options.objects)
        if options.photographs:
            compare_evaluations(Path(folder), options.photographs)


def compare_engines(folder: Path, objects: int) -> None:
    """Measure the time of the steps before the first ranking of a program."""
    build(folder / "sqlite", objects)
    with closing(PostgresServer()) as server:
        place = place_in(server.url, folder / "postgres")
        with (
            Catalog.open(folder / "sqlite", clock=SystemClock()) as source,
            Catalog.open(place, clock=SystemClock()) as target,
        ):
            for _ in copy_catalog(source, target):
                pass
        for first in (True, False):  # in the second round the prepared file of the index exists
            embedded, shared = steps(folder / "sqlite"), steps(place)
            for name, took_ms in shared.items():
                label = f"{objects:,} objects on PostgreSQL: {name}{', nothing prepared' if first else ''}"
                record(label, took_ms, "SQLite", embedded[name])


def steps(place: Path | CatalogPlace) -> dict[str, float]:
    """Return the milliseconds of opening a catalog, of listing its objects and of loading its model."""
    times = [default_timer()]
    with Catalog.open(place, clock=SystemClock(), read_only=True) as catalog:
        times.append(default_timer())
        catalog.objects()
        times.append(default_timer())
        load_model(catalog)
        times.append(default_timer())
    names = ("open", "list", "model for the first ranking")
    return {name: (b - a) * 1e3 for name, a, b in zip(names, times, times[1:], strict=False)}


def compare_evaluations(folder: Path, photographs: Path) -> None:
    """Compare an evaluation by two processes and by two workers of a local cluster: results, CPU and wall time.

    The runs alternate, and the shorter time of two counts: other programs disturb the wall time.
    """
    ways = {"two processes": ["--jobs", "2"], "two workers": ["--cluster", "local:2"]}
    found: dict[str, list[dict[str, str]]] = {}
    wall_ms, cpu_ms = ({name: [] for name in ways} for _ in range(2))
    for number in range(2):
        for name, words in ways.items():
            out = folder / f"{name.replace(' ', '-')}-{number}"
            command = [*RIG, "eval", str(photographs), "--noise", "mb", "--trials", "8", "--out", str(out), *words]
            start, before = default_timer(), os.times()
            subprocess.run(command, check=True, capture_output=True)
            after = os.times()
            wall_ms[name].append((default_timer() - start) * 1e3)
            used = after.children_user + after.children_system - before.children_user - before.children_system
            cpu_ms[name].append(used * 1e3)
            with (out / "results.csv").open(newline="") as file:
                found[name] = [{k: v for k, v in row.items() if k != TIME_COLUMN} for row in csv.DictReader(file)]
    for kind, took_ms in {"wall time": wall_ms, "CPU time": cpu_ms}.items():
        record(
            f"rig eval on a local Dask cluster of two workers, {kind}",
            min(took_ms["two workers"]),
            "--jobs 2",
            min(took_ms["two processes"]),
        )
    equal = found["two processes"] == found["two workers"]
    print(f"All {len(found['two workers'])} rows of the results are {'equal' if equal else 'DIFFERENT'}.")


if __name__ == "__main__":
    main()
