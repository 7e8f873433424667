"""Catalogs: size on disk, response times of a large catalog, and the speed of an import of photographs."""

import argparse
import json
import os
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np

from benchmarks.bench_search import VIEWS_OF_AN_OBJECT, model
from benchmarks.large_catalog import build
from hbr import describe, pack
from rig.catalog import Catalog
from rig.catalog.exchange.photographs import read_folder
from rig.catalog.jobs import finished
from rig.catalog.transfer import transfer
from rig.cli.ui.exit_codes import EXIT_AMBIGUOUS, EXIT_UNKNOWN
from rig.core.clock import SystemClock, seconds_between

RIG = [sys.executable, "-c", "from rig.cli.main import main; main()"]
COIL = Path(os.environ.get("RIG_TEST_DATA", "../shared/data")) / "coil-100"
_CLOCK = SystemClock()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--objects", type=int, default=1_000, help="of the large catalog")
    parser.add_argument("--photographs", type=Path, default=COIL, help="folder in COIL's layout to import")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        sizes(Path(folder))
        answers(Path(folder), options.objects)
        if options.photographs.is_dir():
            imports(Path(folder), options.photographs)
        else:
            print(f"no photographs at {options.photographs}: import not measured")


def sizes(folder: Path) -> None:
    """Print the size of the paper's 100 objects without records."""
    views = model(100)
    path = folder / "models.npz"
    np.savez(
        path,
        packed=np.frombuffer(b"".join(map(pack, views.descriptors)), np.uint8).reshape(-1, 54),
        azimuth_deg=views.azimuth_deg.astype(np.float32),
        object_index=views.object_index.astype(np.uint16),
    )
    print(f"{'on disk':<64} {'MB':>7} {'bytes a view':>13}")
    size_row("100 objects: packed descriptors and angles (the paper: 1.5 MB)", path.stat().st_size, len(views))


def answers(folder: Path, objects: int) -> None:
    """Print the times of commands on a large catalog, each in a new process."""
    home = folder / "large"
    home.mkdir()
    views = build(home / "catalog", objects)
    (home / "rig.toml").write_text('default_bench = "sim"\n[catalog]\npath = "catalog"\n', encoding="utf-8")
    database = sum(path.stat().st_size for path in (home / "catalog").glob("catalog.sqlite*"))
    size_row(f"{objects} objects: catalog.sqlite with all records", database, len(views))
    print(f"\n{f'{objects} objects of {VIEWS_OF_AN_OBJECT} views, from the command to':<64} {'wall s':>7} {'CPU s':>6}")
    name = views.object_names[objects // 2]
    for words, until in (
        ("catalog list", "the end"),
        (f"catalog show {shlex.quote(name)}", "the end"),
        ("identify --json --set identify.max_views=2", "the first ranking"),
    ):
        runs = sorted(run(home, shlex.split(words), first_ranking="first" in until) for _ in range(3))
        wall, cpu = runs[1]
        print(f"rig {words}, {until}".ljust(64) + f" {wall:7.2f} {cpu:6.2f}")


def run(home: Path, words: list[str], *, first_ranking: bool) -> tuple[float, float]:
    """Return wall and CPU seconds of a command; the wall time ends at the first ranking if ``first_ranking``.

    Raises
    ------
    RuntimeError
        The command failed, or a search ended without a ranking.
    """
    before_s = cpu_s()
    begin_ns = _CLOCK.now_ns()
    pipe = subprocess.PIPE
    with subprocess.Popen([*RIG, *words], cwd=home, stdout=pipe, stderr=pipe, text=True) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        stop_ns = None
        for line in process.stdout:
            if first_ranking and stop_ns is None and json.loads(line).get("event") == "ranked":
                stop_ns = _CLOCK.now_ns()
        messages = process.stderr.read()
    # A search for an object of the simulator that is not enrolled ends with one of these codes.
    expected = (EXIT_UNKNOWN, EXIT_AMBIGUOUS) if first_ranking else (0,)
    if process.returncode not in expected or first_ranking != (stop_ns is not None):
        raise RuntimeError(f"rig {shlex.join(words)} failed with exit code {process.returncode}: {messages}")
    return seconds_between(begin_ns, stop_ns or _CLOCK.now_ns()), cpu_s() - before_s


def cpu_s() -> float:
    """Return the CPU seconds of this process and of its finished children."""
    used = os.times()
    return used.user + used.system + used.children_user + used.children_system


def imports(folder: Path, photographs: Path) -> None:
    """Measure the import of all photographs between two halves of the bare loop, so that load affects both equally."""
    files = sorted(photographs.glob("*.png"))
    half = len(files) // 2
    bare_s, bare_cpu_s = bare_loop(files[:half])
    begin_ns, before_s = _CLOCK.now_ns(), cpu_s()
    with Catalog.open(folder / "coil", clock=_CLOCK) as catalog:
        done = finished(transfer(read_folder(photographs, now=_CLOCK.utc()), catalog))
    import_s, import_cpu_s = seconds_between(begin_ns, _CLOCK.now_ns()), cpu_s() - before_s
    rest_s, rest_cpu_s = bare_loop(files[half:])
    bare_s, bare_cpu_s = bare_s + rest_s, bare_cpu_s + rest_cpu_s
    bare, whole = len(files) / bare_s, done.views / import_s
    print(f"\n{'photographs into a catalog':<64} {'wall s':>7} {'CPU s':>6} {'images/s':>9} {'ratio':>6}")
    print(f"{'decode and CEDD alone, one process':<64} {bare_s:7.1f} {bare_cpu_s:6.1f} {bare:9.0f} {1:6.2f}")
    label = f"import of {done.views}, durable, {os.cpu_count()} processes"
    print(f"{label:<64} {import_s:7.1f} {import_cpu_s:6.1f} {whole:9.0f} {whole / bare:6.2f}")


def bare_loop(files: list[Path]) -> tuple[float, float]:
    """Return wall and CPU seconds to decode and describe the files, one after the other."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    begin_ns, before_s = _CLOCK.now_ns(), cpu_s()
    for file in files:
        describe(np.asarray(cv2.imread(str(file)), np.uint8))
    took = seconds_between(begin_ns, _CLOCK.now_ns()), cpu_s() - before_s
    cv2.setNumThreads(threads)
    return took


def size_row(name: str, size: float, views: int) -> None:
    print(f"{name:<64} {size / 1e6:7.2f} {size / views:13.1f}")


if __name__ == "__main__":
    main()
